"""Models of other programs: images with poses in a world and a unit of their own, imported as an elemental set."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np

from faintfield.calib.lens import Lens
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.exchange.imported_set import PosedImage, PosedModel, write_imported_set
from faintfield.pipelines.formats.sets.elemental_file import Noise
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet


class ImportedSet(msgspec.Struct, frozen=True):
    """The result of an import: the folder, the number of views, and the image whose camera is the reference."""

    out: str
    views: int
    reference: str


def import_posed(
    out: Path,
    model: PosedModel,
    *,
    mm_per_unit: float,
    reference: str | None,
    exposure_s: float | None,
    command: str,
    overwrite: bool,
) -> ImportedSet:
    """Make an elemental set of the images of a model, whose poses are in units of `mm_per_unit`.

    Raises
    ------
    MissingFile, BadValue
        An image is missing, a pose is not finite, or the reference is none of the images.
    """
    _check_images(model.images)
    scale = np.repeat([1.0, mm_per_unit], 3)
    images = [
        replace(image, rt_cam_world=image.rt_cam_world * scale, node=node)
        for image, node in zip(model.images, _nodes(model.images), strict=True)
    ]
    index = _reference(images, reference)
    write_imported_set(
        out,
        images,
        reference=index,
        noise=Noise(gain_dn_per_e=1.0, read_noise_e=0.0),
        exposure_s=exposure_s,
        command=command,
        options={"mm_per_unit": mm_per_unit, "reference": reference, "exposure_s": exposure_s},
        models=model.files,
        overwrite=overwrite,
    )
    inform(f"{out}: {len(images)} views; state the sensor's [noise] in elemental.toml, or run `faintfield noise`")
    return ImportedSet(str(out), len(images), images[index].path.name)


def _check_images(images: Sequence[PosedImage]) -> None:
    """Refuse images that are missing, and poses that are not finite."""
    for image in images:
        if not image.path.is_file():
            raise MissingFile(
                f"{image.path}: has a pose but is missing; put it there, or name its folder with --images"
            )
        if not np.isfinite(image.rt_cam_world).all():
            raise BadValue(
                f"{image.path}: its pose {image.rt_cam_world.tolist()} is not finite; calibrate again, or remove it"
            )


def lens_of_each_view(loaded: ElementalSet) -> list[Lens]:
    """Return the lens of each view: the camera's, with the principal point of the view."""
    return [replace(loaded.lens, cx_px=cx_px, cy_px=cy_px) for cx_px, cy_px in loaded.principal_points_px().tolist()]


def _reference(images: Sequence[PosedImage], name: str | None) -> int:
    """Return the index of the image asked for, or of the one nearest to the middle of all cameras."""
    if name is not None:
        found = [index for index, image in enumerate(images) if image.path.name == Path(name).name]
        if not found:
            raise BadValue(f"--reference {name}: is none of the {len(images)} images with a pose; name one of them")
        return found[0]
    centres = np.array([-cv2.Rodrigues(i.rt_cam_world[:3])[0].T @ i.rt_cam_world[3:] for i in images])
    return int(np.argmin(np.linalg.norm(centres - centres.mean(axis=0), axis=1)))


def _nodes(images: Sequence[PosedImage]) -> Sequence[tuple[int, int] | None]:
    """Return the rows and columns in names such as view_r3_c12.tiff; None for each if the names are not of a grid."""
    found = [re.search(r"r(\d+)_c(\d+)$", image.path.stem) for image in images]
    nodes = [(int(numbers[1]), int(numbers[2])) for numbers in found if numbers is not None]
    return nodes if len(set(nodes)) == len(images) else [None] * len(images)
