"""The ground truth of a simulated set, its object at a depth, and the true depth that an imported set may bring."""

from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.errors import UnreadableImage, WrongSize
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.reading import is_file, read_json
from faintfield.pipelines.formats.results.records import Poses
from faintfield.pipelines.formats.toml_files import inside
from faintfield.pipelines.formats.units import MAX_LIGHT_E

TRUTH_FILE = "truth.json"

# Of an imported set whose scene somebody else rendered.
TRUE_DEPTH_FILE = "true_depth.json"

# A plane within this distance of an object's depth is compared with it.
_SAME_DEPTH_MM = 0.05


class TruePlane(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One object, on the default grid of its depth.

    Attributes
    ----------
    name : str
        Name of the object.
    depth_mm : float
        Depth of the object.
    texture : str
        File of the object's light in expected electrons.
    visible : str
        File of the mask of the region where the reference camera sees it.
    """

    name: str
    depth_mm: float
    texture: str
    visible: str


class TrueSurface(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Light that the reference camera would see without distortion and vignetting, on the samples of its own pixels.

    Attributes
    ----------
    depth_mm : str
        File of the depths along the camera's axis, at the centres of the pixels, NaN at nothing.
    picture : str
        File of the expected electrons, the mean over each pixel.
    """

    depth_mm: str
    picture: str


class Truth(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """`truth.json`: the simulated scene, flat objects or one surface; file names are relative to the set.

    Attributes
    ----------
    snr : float
        Expected signal-to-noise ratio of the true light by eq. (4), a ratio of powers.
    photons_linear, photons_from_moments : float
        Photons per pixel by eq. (7), linear in the SNR; photons per pixel of a uniform object with the same SNR.
    photons_on_object : float
        Mean photons per pixel of the object region in the reference view.
    noise_free : str
        Folder of a set with the same views without noise.
    poses : {"stated", "measured", "aligned", "nominal", "true"}
        Source of the poses that the set states: "true" or "nominal".
    true_rt_cam_ref : list of tuple of float
        True pose of each view: Rodrigues vector in rad and translation in mm, from the reference camera's frame to the
        camera's.
    planes : list of TruePlane
        Flat objects; empty for a surface.
    surface : TrueSurface, optional
        Surface of the scene.
    """

    snr: float
    photons_linear: float
    photons_from_moments: float
    photons_on_object: float
    noise_free: str
    poses: Poses
    true_rt_cam_ref: list[tuple[float, float, float, float, float, float]]
    planes: list[TruePlane]
    surface: TrueSurface | None = None


class TrueDepth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`true_depth.json`: the true depth of each pixel of the reference view, which an imported set brings.

    Attributes
    ----------
    format : 1
        Version of the format.
    depth_mm : str
        File of the depths along the camera's axis, at the centres of the pixels, NaN where there is none.
    source, sha256 : str
        Name of the file that was imported; SHA-256 of that file.
    """

    format: Literal[1]
    depth_mm: str
    source: str
    sha256: str


def read_true_depth_mm(folder: Path) -> NDArray[np.float64] | None:
    """Return the true depth (row, column) of the pixels of the reference view; None for a set without it."""
    path = folder / TRUE_DEPTH_FILE
    if not is_file(path):
        return None
    truth = read_json(path, TrueDepth, what="the true depth of a set", remedy="import the set again, or remove it")
    depth_mm = read_frame(inside(folder, truth.depth_mm, f"{path}: depth_mm")).pixels_dn
    if depth_mm.ndim != 2:
        raise UnreadableImage(f"{folder / truth.depth_mm}: has colours, a depth has none; import the set again")
    return np.asarray(depth_mm, np.float64)


def read_truth(folder: Path) -> Truth | None:
    """Return the ground truth of a simulated set, None for any other."""
    path = folder / TRUTH_FILE
    if not is_file(path):
        return None
    truth = read_json(path, Truth, what="the truth of a simulated set", remedy="simulate the set again, or remove it")
    names = [name for plane in truth.planes for name in (plane.texture, plane.visible)]
    if truth.surface is not None:
        names += [truth.surface.depth_mm, truth.surface.picture]
    for name in (truth.noise_free, *names):
        inside(folder, name, f"{path}: file")
    return truth


def true_plane(truth: Truth | None, depth_mm: float) -> TruePlane | None:
    """Return the object that stands at a depth, None if there is none."""
    planes = [] if truth is None else truth.planes
    return next((plane for plane in planes if abs(plane.depth_mm - depth_mm) < _SAME_DEPTH_MM), None)


def texture_and_region(folder: Path, plane: TruePlane) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return the object's texture (row, column[, colour]) and the region (row, column) where it is visible."""
    texture, visible = (read_frame(folder / name).pixels_dn for name in (plane.texture, plane.visible))
    if visible.shape != texture.shape[:2]:
        raise WrongSize(
            f"{folder / plane.visible}: is {visible.shape}, {plane.texture} {texture.shape[:2]} (rows, columns); "
            "simulate the set again"
        )
    if not (np.abs(texture) <= MAX_LIGHT_E).all():
        raise UnreadableImage(
            f"{folder / plane.texture}: holds light that is not a number of at most {MAX_LIGHT_E:g} electrons; "
            "simulate the set again"
        )
    return texture, visible > 127
