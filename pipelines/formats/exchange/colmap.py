"""COLMAP's sparse models, text and binary: cameras and images; their points are not read.

COLMAP puts the first pixel's centre at (0.5, 0.5), this project at (0, 0); the principal points returned and taken here
are this project's. Poses are `x_cam = R(q) x_world + t` with q = (w, x, y, z), in the model's own unit.
"""

import io
import struct
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from faintfield.calib.lens import Lens
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.exchange.imported_set import (
    ExportedSet,
    ImportedSet,
    PosedImage,
    check_set_free,
    export_posed,
    import_posed,
)
from faintfield.pipelines.formats.exchange.options import ImportOptions
from faintfield.pipelines.formats.files import write_whole
from faintfield.pipelines.formats.reading import is_file, read_content
from faintfield.pipelines.formats.toml_files import inside

# Name and number of parameters of a camera model, by COLMAP's number.
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    6: ("FULL_OPENCV", 12),
}
_NUMBERS = {name: number for number, (name, _) in _MODELS.items()}
_HALF_PX = 0.5

# Size in bytes up to which a file of a model is read: its images file lists the points seen in each image, too.
_MAX_BYTES = 256_000_000

# Names of all files that a model is written to.
MODEL_FILES = [f"{part}{suffix}" for part in ("cameras", "images", "points3D") for suffix in (".bin", ".txt")]


# Name, number of the camera, and pose of an image, Rodrigues rad and the model's unit.
type _Image = tuple[str, int, NDArray[np.float64]]


def read_model(folder: Path, pictures: Path | None = None) -> list[PosedImage]:
    """Return the images of a model with their lenses and poses, in its own unit: of its binary files where it has both.

    Names of images count from the folder `pictures`, by default from that of the model.

    Raises
    ------
    MissingFile
        The folder holds neither cameras.bin nor cameras.txt, or no images beside them.
    BadValue
        A file is damaged, an image's camera is missing, a camera's model has no counterpart here, or a name leads out
        of the folder.
    """
    cameras, images = _model_files(folder)
    read_cameras, read_images = _READERS[cameras.suffix]
    try:
        lenses, entries = read_cameras(cameras), read_images(images)
    except (struct.error, ValueError, LookupError, OverflowError) as failure:
        raise BadValue(f"{folder}: is not a COLMAP model that can be read ({failure}); export it again") from failure
    for name, camera, _ in entries:
        if camera not in lenses:
            raise BadValue(
                f"{images}: {name} was taken with camera {camera}, and {cameras.name} has "
                f"{', '.join(map(str, lenses)) or 'none'}; export the whole model"
            )
    place = pictures or folder
    return [PosedImage(inside(place, name, f"{images}: name"), lenses[camera], rt) for name, camera, rt in entries]


def import_model(src: Path, out: Path, options: ImportOptions) -> ImportedSet:
    """Make an elemental set of a model and its images."""
    check_set_free(out, options)
    return import_posed(out, _model_files(src), read_model(src, options.images), options, "import colmap")


def export_model(set_path: Path, out: Path, *, binary: bool, overwrite: bool) -> ExportedSet:
    """Write the lens and poses of a set or session as a model without points."""
    return export_posed(set_path, out, "mm", MODEL_FILES, partial(write_model, binary=binary), overwrite=overwrite)


def _model_files(folder: Path) -> tuple[Path, Path]:
    """Return the files of cameras and images that are read: binary where there are both."""
    for suffix in (".bin", ".txt"):
        cameras, images = folder / f"cameras{suffix}", folder / f"images{suffix}"
        if is_file(cameras):
            if not is_file(images):
                raise MissingFile(f"{images}: no such file; export the whole model")
            return cameras, images
    raise MissingFile(f"{folder}: holds no cameras.bin or cameras.txt; name the folder of a COLMAP sparse model")


def write_model(folder: Path, views: Sequence[PosedImage], *, binary: bool) -> None:
    """Write cameras, images and an empty list of points, in text or binary."""
    numbers = {lens: number for number, lens in enumerate(dict.fromkeys(view.lens for view in views), start=1)}
    cameras = [(number, *_camera(lens)) for lens, number in numbers.items()]
    images = [
        (number, _pose_numbers(view.rt_cam_world), numbers[view.lens], str(view.path))
        for number, view in enumerate(views, start=1)
    ]
    if binary:
        content = struct.pack("<Q", len(cameras))
        for number, name, width, height, parameters in cameras:
            content += struct.pack(f"<iiQQ{len(parameters)}d", number, _NUMBERS[name], width, height, *parameters)
        write_whole(folder / "cameras.bin", content)
        content = struct.pack("<Q", len(images))
        for number, pose, camera, name in images:
            content += struct.pack("<i7di", number, *pose, camera) + name.encode() + b"\0" + struct.pack("<Q", 0)
        write_whole(folder / "images.bin", content)
        write_whole(folder / "points3D.bin", struct.pack("<Q", 0))
        return
    if spaced := [name for *_, name in images if len(name.split()) > 1]:
        raise BadValue(f"'{spaced[0]}': has a space, where COLMAP ends a name in a text model; use --binary")
    lines = [f"{number} {kind} {w} {h} {' '.join(map(repr, values))}\n" for number, kind, w, h, values in cameras]
    write_whole(folder / "cameras.txt", "".join(lines))
    lines = [f"{number} {' '.join(map(repr, pose))} {camera} {name}\n\n" for number, pose, camera, name in images]
    write_whole(folder / "images.txt", "".join(lines))
    write_whole(folder / "points3D.txt", "")


def _lens(model: str, width: int, height: int, numbers: list[float]) -> Lens:
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        numbers = [numbers[0], *numbers]  # one focal length for both axes
    fx_px, fy_px, cx_px, cy_px, *distortion = numbers
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        distortion = [*distortion, 0.0][:2]
    return Lens((width, height), fx_px, fy_px, cx_px - _HALF_PX, cy_px - _HALF_PX, tuple(distortion))


def _camera(lens: Lens) -> tuple[str, int, int, list[float]]:
    """Return a lens as a camera of COLMAP: model, width, height, parameters."""
    distortion = [*lens.distortion, *[0.0] * (8 - len(lens.distortion))]
    core = [lens.fx_px, lens.fy_px, lens.cx_px + _HALF_PX, lens.cy_px + _HALF_PX]
    name = "FULL_OPENCV" if any(distortion[4:]) else "OPENCV" if any(distortion) else "PINHOLE"
    return name, *lens.size_px, [*core, *distortion][: _MODELS[_NUMBERS[name]][1]]


def _pose(numbers: Sequence[float]) -> NDArray[np.float64]:
    w, x, y, z, *translation = numbers
    return np.append(Rotation.from_quat([x, y, z, w]).as_rotvec(), translation)


def _pose_numbers(rt_cam_world: NDArray[np.float64]) -> list[float]:
    x, y, z, w = Rotation.from_rotvec(rt_cam_world[:3]).as_quat().tolist()
    return [w, x, y, z, *rt_cam_world[3:].tolist()]


def _model_name(path: Path, model: str | int) -> str:
    """Return the name of a camera model, from its name or COLMAP's number."""
    number = _NUMBERS.get(model) if isinstance(model, str) else model
    if number not in _MODELS:
        raise BadValue(
            f"{path}: camera model {model} has no counterpart here; let COLMAP undistort the images "
            f"(image_undistorter), or fit {', '.join(_NUMBERS)}"
        )
    return _MODELS[number][0]


def _lines(path: Path) -> list[str]:
    text = read_content(path, _MAX_BYTES).decode()
    return [line for line in text.splitlines() if not line.startswith("#")]


def _cameras_text(path: Path) -> dict[int, Lens]:
    lenses = {}
    for line in filter(str.strip, _lines(path)):
        number, model, width, height, *numbers = line.split()
        name = _model_name(path, model)
        lenses[int(number)] = _lens(name, int(width), int(height), [float(text) for text in numbers])
    return lenses


def _images_text(path: Path) -> list[_Image]:
    images = []
    for line in _lines(path)[::2]:  # every other line lists points, and may be empty
        if line.strip():
            _, *numbers, camera, name = line.split(maxsplit=9)
            if len(numbers) != 7:
                raise ValueError(f"an image has {len(numbers)} numbers of its pose, 7 are expected")
            images.append((name, int(camera), _pose([float(text) for text in numbers])))
    return images


def _cameras_binary(path: Path) -> dict[int, Lens]:
    lenses = {}
    file = io.BytesIO(read_content(path, _MAX_BYTES))
    for _ in range(int(_take(file, "Q")[0])):
        number, model, width, height = _take(file, "iiQQ")
        name = _model_name(path, int(model))
        numbers = _take(file, f"{_MODELS[int(model)][1]}d")
        lenses[int(number)] = _lens(name, int(width), int(height), list(numbers))
    return lenses


def _images_binary(path: Path) -> list[_Image]:
    images = []
    content = read_content(path, _MAX_BYTES)
    file = io.BytesIO(content)
    for _ in range(int(_take(file, "Q")[0])):
        _, *numbers, camera = _take(file, "i7di")
        end = content.index(b"\0", file.tell())
        name = file.read(end - file.tell()).decode()
        file.seek(1, io.SEEK_CUR)
        points = int(_take(file, "Q")[0])
        if file.seek(points * struct.calcsize("<ddq"), io.SEEK_CUR) > len(content):
            raise ValueError(f"{name} states {points} points, more than the file holds")
        images.append((name, int(camera), _pose(numbers)))
    return images


def _take(file: BinaryIO, layout: str) -> tuple[float, ...]:
    return struct.unpack(f"<{layout}", file.read(struct.calcsize(f"<{layout}")))


_READERS = {".bin": (_cameras_binary, _images_binary), ".txt": (_cameras_text, _images_text)}
