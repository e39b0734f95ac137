"""`elemental.toml`, the format in which anyone states images and poses: its tables, read, checked and written."""

from collections import Counter
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from faintfield.calib.lens import Lens
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.reading import is_file
from faintfield.pipelines.formats.toml_files import inside, read_toml, write_toml
from faintfield.pipelines.formats.units import MAX_EXPOSURE_S, MAX_PERIOD_PX, Node, Pose, Units, sound_mosaic

FILE_NAME = "elemental.toml"

# Largest pose of the reference view that counts as zero, in rad and mm: less than any calibration resolves.
_ZERO_POSE = np.array([1e-6] * 3 + [1e-3] * 3)


class Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """The `[camera]` table: lens and detector of all views.

    Parameters
    ----------
    size_px : (int, int)
        Width and height of the detector.
    fx_px, fy_px, cx_px, cy_px : float
        Focal length along x; focal length along y; column of the principal point, where the centre of the first pixel
        is 0; row of the principal point, where the centre of the first pixel is 0.
    distortion : tuple of float
        k1, k2, p1, p2, k3, k4, k5, k6 in OpenCV's order; may be shorter.
    mosaic : tuple of str, optional
        Colour filters, row by row, such as ["RG", "GB"]; raw files state their own.
    flat : str, optional
        Name of the image with the relative response of each pixel, in the folder of the set.
    """

    size_px: tuple[int, int]
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()
    mosaic: tuple[str, ...] | None = None
    flat: str | None = None

    @property
    def lens(self) -> Lens:
        """The lens; ValueError if it is impossible."""
        return Lens(self.size_px, self.fx_px, self.fy_px, self.cx_px, self.cy_px, self.distortion)

    def with_lens(self, lens: Lens) -> "Camera":
        """Return the camera with another lens."""
        numbers = {name: getattr(lens, name) for name in ("fx_px", "fy_px", "cx_px", "cy_px", "distortion")}
        return msgspec.structs.replace(self, **numbers)


class Noise(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """The `[noise]` table: noise of the sensor. The name of a `noise.json` may take its place.

    Parameters
    ----------
    gain_dn_per_e, read_noise_e : float
        System gain; standard deviation of the read noise of a pixel.
    offset_dn : float, optional
        Dark level; by default that of the masked pixels of a raw file.
    dark_current_e_per_s : float
        Dark current of a pixel in electrons per second.
    quantum_efficiency : float, optional
        Electrons per photon; without it no result is given in photons.
    saturation_dn : float, optional
        Value from which a pixel is saturated; by default that of a raw file, and none for other images.
    estimated : bool
        True if gain or read noise was not measured: an import estimated it from the views, or assumed it.
    """

    gain_dn_per_e: float
    read_noise_e: float
    offset_dn: float | None = None
    dark_current_e_per_s: float = 0.0
    quantum_efficiency: float | None = None
    saturation_dn: float | None = None
    estimated: bool = False


class View(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """One `[[view]]`: an image and the pose it was taken from.

    Parameters
    ----------
    image : str
        File in the folder of the set.
    rt_cam_ref : 6 floats
        Rodrigues vector in rad, then translation in mm, from the reference to the camera; zero for the reference view.
    node : (int, int), optional
        Row and column in the grid.
    cx_px, cy_px : float, optional
        Principal point of this view, where it differs from that of the camera.
    repeats : tuple of str
        Further frames of the view, added to the first.
    homing : int
        Number of homings of the stage before the view; measured poses are shifted as `faintfield geometry` found.
    """

    image: str
    rt_cam_ref: Pose
    node: Node | None = None
    cx_px: float | None = None
    cy_px: float | None = None
    repeats: tuple[str, ...] = ()
    homing: int = 0


class Arrangement(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """The `[arrangement]` table: arrangement of a grid of pictures, as an import found it.

    Parameters
    ----------
    disparity_range_px : (float, float), optional
        Least and largest disparity of the scene: pixels by which points move from one node to the next, right or down.
    told_by : {"pictures", "signs", "names", "options"}
        Source of the order of rows and columns. "pictures": parts that near objects hide. "signs": the sign of all
        disparities, negative where pictures are not aligned. "names": only the names of the files. "options": options
        of the command.
    transposed, rows_flipped, columns_flipped : bool
        True if the first number of a name is the column; true if rows were reversed to run down; true if columns were
        reversed to run right.
    aligned : bool, optional
        True if the pictures are aligned (rectified) on a plane in the scene; left out if this is not known.
    pitch_ratio : float
        Pitch along columns over pitch along rows. If it is not 1, the range of disparities is that down a column of the
        grid.
    missing : tuple of (int, int)
        Nodes without a view.
    odd_views : tuple of str
        Pictures that were left out, as they fit none of their neighbours.
    turn_deg : float
        Largest rotation of a view about its axis, relative to the others.
    relative_light : tuple of float
        Mean light of each view over the median of all views; empty if they do not differ.
    irregular : bool
        True if views are shifted, turned or magnified, compared with a regular grid.
    """

    disparity_range_px: tuple[float, float] | None = None
    told_by: Literal["pictures", "signs", "names", "options"] = "names"
    transposed: bool = False
    rows_flipped: bool = False
    columns_flipped: bool = False
    aligned: bool | None = None
    pitch_ratio: float = 1.0
    missing: tuple[tuple[int, int], ...] = ()
    odd_views: tuple[str, ...] = ()
    turn_deg: float = 0.0
    relative_light: tuple[float, ...] = ()
    irregular: bool = False


class ElementalSetFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`elemental.toml`: views with lens, poses and noise.

    Parameters
    ----------
    format : 1
        Version of the format.
    exposure_s : float, optional
        Exposure of all frames of a view together; left out if it is not known.
    reference_view : int
        Number of the view whose camera is the reference frame, from 0.
    units, arrangement, camera, view : Units, Arrangement, Camera, list of View
        Units of the set; arrangement of the grid, as an import found it; camera and lens; the views.
    noise : Noise or str
        A table, or the name of a `noise.json` in the folder.
    """

    format: Literal[1]
    exposure_s: float | None = None
    reference_view: int
    units: Units = Units()
    arrangement: Arrangement | None = None
    camera: Camera
    noise: Noise | str
    view: list[View]


def read_set_file(path: Path) -> ElementalSetFile:
    """Read and check `elemental.toml`, and that the files it names are there."""
    remedy = f"name a session, or a folder with {FILE_NAME}; `faintfield import` makes one"
    settings = read_toml(path, ElementalSetFile, remedy=remedy)
    check_settings(path, settings)
    for name in named_files(settings):
        if not is_file(inside(path.parent, name, f"{path}: file")):
            raise MissingFile(f"{path}: {name} is named but missing in {path.parent}; put it there or remove its entry")
    return settings


def check_settings(path: Path, settings: ElementalSetFile) -> None:
    """Refuse impossible exposures, mosaics, poses and views (BadValue); the path stands in the message."""
    _check_numbers(path, settings)
    _check_views(path, settings)


def write_set(folder: Path, settings: ElementalSetFile) -> None:
    """Write `elemental.toml`. Write the images first, so that a folder with this file is complete."""
    write_toml(folder / FILE_NAME, settings)


def named_files(settings: ElementalSetFile) -> list[str]:
    """Return the names of the files that `elemental.toml` names."""
    optional = [settings.camera.flat, settings.noise if isinstance(settings.noise, str) else None]
    images = [name for view in settings.view for name in (view.image, *view.repeats)]
    return [*(name for name in optional if name is not None), *images]


def _check_numbers(path: Path, settings: ElementalSetFile) -> None:
    if settings.exposure_s is not None and not 0 < settings.exposure_s <= MAX_EXPOSURE_S:
        raise BadValue(
            f"{path}: exposure_s = {settings.exposure_s}; it must be positive and at most {MAX_EXPOSURE_S:g}: give the "
            "exposure in seconds"
        )
    if settings.exposure_s is None and isinstance(settings.noise, Noise) and settings.noise.dark_current_e_per_s:
        raise BadValue(
            f"{path}: noise.dark_current_e_per_s = {settings.noise.dark_current_e_per_s:g} has no meaning without an "
            "exposure; give exposure_s"
        )
    mosaic = settings.camera.mosaic
    if mosaic is not None and not sound_mosaic(mosaic, "RGB"):
        raise BadValue(
            f"{path}: camera.mosaic = {list(mosaic)}; give rows of equal length, at most {MAX_PERIOD_PX}, of the "
            'letters R, G and B, such as ["RG", "GB"]'
        )


def _check_views(path: Path, settings: ElementalSetFile) -> None:
    count = len(settings.view)
    if not 0 <= settings.reference_view < count:
        raise BadValue(
            f"{path}: reference_view = {settings.reference_view}, but there are {count} views; give 0…{count - 1}"
        )
    reference = np.array(settings.view[settings.reference_view].rt_cam_ref)
    if (np.abs(reference) > _ZERO_POSE).any():
        raise BadValue(
            f"{path}: view[{settings.reference_view}] is the reference but its pose is {reference.tolist()}; "
            "poses are relative to the reference view, whose own is zero"
        )
    images = [("image", name) for view in settings.view for name in (view.image, *view.repeats)]
    nodes = [("node", view.node) for view in settings.view if view.node is not None]
    (key, name), count = Counter([*images, *nodes]).most_common(1)[0]
    if count > 1:
        raise BadValue(f"{path}: {key} = {name} is named by more than one view; give each view its own")
    counts = {1 + len(view.repeats) for view in settings.view}
    if len(counts) > 1:
        raise BadValue(f"{path}: views have {min(counts)} to {max(counts)} frames; give all of them as many repeats")
