"""Planes given by a pose (`--plane-pose`): read from a file, and where their samples lie."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.sets.elemental_set import LoadedSet
from faintfield.pipelines.formats.toml_files import read_toml
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.operator.grid import PlaneGrid

# A plane that is seen at a grazing angle has a large part far away.
_MOST_SAMPLES_PER_PIXEL = 16

type _Three = tuple[float, float, float]


@dataclass(frozen=True)
class TiltedPlane:
    """A plane of any pose; wherever planes are told apart by their depth, it stands for itself.

    Attributes
    ----------
    name : str
        Its files are named after it.
    rt_ref_plane : tuple of 6 floats
        Rodrigues rad and mm, from plane to reference.
    size_mm : (float, float), optional
        Width and height around its origin; what the reference view sees of it when None.
    """

    name: str
    rt_ref_plane: tuple[float, ...]
    size_mm: tuple[float, float] | None = None

    @property
    def normal(self) -> NDArray[np.float64]:
        """Its z axis in the reference frame."""
        return self._rotation()[:, 2]

    @property
    def depth_mm(self) -> float:
        """Where the axis of the reference camera meets the plane; the depth of its origin where it does not."""
        along = float(self.normal @ self._origin_mm())
        meets = along / self.normal[2] if abs(self.normal[2]) > 1e-9 else 0.0
        return float(meets if meets > 0 else self._origin_mm()[2])

    def on_plane(self, rays: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return where rays (ray, 3) of the reference camera meet the plane, x, y in mm; NaN where not in front."""
        with np.errstate(divide="ignore", invalid="ignore"):
            length = (self.normal @ self._origin_mm()) / (rays @ self.normal)
        points = rays * np.where(np.isfinite(length) & (length > 0), length, np.nan)[:, np.newaxis]
        return np.asarray((points - self._origin_mm()) @ self._rotation()[:, :2])

    def _rotation(self) -> NDArray[np.float64]:
        return np.asarray(cv2.Rodrigues(np.array(self.rt_ref_plane[:3], np.float64))[0], np.float64)

    def _origin_mm(self) -> NDArray[np.float64]:
        return np.array(self.rt_ref_plane[3:], np.float64)


# What planes are told apart by: a depth in mm is that of a plane across the reference camera's axis.
type Place = float | TiltedPlane


class _Pose(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    rt_ref_plane: tuple[float, float, float, float, float, float] | None = None
    point_mm: _Three | None = None
    normal: _Three | None = None
    size_mm: tuple[float, float] | None = None


class _Poses(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    format: Literal[1]
    plane: list[_Pose]


def read_plane_poses(paths: Sequence[Path]) -> list[TiltedPlane]:
    """Read the planes of files.

    Its `[[plane]]` have a `name` and either `rt_ref_plane` (Rodrigues rad and mm, from plane to reference) or
    `point_mm` and `normal` in the reference frame, and may have `size_mm`.

    Raises
    ------
    MissingFile, UnknownKey, BadValue
        A file is not such a one, or two planes share a name.
    """
    planes: dict[str, TiltedPlane] = {}
    for path in paths:
        poses = read_toml(path, _Poses).plane
        if not poses:
            raise BadValue(f"{path}: names no [[plane]]; add one")
        for pose in poses:
            if pose.name in planes:
                raise BadValue(f"{path}: two planes are called '{pose.name}'; give each a name of its own")
            planes[pose.name] = _plane(path, pose)
    return list(planes.values())


def _plane(path: Path, pose: _Pose) -> TiltedPlane:
    """Return one plane, refusing what is none."""
    where = f"{path}: plane '{pose.name}'"
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9-]{0,39}", pose.name):
        raise BadValue(f"{where}: is no name for files; take a letter and then letters, digits or hyphens, 40 at most")
    given = (pose.rt_ref_plane is not None, pose.point_mm is not None, pose.normal is not None)
    if given not in ((True, False, False), (False, True, True)):
        raise BadValue(f"{where}: has no pose, or two; give either rt_ref_plane, or point_mm and normal")
    if pose.size_mm is not None and not min(pose.size_mm) > 0:
        raise BadValue(f"{where}: size_mm = {list(pose.size_mm)} is no size; give a width and a height above zero")
    if pose.rt_ref_plane is not None:
        return TiltedPlane(pose.name, pose.rt_ref_plane, pose.size_mm)
    assert pose.point_mm is not None
    assert pose.normal is not None
    length = float(np.linalg.norm(pose.normal))
    if not length > 0:
        raise BadValue(f"{where}: normal = {list(pose.normal)} has no direction; give one")
    normal = np.array(pose.normal) / length
    normal *= -1 if normal @ pose.point_mm < 0 else 1  # away from the camera, as z is: x then runs along columns
    return TiltedPlane(pose.name, (*_turn_to(normal), *pose.point_mm), pose.size_mm)


def _turn_to(normal: NDArray[np.float64]) -> tuple[float, ...]:
    """Return the smallest rotation (Rodrigues, rad) that turns z to a unit vector."""
    axis = np.cross([0.0, 0.0, 1.0], normal)
    sine, cosine = float(np.linalg.norm(axis)), float(normal[2])
    angle = float(np.arctan2(sine, cosine))
    return tuple((axis * (angle / sine) if sine > 1e-12 else np.array([angle, 0.0, 0.0])).tolist())


def tilted_grid(loaded: LoadedSet, plane: TiltedPlane, pitch_mm: float) -> PlaneGrid:
    """Return the samples of a plane: of its stated size, or as much as the reference view sees of it.

    Raises
    ------
    GeometryMismatch
        A part of the reference view does not meet the plane in front of the camera, or only very far away.
    """
    width, height = loaded.settings.camera.size_px
    if not plane.depth_mm > 0:
        raise GeometryMismatch(
            f"plane '{plane.name}': lies behind the camera, at {plane.depth_mm:g} mm along its axis; z points forward: "
            "correct its pose"
        )
    if plane.size_mm is not None:
        low, high = -np.array(plane.size_mm) / 2, np.array(plane.size_mm) / 2
    else:
        columns, rows = np.meshgrid(np.linspace(-0.5, width - 0.5, 3), np.linspace(-0.5, height - 0.5, 3))
        camera = loaded.settings.camera
        shift_px = np.array([camera.cx_px, camera.cy_px]) - loaded.principal_points_px()[loaded.reference_view]
        rays = loaded.lens.rays_at(np.column_stack([columns.ravel(), rows.ravel()]) + shift_px)
        points = plane.on_plane(np.column_stack([rays, np.ones(len(rays))]))
        if np.isnan(points).any():
            raise GeometryMismatch(
                f"plane '{plane.name}': a part of the reference view does not meet it in front of the camera; "
                "give it a size_mm, or correct its pose"
            )
        low, high = points.min(axis=0), points.max(axis=0)
    samples, most = float(np.prod((high - low) / pitch_mm)), _MOST_SAMPLES_PER_PIXEL * width * height
    if samples > most:
        raise GeometryMismatch(
            f"plane '{plane.name}': has {samples:.3g} samples, and at most {most:.3g} make sense, "
            f"{_MOST_SAMPLES_PER_PIXEL} per detector pixel; give it a size_mm, or a larger --pitch-mm"
        )
    try:
        return PlaneGrid.covering(float(low[0]), float(low[1]), float(high[0]), float(high[1]), pitch_mm)
    except ValueError as failure:
        raise GeometryMismatch(f"plane '{plane.name}': {failure}") from failure


def depth_of(place: Place) -> float:
    """Return where the axis of the reference camera meets a plane, in mm."""
    return place.depth_mm if isinstance(place, TiltedPlane) else place


def words_of(place: Place) -> str:
    """Return what messages call a plane."""
    return f"'{place.name}'" if isinstance(place, TiltedPlane) else f"{place:g} mm"
