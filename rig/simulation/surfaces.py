"""Renders slanted, curved and thin objects by casting rays at their shapes, and knows the true depth of each pixel."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from faintfield.rig.simulation.optics import SimulatedOptics
from faintfield.rig.simulation.scene import RenderedView, pixel_means
from faintfield.rig.simulation.shapes import Scalars, Shape, Vectors, rotate

# Middle of the half of the sky that lights the scene, seen from it: above, left, and on the camera's side.
_SKY = np.array([-0.4, -0.7, -0.6]) / np.linalg.norm([-0.4, -0.7, -0.6])


@dataclass(frozen=True)
class Surface:
    """A shape with a matt texture.

    Parameters
    ----------
    name : str
        Name of the object.
    shape : Shape
        Where it is.
    reflectance : float array (row, column) or (row, column, 3)
        Reflectance 0…1, grey or red, green, blue; a tile that repeats. Its first sample is where the shape's texture
        begins.
    pitch_mm : float
        Distance of neighbouring texture samples.
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
        shade = (1 + rotate(_SKY[np.newaxis], self.shape.normals(points_mm))[0]) / 2
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
        points_mm = camera_mm.astype(np.float32)[:, np.newaxis] + scale[met] * directions[:, met]
        light[met] = surface.light(points_mm)
    return light.reshape(*rays.shape[:2], *light.shape[1:]), first.reshape(rays.shape[:2])


def _directions(rays: NDArray[np.floating], r_ref_cam: NDArray[np.float64]) -> Vectors:
    """Return rays (row, column, 2) at unit depth as directions (3, ray) in the reference frame."""
    x, y = rays.reshape(-1, 2).T
    return rotate(r_ref_cam, np.stack([x, y, np.ones_like(x)]))


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
