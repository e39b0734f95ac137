"""Planes given by a pose (`--plane-pose`), and the file that states them."""

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
from faintfield.pipelines.formats.toml_files import read_toml

type _Three = tuple[float, float, float]
type _Pose6 = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class TiltedPlane:
    """A plane of any pose; as a `Place` it takes the position of a depth.

    `name` is part of the names of its files. `rt_ref_plane` is Rodrigues rad and mm, from plane to reference. `size_mm`
    is width and height around its origin; the part that the reference view sees if None.
    """

    name: str
    rt_ref_plane: _Pose6
    size_mm: tuple[float, float] | None = None

    @property
    def normal(self) -> NDArray[np.float64]:
        """The plane's z axis in the reference frame."""
        return self._rotation()[:, 2]

    @property
    def depth_mm(self) -> float:
        """Depth at which the axis of the reference camera meets the plane; depth of its origin if it does not."""
        along = float(self.normal @ self._origin_mm())
        meets = along / self.normal[2] if abs(self.normal[2]) > 1e-9 else 0.0
        return float(meets if meets > 0 else self._origin_mm()[2])

    def on_plane(self, rays: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return where rays (ray, 3) of the reference camera meet the plane, x, y in mm; NaN if not in front."""
        with np.errstate(divide="ignore", invalid="ignore"):
            length = (self.normal @ self._origin_mm()) / (rays @ self.normal)
        points = rays * np.where(np.isfinite(length) & (length > 0), length, np.nan)[:, np.newaxis]
        return np.asarray((points - self._origin_mm()) @ self._rotation()[:, :2])

    def _rotation(self) -> NDArray[np.float64]:
        return np.asarray(cv2.Rodrigues(np.array(self.rt_ref_plane[:3], np.float64))[0], np.float64)

    def _origin_mm(self) -> NDArray[np.float64]:
        return np.array(self.rt_ref_plane[3:], np.float64)


# What identifies a plane: its depth in mm if it is perpendicular to the axis of the reference camera, else its pose.
type Place = float | TiltedPlane


class PlanePose(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A plane, by `rt_ref_plane` or by a point and its normal.

    Parameters
    ----------
    name : str
        Name in results and messages.
    rt_ref_plane : 6 floats, optional
        Rodrigues vector in rad, then translation in mm, from plane to reference.
    point_mm, normal : 3 floats, optional
        Point of the plane in the reference frame; direction normal to it.
    size_mm : (float, float), optional
        Width and height around the point or the origin; by default all that the reference view sees.
    """

    name: str
    rt_ref_plane: _Pose6 | None = None
    point_mm: _Three | None = None
    normal: _Three | None = None
    size_mm: tuple[float, float] | None = None


class PlanePoses(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """TOML file of `--plane-pose`: planes at any place and angle, in the reference frame.

    Parameters
    ----------
    format : 1
        Version of the format.
    plane : list of PlanePose
        Planes to reconstruct.
    """

    format: Literal[1]
    plane: list[PlanePose]


def read_plane_poses(paths: Sequence[Path]) -> list[TiltedPlane]:
    """Read the planes of files.

    Each `[[plane]]` has a `name` and either `rt_ref_plane` (Rodrigues rad and mm, from plane to reference) or
    `point_mm` and `normal` in the reference frame; `size_mm` is optional.
    """
    planes: dict[str, TiltedPlane] = {}
    for path in paths:
        poses = read_toml(
            path, PlanePoses, remedy="name a TOML file with a [[plane]] for each plane (docs/how-to/tilt_planes.md)"
        ).plane
        if not poses:
            raise BadValue(f"{path}: names no [[plane]]; add one")
        for pose in poses:
            if pose.name in planes:
                raise BadValue(f"{path}: two planes are called '{pose.name}'; give each a name of its own")
            planes[pose.name] = _plane(path, pose)
    return list(planes.values())


def _plane(path: Path, pose: PlanePose) -> TiltedPlane:
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
    normal *= -1 if normal @ pose.point_mm < 0 else 1  # pointing away from the camera, as z: x then runs along columns
    return TiltedPlane(pose.name, (*_turn_to(normal), *pose.point_mm), pose.size_mm)


def _turn_to(normal: NDArray[np.float64]) -> _Three:
    """Return the smallest rotation (Rodrigues, rad) that turns z to a unit vector."""
    axis = np.cross([0.0, 0.0, 1.0], normal)
    sine, cosine = float(np.linalg.norm(axis)), float(normal[2])
    angle = float(np.arctan2(sine, cosine))
    x, y, z = (axis * (angle / sine) if sine > 1e-12 else np.array([angle, 0.0, 0.0])).tolist()
    return x, y, z


def depth_of(place: Place) -> float:
    """Return the depth in mm at which the axis of the reference camera meets a plane."""
    return place.depth_mm if isinstance(place, TiltedPlane) else place
