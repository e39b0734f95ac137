"""Renders slanted, curved and thin objects by casting rays at their shapes, and knows the true depth of each pixel."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from faintfield.rig.simulation.optics import SimulatedOptics
from faintfield.rig.simulation.scene import RenderedView, pixel_means

# Middle of the half of the sky that lights the scene, seen from it: above, left, and on the camera's side.
_SKY = np.array([-0.4, -0.7, -0.6]) / np.linalg.norm([-0.4, -0.7, -0.6])

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
    """A flat rectangle, without limits by default; its texture begins at its centre. Unrotated, it faces the camera.

    `rt_ref_plane` leads from its coordinates, whose origin is its centre, to the reference camera's: Rodrigues rad and
    mm.
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
            scale = -z_of_origin / _rotate(self._axes[2:], directions)[0]
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
        return _rotate(self._axes[:2], _minus(points_mm, self.rt_ref_plane[3:]))


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

    @cached_property
    def _length_mm(self) -> float:
        return float(np.linalg.norm(np.subtract(self.end_mm, self.start_mm)))

    @cached_property
    def _axes(self) -> NDArray[np.float64]:
        """Two directions across the cylinder and the one along it, one per row."""
        along = np.subtract(self.end_mm, self.start_mm) / self._length_mm
        across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
        across /= np.linalg.norm(across)
        return np.stack([across, np.cross(along, across), along])

    def meet(self, origin_mm: NDArray[np.float64], directions: Vectors) -> Scalars:
        """Solve for the distance from the axis, and keep what lies between the ends."""
        origin = self._axes @ (origin_mm - self.start_mm)
        *across, along = _rotate(self._axes, directions)
        scale = _first_within(origin[:2], np.stack(across), self.radius_mm)
        with np.errstate(invalid="ignore"):  # inf · 0
            height = origin[2].astype(directions.dtype) + scale * along
        return np.where((height >= 0) & (height <= self._length_mm), scale, np.inf)

    def normals(self, points_mm: Vectors) -> Vectors:
        """Return the directions from the axis."""
        from_axis = self._axes[:2].T @ self._axes[:2]
        return np.asarray(_rotate(from_axis, _minus(points_mm, self.start_mm)) / self.radius_mm)

    def coordinates_mm(self, points_mm: Vectors) -> Vectors:
        """Return the arc around the cylinder, and the distance from its start."""
        x, y, height = _rotate(self._axes, _minus(points_mm, self.start_mm))
        return np.stack([self.radius_mm * np.arctan2(y, x), height])


def _rotate(matrix: NDArray[np.floating], vectors: Vectors) -> Vectors:
    """Return `matrix @ vectors` in the precision of the vectors; BLAS would start threads, which here only cost."""
    return np.asarray(np.einsum("ij,jk->ik", matrix.astype(vectors.dtype), vectors))


def _first_within(from_centre_mm: NDArray[np.float64], directions: Vectors, radius_mm: float) -> Scalars:
    """Return s (ray,) at which rays enter a ball, or a disc, around the origin; inf where they pass or leave it.

    The distance of a ray from the centre is taken at its nearest point, as the textbook's b² - 4 a c loses digits.
    """
    start = from_centre_mm.astype(directions.dtype)
    squared = np.einsum("ij,ij->j", directions, directions)
    with np.errstate(divide="ignore", invalid="ignore"):  # rays along the axis of a cylinder have squared = 0
        to_nearest = -_rotate(start[np.newaxis], directions)[0] / squared
        passing = _points(start, directions, to_nearest)
        scale = to_nearest - np.sqrt((radius_mm**2 - np.einsum("ij,ij->j", passing, passing)) / squared)
    return np.where(scale > 0, scale, np.inf)


def _points(origin_mm: NDArray[np.floating], directions: Vectors, scale: Scalars) -> Vectors:
    return np.asarray(origin_mm[:, np.newaxis].astype(directions.dtype) + scale * directions)


def _minus(points_mm: Vectors, place_mm: tuple[float, ...]) -> Vectors:
    return np.asarray(points_mm - np.array(place_mm, points_mm.dtype)[:, np.newaxis])


@dataclass(frozen=True)
class Surface:
    """A shape with a matt texture of reflectance (row, column[, 3]), 0…1, grey or red, green, blue.

    The texture is a tile that repeats, whose samples are `pitch_mm` apart; its first sample is where the shape's
    texture begins.
    """

    name: str
    shape: Shape
    reflectance: NDArray[np.float32]
    pitch_mm: float

    def grey(self) -> "Surface":
        """Return the surface as a sensor without colour filters sees it."""
        return self if self.reflectance.ndim == 2 else replace(self, reflectance=self.reflectance.mean(axis=2))

    def light(self, points_mm: Vectors) -> NDArray[np.float32]:
        """Return the light (ray,) or (ray, 3) from points (3, ray), 1 from a white surface that faces the sky.

        Half of the sky is bright, evenly. A surface whose normal is at an angle θ to the middle of that half receives
        (1 + cos θ) / 2 of it, so that shades are soft, and the same from wherever the point is seen.
        """
        shade = (1 + _rotate(_SKY[np.newaxis], self.shape.normals(points_mm))[0]) / 2
        columns, rows = self.shape.coordinates_mm(points_mm) / self.pitch_mm
        tiles = self.reflectance if self.reflectance.ndim == 3 else self.reflectance[:, :, np.newaxis]
        colours = [
            map_coordinates(tile, [rows, columns], order=1, mode="grid-wrap") for tile in np.moveaxis(tiles, 2, 0)
        ]
        light = np.stack(colours, axis=-1) * shade[:, np.newaxis]
        return np.asarray(light if self.reflectance.ndim == 3 else light[:, 0], np.float32)


def render_surfaces(
    surfaces: Sequence[Surface],
    optics: SimulatedOptics,
    poses_rt_cam_ref: NDArray[np.float64],
    *,
    samples_per_px: int = 2,
) -> Iterator[RenderedView]:
    """Yield the view of each pose: each ray shows the first surface that it meets, black if it meets none.

    The surfaces are all grey or all in colour; the other parameters are those of `scene.render`.
    """
    rays = optics.rays(samples_per_px)
    illumination = optics.relative_illumination()
    for pose in poses_rt_cam_ref:
        light, first = _cast(surfaces, rays, pose)
        visible = {
            surface.name: pixel_means((first == index).astype(np.float32), samples_per_px)
            for index, surface in enumerate(surfaces)
        }
        means = pixel_means(light, samples_per_px)
        yield RenderedView(means * illumination.reshape(illumination.shape + (1,) * (means.ndim - 2)), visible)


def true_depth_mm(surfaces: Sequence[Surface], optics: SimulatedOptics) -> NDArray[np.float64]:
    """Return the depth (row, column) along the axis of the reference camera at its pixel centres, NaN at nothing."""
    rays = optics.rays().astype(np.float64)
    depth_mm, _ = _first_met(surfaces, np.zeros(3), _directions(rays, np.eye(3)))
    return np.where(np.isfinite(depth_mm), depth_mm, np.nan).reshape(rays.shape[:2])


def _cast(
    surfaces: Sequence[Surface], rays: NDArray[np.float32], rt_cam_ref: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Return the light (row, column[, 3]) along each ray, and the index (row, column) of the surface that it shows."""
    r_cam_ref = cv2.Rodrigues(np.asarray(rt_cam_ref[:3], np.float64))[0]
    camera_mm = -r_cam_ref.T @ np.asarray(rt_cam_ref[3:], np.float64)
    directions = _directions(rays, r_cam_ref.T)
    scale, first = _first_met(surfaces, camera_mm, directions)
    light = np.zeros((scale.size, *surfaces[0].reflectance.shape[2:]), np.float32)
    for index, surface in enumerate(surfaces):
        met = np.flatnonzero(first == index)
        light[met] = surface.light(_points(camera_mm, directions[:, met], scale[met]))
    return light.reshape(*rays.shape[:2], *light.shape[1:]), first.reshape(rays.shape[:2])


def _directions(rays: NDArray[np.floating], r_ref_cam: NDArray[np.float64]) -> Vectors:
    """Return rays (row, column, 2) at unit depth as directions (3, ray) in the reference frame."""
    x, y = rays.reshape(-1, 2).T
    return _rotate(r_ref_cam, np.stack([x, y, np.ones_like(x)]))


def _first_met(
    surfaces: Sequence[Surface], origin_mm: NDArray[np.float64], directions: Vectors
) -> tuple[Scalars, NDArray[np.intp]]:
    """Return s (ray,) of the first point that each ray meets, inf if none, and the index of its surface, -1 if none.

    As directions have unit length along the camera's axis, s is the depth in the camera.
    """
    scale = np.full(directions.shape[1], np.inf, directions.dtype)
    first = np.full(directions.shape[1], -1)
    for index, surface in enumerate(surfaces):
        here = surface.shape.meet(origin_mm, directions)
        nearer = here < scale
        scale[nearer] = here[nearer]
        first[nearer] = index
    return scale, first
