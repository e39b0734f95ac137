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
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from faintfield.calib.errors import LensNotInvertible
from faintfield.calib.homography import rotation_matrix
from faintfield.calib.lens import Lens
from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import BadValue, MissingFile, WrongBitDepth, WrongSize, WrongUsage
from faintfield.pipelines.formats.exchange.imported_light import (
    NoiseOrigin,
    Pictures,
    Tone,
    complete_noise,
    light_unit,
    tone_of,
    without_curve,
)
from faintfield.pipelines.formats.exchange.options import GridOptions, ImportOptions, LensOptions
from faintfield.pipelines.formats.files import check_free, require_room, sha256, write_json, writing_folder
from faintfield.pipelines.formats.frames import RAW_SUFFIXES, Frame, exif_exposure_s, picture_kind, read_frame
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
from faintfield.pipelines.formats.sets.elemental_set import stated_length
from faintfield.pipelines.formats.sets.session_set import load_set_or_session
from faintfield.pipelines.formats.units import MAX_ANGLE_RAD, MAX_LENGTH_MM, Units

# Pixels along each side of a picture in which a stated lens is checked.
_CHECKED_PIXELS = 33

# Largest error of the columns of a rotation in length and right angles, as rounded numbers have it.
_ROTATION_TOLERANCE = 1e-2


@dataclass(frozen=True)
class PosedImage:
    """An image, its lens, and the camera's pose (6,) in a world of any origin, Rodrigues rad and any unit."""

    path: Path
    lens: Lens
    rt_cam_world: NDArray[np.float64]
    node: tuple[int, int] | None = None


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


def import_posed(
    out: Path, files: Sequence[Path], posed: Sequence[PosedImage], options: ImportOptions, command: str
) -> ImportedSet:
    """Make an elemental set of the images of a model in some files; without the length of its unit, poses are relative.

    Raises
    ------
    MissingFile, BadValue
        An image is missing, a pose is not finite, or the reference is none of the images.
    """
    if not posed:
        raise BadValue(f"{files[-1]}: names no image; export a model of the images")
    scale = np.repeat([1.0, options.mm_per_unit or 1.0], 3)
    images = [
        replace(image, rt_cam_world=image.rt_cam_world * scale, node=node)
        for image, node in zip(posed, _nodes(posed), strict=True)
    ]
    for image, original in zip(images, posed, strict=True):
        _check_image(image, original)
    index = _reference(images, options.reference)
    require_room_for_copies(out, read_picture(images[0].path), len(images))
    write_imported_set(
        out,
        options,
        images,
        reference=index,
        command=command,
        recorded={name: getattr(options, name) for name in ("mm_per_unit", "reference", "exposure_s")},
        models=files,
        units=Units() if options.mm_per_unit else Units(depth="relative"),
    )
    width, height = images[index].lens.size_px
    inform(f"{out}: {len(images)} views of {width} x {height} px")
    return ImportedSet(str(out), len(images), images[index].path.name)


def export_posed(
    set_path: Path,
    out: Path,
    unit: str,
    held: Sequence[str],
    write: Callable[[Path, list[PosedImage]], None],
    *,
    overwrite: bool,
) -> ExportedSet:
    """Write lens and poses of a set or session into a folder, by `write` from the folder and the views.

    Lengths are in `unit`, or relative. An earlier export, a folder with files of the patterns `held` only, is replaced
    to `overwrite`.
    """
    check_free(out, replace_only=held, overwrite=overwrite)
    elemental_set = load_set_or_session(set_path)
    points_px = elemental_set.principal_points_px.tolist()
    parts = zip(elemental_set.settings.view, points_px, elemental_set.poses_rt_cam_ref, strict=True)
    views = [
        PosedImage(Path(view.image), replace(elemental_set.lens, cx_px=cx_px, cy_px=cy_px), pose)
        for view, (cx_px, cy_px), pose in parts
    ]
    unit = stated_length(elemental_set, unit)
    with writing_folder(out, replace_only=held, overwrite=overwrite) as folder:
        write(folder, views)
    inform(f"{out}: {len(views)} views, {'relative lengths' if unit == 'relative' else f'lengths in {unit}'}")
    return ExportedSet(str(out), len(views), unit)


def _check_image(image: PosedImage, original: PosedImage) -> None:
    """Refuse an image that is missing, and a pose that is not finite or too large, in the words of the model."""
    if not is_file(image.path):
        raise MissingFile(f"{image.path}: has a pose but is missing; put it there, or name its folder with --images")
    if not (np.abs(image.rt_cam_world) <= np.repeat([MAX_ANGLE_RAD, MAX_LENGTH_MM], 3)).all():
        raise BadValue(
            f"{image.path}: its pose {original.rt_cam_world.tolist()} is not finite, or beyond {MAX_ANGLE_RAD:g} rad "
            f"or {MAX_LENGTH_MM:g} mm; calibrate again, or remove it"
        )


def _reference(images: Sequence[PosedImage], name: str | None) -> int:
    """Return the index of the image asked for, or of the one nearest to the middle of all cameras."""
    if name is not None:
        matches = [index for index, image in enumerate(images) if image.path.name == Path(name).name]
        if not matches:
            raise BadValue(f"--reference {name}: is none of the {len(images)} images with a pose; name one of them")
        return matches[0]
    centres = np.array([-rotation_matrix(i.rt_cam_world).T @ i.rt_cam_world[3:] for i in images])
    return int(np.argmin(np.linalg.norm(centres - centres.mean(axis=0), axis=1)))


def _nodes(images: Sequence[PosedImage]) -> Sequence[tuple[int, int] | None]:
    """Return the rows and columns in names such as view_r3_c12.tiff; None for each if the names are not of a grid."""
    matches = [re.search(r"r([0-9]{1,5})_c([0-9]{1,5})$", image.path.stem) for image in images]
    nodes = [(int(numbers[1]), int(numbers[2])) for numbers in matches if numbers is not None]
    return nodes if len(set(nodes)) == len(images) else [None] * len(images)


def stated_lens(size_px: tuple[int, int], fx_px: float, fy_px: float, options: LensOptions | GridOptions) -> Lens:
    """Return the lens of the options, whose principal point is the middle of the picture by default.

    Raises WrongUsage for a lens that cannot be, and LensNotInvertible for one that folds the picture.
    """
    middle_x, middle_y = ((side - 1) / 2 for side in size_px)
    cx_px = middle_x if options.cx_px is None else options.cx_px
    cy_px = middle_y if options.cy_px is None else options.cy_px
    try:
        lens = Lens(size_px, fx_px, fy_px, cx_px, cy_px, options.distortion)
    except ValueError as failure:
        raise WrongUsage(f"the lens of the options cannot be: {failure}; correct them") from failure
    # A lattice of pixels, and the corners
    x, y = (np.linspace(0, side - 1, _CHECKED_PIXELS) for side in size_px)
    try:
        lens.rays_at(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    except LensNotInvertible as failure:
        numbers = " ".join(f"--distortion {number:g}" for number in options.distortion)
        raise LensNotInvertible(
            f"{numbers}: folds the picture of {size_px[0]} x {size_px[1]} px onto itself; correct signs and order (k1, "
            "k2, p1, p2, k3 …), or --fx-px"
        ) from failure
    return lens


def check_set_free(out: Path, options: ImportOptions | GridOptions, *sources: Path) -> None:
    """Refuse a folder that an imported set cannot be written to, before anything is read; see `check_free`."""
    check_free(out, replace_if=FILE_NAME, overwrite=options.overwrite, reads=sources)


def require_room_for_copies(out: Path, first: Frame, count: int) -> None:
    """Refuse an import whose pictures, all as large as the first one, do not fit on the disk; see `require_room`."""
    size_bytes = count * first.pixels_dn.size * np.dtype(np.uint16).itemsize
    require_room(out, size_bytes, written_bytes=size_bytes)


def write_imported_set(
    out: Path,
    options: ImportOptions | GridOptions,
    images: Sequence[PosedImage],
    *,
    reference: int,
    command: str,
    recorded: dict[str, Any],
    units: Units,
    models: Sequence[Path] = (),
    sources: Sequence[Path] = (),
    arrangement: Arrangement | None = None,
    also: Callable[[Path], None] | None = None,
) -> None:
    """Copy images into an elemental set whose reference frame is the camera of one of them.

    What the options do not state of the sensor is estimated from the views, or assumed and said so. Light is stated in
    what noise and tone allow. `also` writes further files into the folder of the set. For the record are the command,
    its options `recorded`, and the files that lens and poses were read from, `models`, and that images were unpacked
    from, `sources`, by default the images' own; none of these is overwritten.

    Raises
    ------
    BadValue
        The lenses differ in more than their principal points, two images would have one name, or a dark current is
        stated but no exposure.
    WrongSize, WrongBitDepth
        The images are not alike, or not of the size of their lens.
    """
    lens, path = images[reference].lens, images[0].path
    first = read_picture(path)
    _check_lenses([image.lens for image in images], path, first)
    exposure_s = options.exposure_s or first.exposure_s or exif_exposure_s(path)
    sensor = options if isinstance(options, GridOptions) else GridOptions()
    if exposure_s is None and sensor.dark_current_e_per_s:
        raise BadValue(
            f"{path}: states no exposure, without which {sensor.dark_current_e_per_s:g} dark electrons per second mean "
            "nothing; give --exposure-s"
        )
    tone = tone_of(path, first, options)
    inputs = [*models, *(sources or [image.path for image in images])]
    with writing_folder(out, replace_if=FILE_NAME, overwrite=options.overwrite, reads=inputs) as folder:
        views = [
            _view(_copy(image.path, folder, first, tone), image, images[reference])
            for image in progress(images, "copying pictures")
        ]
        lossy = picture_kind(inputs[-1]) == ".jpg"  # whose compression changes values, and with them the noise
        complete, origin = complete_noise(sensor, Pictures(folder, views, first, tone, lossy))
        settings = ElementalSetFile(
            format=1,
            exposure_s=exposure_s,
            reference_view=reference,
            units=msgspec.structs.replace(units, light=light_unit(sensor, tone)),
            arrangement=arrangement,
            camera=Camera(lens.size_px, lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, lens.distortion),
            noise=complete,
            view=views,
        )
        write_set(folder, settings)
        if also is not None:
            also(folder)
        made = msgspec.to_builtins(provenance(command, recorded, {path.name: sha256(path) for path in inputs}))
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
    cam, ref = (rotation_matrix(rt) for rt in (rt_cam_world, rt_ref_world))
    rotation = cam @ ref.T
    return np.append(cv2.Rodrigues(rotation)[0].ravel(), rt_cam_world[3:] - rotation @ rt_ref_world[3:])


def pose_of(rotation: ArrayLike, centre: ArrayLike) -> NDArray[np.float64]:
    """Return the pose rt_cam_world (6,) of a camera at a place (3,) in the world, in the unit of that place.

    The columns of the rotation (3, 3) are the camera's x (right), y (down) and z (forward) in the world.

    Raises
    ------
    ValueError
        The matrix is no rotation: it is not finite, stretches, or mirrors.
    """
    matrix = np.asarray(rotation, np.float64)
    # Elements beyond 2 are refused before their squares, which may overflow
    if not (np.abs(matrix) <= 2).all() or not np.allclose(matrix.T @ matrix, np.eye(3), atol=_ROTATION_TOLERANCE):
        raise ValueError("its rotation is not finite, or has columns that are not of length 1 and at right angles")
    if np.linalg.det(matrix) < 0:
        raise ValueError("its rotation mirrors the world")
    to_camera = Rotation.from_matrix(matrix).inv()
    return np.append(to_camera.as_rotvec(), -to_camera.apply(np.asarray(centre, np.float64)))


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
