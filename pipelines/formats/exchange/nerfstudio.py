"""`transforms.json` of nerfstudio and instant-ngp: lens and poses of images.

There a pose is the matrix from camera to world, of a camera that looks along its −z with y up (OpenGL); here cameras
look along +z with y down. There the first pixel's centre is at (0.5, 0.5), here at (0, 0).
"""

import math
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from faintfield.calib.lens import Lens
from faintfield.pipelines.errors import BadValue, MissingFile, WrongUsage
from faintfield.pipelines.formats.exchange.grid_names import picture_named
from faintfield.pipelines.formats.exchange.imported_set import (
    ExportedSet,
    ImportedSet,
    PosedImage,
    check_set_free,
    export_posed,
    import_posed,
    pose_of,
)
from faintfield.pipelines.formats.exchange.options import ImportOptions
from faintfield.pipelines.formats.files import write_json
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.reading import is_file, is_folder, read_json

FILE_NAME = "transforms.json"

_HALF_PX = 0.5

# A camera of OpenGL in axes of OpenCV: x stays, y and z point the other way.
_FLIP = np.diag([1.0, -1.0, -1.0])

# Lenses that have a counterpart here; None is that of instant-ngp, which names none.
_MODELS = (None, "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")

_WRITTEN_MODEL = "OPENCV"

type _Row = tuple[float, float, float, float]


class _Intrinsics(msgspec.Struct, omit_defaults=True, kw_only=True):
    """A lens; a frame may state its own values of each."""

    camera_model: str | None = None
    w: float | None = None
    h: float | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    k1: float | None = None
    k2: float | None = None
    p1: float | None = None
    p2: float | None = None
    k3: float | None = None
    k4: float | None = None
    camera_angle_x: float | None = None
    camera_angle_y: float | None = None
    is_fisheye: bool | None = None


class _Frame(_Intrinsics, omit_defaults=True, kw_only=True):
    """An image: its file beside this one, with or without suffix, and its camera's pose."""

    file_path: str
    transform_matrix: Annotated[list[_Row], msgspec.Meta(min_length=3, max_length=4)]


class _Transforms(_Intrinsics, omit_defaults=True, kw_only=True):
    """The file."""

    frames: list[_Frame]


def import_transforms(src: Path, out: Path, options: ImportOptions) -> ImportedSet:
    """Make an elemental set of a `transforms.json` and its images."""
    check_set_free(out, options)
    path = src / FILE_NAME if is_folder(src) else src
    return import_posed(out, [path], read_transforms(path, options.images), options, "import nerfstudio")


def export_transforms(set_path: Path, out: Path, *, overwrite: bool) -> ExportedSet:
    """Write the lens and poses of a set or session as a `transforms.json` of images that are to lie beside it.

    Raises
    ------
    WrongUsage
        `out` is the name of a file.
    BadValue
        The distortion has terms for which nerfstudio has no names.
    """
    if out.suffix == ".json" and not is_folder(out):
        raise WrongUsage(f"{out}: is the name of a file, and {FILE_NAME} is written into a folder; name the folder")
    return export_posed(set_path, out, "mm", [FILE_NAME], _write_transforms, overwrite=overwrite)


def read_transforms(path: Path, images: Path | None = None) -> list[PosedImage]:
    """Return the images of a `transforms.json` with their lenses and poses, in its own unit.

    Names of images count from the folder `images`, by default from that of the file.

    Raises
    ------
    MissingFile
        There is no such file.
    BadValue
        It is damaged, a lens has no counterpart here, a pose is none, or a name leads out of the folder.
    """
    if not is_file(path):
        raise MissingFile(f"{path}: no such file; name a {FILE_NAME} or the folder that holds it")
    remedy = "export it again"
    content = read_json(path, _Transforms, what=f"a {FILE_NAME} that can be read", remedy=remedy)
    folder = images or path.parent
    posed: list[PosedImage] = []
    sizes: dict[Path, tuple[int, int]] = {}
    for index, frame in enumerate(content.frames):
        place = f"{path}: frames[{index}]"
        image = picture_named(folder, frame.file_path, f"{place}.file_path")
        try:
            lens = _lens(content, frame, image, sizes)
            matrix = np.array(frame.transform_matrix)[:3]
            pose = pose_of(matrix[:, :3] @ _FLIP, matrix[:, 3])
        except (ValueError, OverflowError) as failure:
            raise BadValue(f"{place} ({frame.file_path}): {failure}; {remedy}") from failure
        posed.append(PosedImage(image, lens, pose))
    return posed


def _lens(content: _Transforms, frame: _Frame, image: Path, sizes: dict[Path, tuple[int, int]]) -> Lens:
    """Return the lens of a frame: its own values, else those of the file, else what follows from the picture's size.

    `sizes` keeps the size of the first picture, which is read if the file states none.
    """
    own = {name: value for name, value in msgspec.structs.asdict(frame).items() if value is not None}
    values = msgspec.structs.asdict(content) | own
    model = values["camera_model"]
    fisheye = frame.is_fisheye or content.is_fisheye
    if model not in _MODELS or fisheye or values["k4"]:
        kind = "k4" if values["k4"] else model if model not in _MODELS else "is_fisheye"
        raise ValueError(f"its lens has no counterpart here ({kind}); undistort the images to a pinhole camera")
    width, height = values["w"], values["h"]
    if width is None or height is None:
        if not sizes:
            sizes[image] = read_frame(image).pixels_dn.shape[1::-1]
        width, height = next(iter(sizes.values()))
    if not float(width).is_integer() or not float(height).is_integer():
        raise ValueError(f"w, h = {width:g}, {height:g} are no whole numbers of pixels")
    fx_px, fy_px = (_focal_px(values, *names) for names in ((width, "fl_x", "x"), (height, "fl_y", "y")))
    if fx_px is None:
        raise ValueError("states neither fl_x nor camera_angle_x")
    cx_px = width / 2 if values["cx"] is None else values["cx"]
    cy_px = height / 2 if values["cy"] is None else values["cy"]
    distortion = tuple(values[name] or 0.0 for name in ("k1", "k2", "p1", "p2", "k3"))
    return Lens(
        (int(width), int(height)),
        fx_px,
        fx_px if fy_px is None else fy_px,
        cx_px - _HALF_PX,
        cy_px - _HALF_PX,
        distortion if any(distortion) else (),
    )


def _focal_px(values: dict[str, Any], size: float, name: str, axis: str) -> float | None:
    """Return the focal length that is stated, or that of a picture that spans the angle that is stated."""
    focal_px: float | None = values[name]
    angle = values[f"camera_angle_{axis}"]
    if focal_px is not None or angle is None:
        return focal_px
    if not 0 < angle < math.pi:
        raise ValueError(f"camera_angle_{axis} = {angle:g} rad is not between 0 and π")
    return 0.5 * size / math.tan(0.5 * angle)


def _write_transforms(folder: Path, views: list[PosedImage]) -> None:
    lenses = dict.fromkeys(view.lens for view in views)
    shared = views[0].lens if len(lenses) == 1 else None
    if any(any(lens.distortion[5:]) for lens in lenses):
        raise BadValue(
            f"{views[0].path}: its lens has the distortion {list(views[0].lens.distortion)}, of which transforms.json "
            "holds the first five terms; calibrate with --lens opencv5, or export COLMAP"
        )
    frames = [
        _Frame(
            file_path=str(view.path),
            transform_matrix=_matrix(view.rt_cam_world),
            **({} if shared is not None else _intrinsics(view.lens)),
        )
        for view in views
    ]
    whole = {"camera_model": _WRITTEN_MODEL} if shared is None else _intrinsics(shared)
    write_json(folder / FILE_NAME, _Transforms(**whole, frames=frames))


def _matrix(rt_cam_world: NDArray[np.float64]) -> list[_Row]:
    to_world = Rotation.from_rotvec(rt_cam_world[:3]).inv()
    rows = np.column_stack([to_world.as_matrix() @ _FLIP, -to_world.apply(rt_cam_world[3:])]).tolist()
    return [(a, b, c, d) for a, b, c, d in [*rows, [0.0, 0.0, 0.0, 1.0]]]


def _intrinsics(lens: Lens) -> dict[str, Any]:
    k1, k2, p1, p2, k3 = [*lens.distortion, *[0.0] * 5][:5]
    values: dict[str, Any] = {"camera_model": _WRITTEN_MODEL, "w": lens.size_px[0], "h": lens.size_px[1]}
    values |= {"fl_x": lens.fx_px, "fl_y": lens.fy_px, "cx": lens.cx_px + _HALF_PX, "cy": lens.cy_px + _HALF_PX}
    return values | {"k1": k1, "k2": k2, "p1": p1, "p2": p2} | ({"k3": k3} if k3 else {})
