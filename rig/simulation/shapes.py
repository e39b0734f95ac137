"""Shapes in space that rays are cast at: a rectangle, a sphere, an open cylinder; each in closed form."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

# Vectors (3, ray), or numbers (ray,): float32 to render, float64 for a truth.
type Vectors = NDArray[np.floating]
type Scalars = NDArray[np.floating]
type Point = tuple[float, float, float]


class Shape(Protocol):
    """Shape that a ray can meet; all coordinates are the reference camera's: x right, y down, z along its axis, mm."""

    def meet(self, origin_mm: NDArray[np.float64], directions: Vectors) -> Scalars:
        """Return s (ray,) of the first point `origin + s · direction`, s > 0, on the shape; inf where there is none."""
        ...

    def normals(self, points_mm: Vectors) -> Vectors:
        """Return the unit normals (3, ray) at points of the shape, towards the side from which it is seen."""
        ...

    def coordinates_mm(self, points_mm: Vectors) -> Vectors:
        """Return where on the shape's texture points (3, ray) lie, as x, y (2, ray)."""
        ...


@dataclass(frozen=True)
class Rectangle:
    """A flat rectangle, without limits by default; its texture begins at its centre.

    Parameters
    ----------
    rt_ref_plane : (float, …) of six
        Rodrigues rotation (rad) and translation (mm) from the rectangle's coordinates, whose origin is its centre, to
        the reference camera's. Unrotated, it faces the camera.
    half_size_mm : (float, float)
        Half of its width and of its height.
    """

    rt_ref_plane: tuple[float, float, float, float, float, float]
    half_size_mm: tuple[float, float] = (np.inf, np.inf)

    @cached_property
    def _axes(self) -> NDArray[np.float64]:
        """The rectangle's axes x, y, z, one per row."""
        return np.asarray(cv2.Rodrigues(np.asarray(self.rt_ref_plane[:3], np.float64))[0].T, np.float64)

    def meet(self, origin_mm: NDArray[np.float64], directions: Vectors) -> Scalars:
        """Solve n · (origin + s · direction - centre) = 0, and keep what lies within the limits."""
        z_of_origin = float(self._axes[2] @ (origin_mm - self.rt_ref_plane[3:]))
        with np.errstate(divide="ignore"):
            scale = -z_of_origin / rotate(self._axes[2:], directions)[0]
        scale = np.where(scale > 0, scale, np.inf)
        if np.isinf(self.half_size_mm).all():
            return scale
        with np.errstate(invalid="ignore"):  # inf · 0
            x, y = np.abs(self.coordinates_mm(_points(origin_mm, directions, scale)))
        return np.where((x <= self.half_size_mm[0]) & (y <= self.half_size_mm[1]), scale, np.inf)

    def normals(self, points_mm: Vectors) -> Vectors:
        """Return the negative z axis: an unrotated rectangle faces the camera."""
        return np.broadcast_to(-self._axes[2][:, np.newaxis].astype(points_mm.dtype), points_mm.shape)

    def coordinates_mm(self, points_mm: Vectors) -> Vectors:
        """Return x, y along the rectangle's axes, from its centre."""
        return rotate(self._axes[:2], _minus(points_mm, self.rt_ref_plane[3:]))


@dataclass(frozen=True)
class Sphere:
    """A sphere; its texture begins at the point nearest to the plane of the cameras."""

    centre_mm: Point
    radius_mm: float

    def meet(self, origin_mm: NDArray[np.float64], directions: Vectors) -> Scalars:
        """Solve |origin + s · direction - centre|² = radius²."""
        return _first_within(origin_mm - self.centre_mm, directions, self.radius_mm)

    def normals(self, points_mm: Vectors) -> Vectors:
        """Return the directions from the centre."""
        return np.asarray(_minus(points_mm, self.centre_mm) / self.radius_mm)

    def coordinates_mm(self, points_mm: Vectors) -> Vectors:
        """Return x, y of the map that keeps distances and directions from the front; its only seam is at the back."""
        x, y, z = self.normals(points_mm)
        across = np.hypot(x, y)
        arc_mm = self.radius_mm * np.arctan2(across, -z)
        return np.asarray(np.stack([x, y]) * (arc_mm / np.maximum(across, 1e-12)))


@dataclass(frozen=True)
class Cylinder:
    """An open cylinder, seen from outside; its texture lies around it and along it."""

    start_mm: Point
    end_mm: Point
    radius_mm: float

    @property
    def length_mm(self) -> float:
        """Distance from start to end."""
        return float(np.linalg.norm(np.subtract(self.end_mm, self.start_mm)))

    @cached_property
    def _axes(self) -> NDArray[np.float64]:
        """Two directions across the cylinder and the one along it, one per row."""
        along = np.subtract(self.end_mm, self.start_mm) / self.length_mm
        across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
        across /= np.linalg.norm(across)
        return np.stack([across, np.cross(along, across), along])

    def meet(self, origin_mm: NDArray[np.float64], directions: Vectors) -> Scalars:
        """Solve for the distance from the axis, and keep what lies between the ends."""
        origin = self._axes @ (origin_mm - self.start_mm)
        *across, along = rotate(self._axes, directions)
        scale = _first_within(origin[:2], np.stack(across), self.radius_mm)
        with np.errstate(invalid="ignore"):  # inf · 0
            height = origin[2].astype(directions.dtype) + scale * along
        return np.where((height >= 0) & (height <= self.length_mm), scale, np.inf)

    def normals(self, points_mm: Vectors) -> Vectors:
        """Return the directions from the axis."""
        from_axis = self._axes[:2].T @ self._axes[:2]
        return np.asarray(rotate(from_axis, _minus(points_mm, self.start_mm)) / self.radius_mm)

    def coordinates_mm(self, points_mm: Vectors) -> Vectors:
        """Return the arc around the cylinder, and the distance from its start."""
        x, y, height = rotate(self._axes, _minus(points_mm, self.start_mm))
        return np.stack([self.radius_mm * np.arctan2(y, x), height])


def rotate(matrix: NDArray[np.floating], vectors: Vectors) -> Vectors:
    """Return `matrix @ vectors` in the precision of the vectors; BLAS would start threads, which here only cost."""
    return np.asarray(np.einsum("ij,jk->ik", matrix.astype(vectors.dtype), vectors))


def _first_within(from_centre_mm: NDArray[np.float64], directions: Vectors, radius_mm: float) -> Scalars:
    """Return s (ray,) at which rays enter a ball, or a disc, around the origin; inf where they pass or leave it.

    The distance of a ray from the centre is taken at its nearest point, as the textbook's b² - 4 a c loses digits.
    """
    start = from_centre_mm.astype(directions.dtype)
    squared = np.einsum("ij,ij->j", directions, directions)
    with np.errstate(divide="ignore", invalid="ignore"):  # rays along the axis of a cylinder have squared = 0
        to_nearest = -rotate(start[np.newaxis], directions)[0] / squared
        passing = _points(start, directions, to_nearest)
        scale = to_nearest - np.sqrt((radius_mm**2 - np.einsum("ij,ij->j", passing, passing)) / squared)
    return np.where(scale > 0, scale, np.inf)


def _points(origin_mm: NDArray[np.floating], directions: Vectors, scale: Scalars) -> Vectors:
    """Return the points (3, ray), or (2, ray), at `scale` along rays."""
    return np.asarray(origin_mm[:, np.newaxis].astype(directions.dtype) + scale * directions)


def _minus(points_mm: Vectors, place_mm: tuple[float, ...]) -> Vectors:
    """Return points relative to a place, in their own precision."""
    return np.asarray(points_mm - np.array(place_mm, points_mm.dtype)[:, np.newaxis])
