"""Elemental sets made of copies of other pictures, with the lens and poses that other programs found."""

import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.lens import Lens
from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import BadValue, MissingFile, WrongBitDepth, WrongSize
from faintfield.pipelines.formats.exchange.imported_noise import NoiseOrigin, Pictures, StatedNoise, complete_noise
from faintfield.pipelines.formats.exchange.options import ImportOptions
from faintfield.pipelines.formats.exchange.tone import Tone, asked_tone, tone_of, without_curve
from faintfield.pipelines.formats.files import sha256, write_json, writing_folder
from faintfield.pipelines.formats.frames import RAW_SUFFIXES, Frame, exif_exposure_s, read_frame
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.provenance import Provenance, provenance
from faintfield.pipelines.formats.reading import is_file
from faintfield.pipelines.formats.sets.elemental_file import (
    FILE_NAME,
    Arrangement,
    Camera,
    ElementalSetFile,
    View,
    write_set,
)
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.formats.units import MAX_ANGLE_RAD, MAX_LENGTH_MM, Units

# Files whose compression changes values, and with them the noise.
_LOSSY_SUFFIXES = {".jpg", ".jpeg"}


@dataclass(frozen=True)
class PosedImage:
    """An image, its lens, and the camera's pose in a world of any origin, (6,), Rodrigues rad and mm."""

    path: Path
    lens: Lens
    rt_cam_world: NDArray[np.float64]
    node: tuple[int, int] | None = None


@dataclass(frozen=True)
class PosedModel:
    """Another program's model: the files that it was read from, and its images."""

    files: list[Path]
    images: list[PosedImage]


class ImportProvenance(Provenance[dict[str, Any]], frozen=True, kw_only=True):
    """Record of an import: the tone curve, which was undone, and where its gain and read noise come from."""

    tone: Tone
    noise: NoiseOrigin


class ImportedSet(msgspec.Struct, frozen=True):
    """The result of an import: the folder, the number of views, and the image whose camera is the reference."""

    out: str
    views: int
    reference: str


class ExportedSet(msgspec.Struct, frozen=True):
    """The result of an export: the file or folder, the number of views, and the unit of lengths, or "relative"."""

    out: str
    views: int
    unit: str


def import_posed(out: Path, model: PosedModel, options: ImportOptions, command: str) -> ImportedSet:
    """Make an elemental set of the images of a model.

    Without a length of its unit, poses are relative. Light is in DN, or relative of pictures of 8 bits.

    Raises
    ------
    MissingFile, BadValue
        An image is missing, a pose is not finite, or the reference is none of the images.
    """
    if not model.images:
        raise BadValue(f"{model.files[-1]}: names no image; export a model of the images")
    mm_per_unit = options.mm_per_unit
    _check_images(model.images, mm_per_unit or 1.0)
    scale = np.repeat([1.0, mm_per_unit or 1.0], 3)
    images = [
        replace(image, rt_cam_world=image.rt_cam_world * scale, node=node)
        for image, node in zip(model.images, _nodes(model.images), strict=True)
    ]
    index = _reference(images, options.reference)
    write_imported_set(
        out,
        images,
        reference=index,
        noise=StatedNoise(),
        exposure_s=options.exposure_s,
        tone=asked_tone(linear=options.linear, srgb=options.srgb),
        command=command,
        options={name: getattr(options, name) for name in ("mm_per_unit", "reference", "exposure_s")},
        models=model.files,
        units=None if mm_per_unit else Units(depth="relative"),
        overwrite=options.overwrite,
    )
    width, height = images[index].lens.size_px
    inform(f"{out}: {len(images)} views of {width} x {height} px")
    return ImportedSet(str(out), len(images), images[index].path.name)


def _check_images(images: Sequence[PosedImage], mm_per_unit: float) -> None:
    """Refuse images that are missing, and poses that are not finite or too large."""
    limits = np.repeat([MAX_ANGLE_RAD, MAX_LENGTH_MM / mm_per_unit], 3)
    for image in images:
        if not is_file(image.path):
            raise MissingFile(
                f"{image.path}: has a pose but is missing; put it there, or name its folder with --images"
            )
        if not (np.abs(image.rt_cam_world) <= limits).all():
            raise BadValue(
                f"{image.path}: its pose {image.rt_cam_world.tolist()} is not finite, or beyond {MAX_ANGLE_RAD:g} rad "
                f"or {MAX_LENGTH_MM:g} mm; calibrate again, or remove it"
            )


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
    found = [re.search(r"r([0-9]{1,5})_c([0-9]{1,5})$", image.path.stem) for image in images]
    nodes = [(int(numbers[1]), int(numbers[2])) for numbers in found if numbers is not None]
    return nodes if len(set(nodes)) == len(images) else [None] * len(images)


def write_imported_set(
    out: Path,
    images: Sequence[PosedImage],
    *,
    reference: int,
    noise: StatedNoise,
    exposure_s: float | None,
    tone: Tone | None = None,
    command: str,
    options: dict[str, Any],
    models: Sequence[Path] = (),
    sources: Sequence[Path] | None = None,
    units: Units | None = None,
    arrangement: Arrangement | None = None,
    also: Callable[[Path], None] | None = None,
    overwrite: bool,
) -> None:
    """Copy images into an elemental set whose reference frame is the camera of one of them.

    Parameters
    ----------
    reference : int
        Index of the image whose camera is the reference.
    noise : StatedNoise
        What is stated of the sensor; what is not is estimated from the views, or assumed and said so.
    exposure_s : float, optional
        Exposure of each image; by default what the first one states, and not known if it states none.
    tone : {"linear", "srgb"}, optional
        The tone curve of the images; by default that of sRGB for 8-bit images, and none for others.
    units : Units, optional
        What depths are stated in; light is stated in what noise and tone allow.
    models : sequence of Path
        Files that lens and poses were read from, for the record; no file that is read is overwritten.
    sources : sequence of Path, optional
        Files that the images were unpacked from, for the record; the images' own by default.
    arrangement : Arrangement, optional
        What was found in the pictures of a grid.
    also : callable, optional
        Writes further files into the folder of the set.

    Raises
    ------
    BadValue
        The lenses differ in more than their principal points, two images would have one name, or a dark current is
        stated but no exposure.
    WrongSize, WrongBitDepth
        The images are not alike, or not of the size of their lens.
    """
    lens = images[reference].lens
    first = read_picture(images[0].path)
    _check_lenses([image.lens for image in images], images[0].path, first)
    exposure_s = exposure_s or first.exposure_s or exif_exposure_s(images[0].path)
    noise.check_exposure(images[0].path, exposure_s)
    tone = tone_of(images[0].path, first, tone)
    inputs = [*models, *([image.path for image in images] if sources is None else sources)]
    with writing_folder(out, replace_if=FILE_NAME if overwrite else None, reads=inputs) as folder:
        views = [
            _view(_copy(image.path, folder, first, tone), image, images[reference])
            for image in progress(images, "copying pictures")
        ]
        lossy = inputs[-1].suffix.lower() in _LOSSY_SUFFIXES
        pictures = Pictures(folder, views, first, tone, lossy)
        complete, origin = complete_noise(noise, pictures)
        camera = Camera(lens.size_px, lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, lens.distortion)
        settings = ElementalSetFile(
            format=1,
            exposure_s=exposure_s,
            reference_view=reference,
            units=msgspec.structs.replace(units or Units(), light=noise.light_unit(tone)),
            arrangement=arrangement,
            camera=camera,
            noise=complete,
            view=views,
        )
        write_set(folder, settings)
        if also is not None:
            also(folder)
        hashes = {path.name: sha256(path) for path in inputs}
        made = msgspec.to_builtins(provenance(command, options, hashes))
        write_json(folder / "provenance.json", ImportProvenance(**made, tone=tone, noise=origin))


def read_picture(path: Path, expected_px: tuple[int, int] | None = None) -> Frame:
    """Read a picture, of the size of the first one if that is given; only pixels of 8 or 16 bits are accepted."""
    frame = read_frame(path, expected_px, of="the first picture")
    if frame.pixels_dn.dtype not in (np.uint8, np.uint16):
        raise BadValue(
            f"{path}: holds {frame.pixels_dn.dtype} pixels; 8- or 16-bit whole numbers are needed; convert it"
        )
    return frame


def relative(rt_cam_world: NDArray[np.float64], rt_ref_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rt_cam_ref (6,): a camera's pose relative to another's."""
    cam, ref = (np.asarray(cv2.Rodrigues(np.asarray(rt[:3], np.float64))[0]) for rt in (rt_cam_world, rt_ref_world))
    rotation = cam @ ref.T
    return np.append(cv2.Rodrigues(rotation)[0].ravel(), rt_cam_world[3:] - rotation @ rt_ref_world[3:])


def _check_lenses(lenses: Sequence[Lens], path: Path, first: Frame) -> None:
    """Refuse several lenses, and a lens of another size than the first picture."""
    count = len({replace(lens, cx_px=0.0, cy_px=0.0) for lens in lenses})
    if count > 1:
        raise BadValue(
            f"{path}: it and the others have {count} lenses; a camera on a gantry has one lens, of which only the "
            "principal point may differ; calibrate all images as one camera (COLMAP: ImageReader.single_camera)"
        )
    height, width = first.pixels_dn.shape[:2]
    if (width, height) != lenses[0].size_px:
        raise WrongSize(
            f"{path}: is {width} x {height} px, its lens {lenses[0].size_px[0]} x {lenses[0].size_px[1]} px; "
            "name the folder of the images that were calibrated"
        )


def _view(name: str, image: PosedImage, reference: PosedImage) -> View:
    """Return an image as a view; it states a principal point only if that differs from the camera's."""
    rx, ry, rz, x, y, z = relative(image.rt_cam_world, reference.rt_cam_world).tolist()
    own = {key: getattr(image.lens, key) for key in ("cx_px", "cy_px")}
    own = {key: value for key, value in own.items() if value != getattr(reference.lens, key)}
    return View(name, (rx, ry, rz, x, y, z), image.node, **own)


def _copy(path: Path, folder: Path, first: Frame, tone: Tone) -> str:
    """Copy a picture as it is, or as linear 16-bit TIFF if it has 8 bits or a curve; return its name in the set."""
    pixels = read_picture(path, first.pixels_dn.shape[1::-1]).pixels_dn
    if pixels.shape != first.pixels_dn.shape:
        raise WrongSize(
            f"{path}: is {pixels.shape}, the first picture {first.pixels_dn.shape} (rows, columns, colours); "
            "all must be alike; take it again or leave it out"
        )
    if pixels.dtype != first.pixels_dn.dtype:
        raise WrongBitDepth(
            f"{path}: has {8 * pixels.itemsize} bits per pixel, the first picture {8 * first.pixels_dn.itemsize}; "
            "all pictures of a set saturate at one value; export all of them alike"
        )
    as_it_is = path.suffix.lower() in RAW_SUFFIXES or (tone == "linear" and pixels.dtype == np.uint16)
    name = path.name if as_it_is else f"{path.stem}.tiff"
    if (folder / name).exists():
        raise BadValue(f"{path}: would become {name} like another picture; give it another name")
    if as_it_is:
        shutil.copyfile(path, folder / name)
    else:
        light = without_curve(pixels, first.saturation_dn) if tone == "srgb" else pixels.astype(np.uint16)
        write_frame(folder / name, light)
    return name


def lens_of_each_view(elemental_set: ElementalSet) -> list[Lens]:
    """Return the lens of each view: the camera's, with the principal point of the view."""
    return [
        replace(elemental_set.lens, cx_px=cx_px, cy_px=cy_px)
        for cx_px, cy_px in elemental_set.principal_points_px().tolist()
    ]
