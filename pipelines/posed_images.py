"""An elemental set made of images whose lens and poses another program found."""

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.lens import Lens
from pipelines.console import say
from pipelines.elemental_set import Camera, ElementalSet, Noise, View, write_set
from pipelines.errors import BadValue, MissingFile
from pipelines.files import building_folder, sha256, write_json
from pipelines.frames import read_frame
from pipelines.image_files import write_frame
from pipelines.provenance import provenance


@dataclass(frozen=True)
class PosedImage:
    """An image and the camera's pose in a world of any origin, (6,), Rodrigues rad and mm."""

    path: Path
    rt_cam_world: NDArray[np.float64]


def write_posed_set(
    out: Path,
    lens: Lens,
    images: Sequence[PosedImage],
    *,
    reference: str | None,
    exposure_s: float | None,
    command: str,
    options: dict[str, object],
    overwrite: bool,
) -> str:
    """Copy images into an elemental set whose frame is that of one of them; return that one's name.

    Raises
    ------
    MissingFile, BadValue
        An image is missing, two have one name, or the reference is none of them.
    """
    for image in images:
        if not image.path.is_file():
            raise MissingFile(
                f"{image.path}: has a pose but is missing; put it there, or name its folder with --images"
            )
    names = [image.path.stem for image in images]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:  # they are copied into one folder
        raise BadValue(f"two images are named {twice}; give each image a name of its own, whatever folder it lies in")
    index = _reference(images, reference)
    exposure_s = exposure_s or read_frame(images[index].path).exposure_s
    if exposure_s is None:
        say("the pictures do not state their exposure; 1 s is assumed, which matters for dark current only")
    with building_folder(out, replace_if="elemental.toml" if overwrite else None) as folder:
        camera = Camera(lens.size_px, lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, lens.distortion)
        views = [
            View(
                _copy(image.path, folder),
                _tuple(relative(image.rt_cam_world, images[index].rt_cam_world)),
                _node(image),
            )
            for image in images
        ]
        nodes = [view.node for view in views]
        if None in nodes or len(set(nodes)) < len(nodes):  # names that are not of a grid say nothing
            views = [View(view.image, view.rt_cam_ref) for view in views]
        peak = float(np.iinfo(read_frame(images[0].path).pixels_dn.dtype).max)
        noise = Noise(gain_dn_per_e=1.0, read_noise_e=0.0, offset_dn=0.0, saturation_dn=peak)
        write_set(folder, ElementalSet(1, exposure_s or 1.0, index, camera, noise, views))
        inputs = {image.path.name: sha256(image.path) for image in images}
        write_json(folder / "provenance.json", provenance(command, options, inputs))
    say(f"{out}: {len(images)} views; state the sensor's [noise] in elemental.toml, or run `faintfield noise`")
    return images[index].path.name


def relative(rt_cam_world: NDArray[np.float64], rt_ref_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rt_cam_ref (6,): a camera's pose relative to another's."""
    cam, ref = (np.asarray(cv2.Rodrigues(np.asarray(rt[:3], np.float64))[0]) for rt in (rt_cam_world, rt_ref_world))
    rotation = cam @ ref.T
    return np.append(cv2.Rodrigues(rotation)[0].ravel(), rt_cam_world[3:] - rotation @ rt_ref_world[3:])


def _reference(images: Sequence[PosedImage], name: str | None) -> int:
    """Return the image asked for, or that nearest to the middle of all cameras."""
    if name is not None:
        found = [index for index, image in enumerate(images) if image.path.name == Path(name).name]
        if not found:
            raise BadValue(f"--reference {name}: is none of the {len(images)} images with a pose; name one of them")
        return found[0]
    centres = np.array([-cv2.Rodrigues(i.rt_cam_world[:3])[0].T @ i.rt_cam_world[3:] for i in images])
    return int(np.argmin(np.linalg.norm(centres - centres.mean(axis=0), axis=1)))


def _node(image: PosedImage) -> tuple[int, int] | None:
    """Return the row and column in names such as view_r3_c12.tiff."""
    numbers = re.search(r"r(\d+)_c(\d+)$", image.path.stem)
    return None if numbers is None else (int(numbers[1]), int(numbers[2]))


def _copy(path: Path, folder: Path) -> str:
    """Copy an image; 8-bit ones become 16-bit TIFF with the same values."""
    pixels = read_frame(path).pixels_dn
    if pixels.dtype != np.uint8:
        shutil.copyfile(path, folder / path.name)
        return path.name
    write_frame(folder / f"{path.stem}.tiff", pixels.astype(np.uint16))
    return f"{path.stem}.tiff"


def _tuple(rt: NDArray[np.float64]) -> tuple[float, float, float, float, float, float]:
    rx, ry, rz, x, y, z = rt.tolist()
    return rx, ry, rz, x, y, z
