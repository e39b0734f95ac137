"""Renders scenes of textured planes that occlude one another, by casting rays."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.rig.simulation.optics import SimulatedOptics


@dataclass(frozen=True)
class TexturedPlane:
    """A flat object in space: a picture (row, column[, 3]) of reflectance 0…1, grey or red, green, blue.

    Opacity (row, column) is 1 on the object, 0 outside it, and between them at its edge. Samples are `pitch_mm` apart.
    `rt_ref_plane` leads from the plane's coordinates, whose origin is the centre of the texture, to the reference
    camera's: Rodrigues rad and mm.
    """

    name: str
    reflectance: NDArray[np.float32]
    opacity: NDArray[np.float32]
    pitch_mm: float
    rt_ref_plane: tuple[float, float, float, float, float, float]

    @cached_property
    def texture(self) -> NDArray[np.float32]:
        """Reflectance times opacity, and opacity, (row, column, 2 or 4); cached because every view samples it."""
        reflected = self.reflectance * _for_colours(self.opacity, self.reflectance.shape[2:])
        return np.dstack([reflected, self.opacity]).astype(np.float32)

    @property
    def depth_mm(self) -> float:
        """Distance of the centre along the axis of the reference camera."""
        return self.rt_ref_plane[5]

    def grey(self) -> "TexturedPlane":
        """Return the plane as a sensor without colour filters sees it."""
        if self.reflectance.ndim == 2:
            return self
        return TexturedPlane(self.name, self.reflectance.mean(axis=2), self.opacity, self.pitch_mm, self.rt_ref_plane)


@dataclass(frozen=True)
class RenderedView:
    """One rendered view.

    `light` (row, column[, 3]) is the mean reflectance in each pixel, times the relative illumination of the lens;
    `visible` (row, column) is the share of each pixel in which an object is visible, by its name.
    """

    light: NDArray[np.float32]
    visible: dict[str, NDArray[np.float32]]


def render(
    planes: Sequence[TexturedPlane],
    optics: SimulatedOptics,
    poses_rt_cam_ref: NDArray[np.float64],
    *,
    samples_per_px: int = 2,
) -> Iterator[RenderedView]:
    """Yield the view of each pose (view, 6), casting the ray of every detector sample through the planes, near to far.

    The planes are all grey or all in colour. They must not intersect, since they are ordered by the depth of their
    centres. Each pixel is the mean of `samples_per_px` rays per axis; several reduce aliasing.
    """
    rays = optics.rays(samples_per_px)
    colours = planes[0].reflectance.shape[2:]
    illumination = _for_colours(optics.relative_illumination(), colours)
    for pose in poses_rt_cam_ref:
        light = np.zeros((*rays.shape[:2], *colours), np.float32)
        unhidden = np.ones(rays.shape[:2], np.float32)
        visible = {}
        for plane in sorted(planes, key=partial(_depth_in_camera_mm, pose)):
            reflected, opacity = _sample(plane, rays, pose)
            light += reflected * _for_colours(unhidden, colours)
            visible[plane.name] = pixel_means(opacity * unhidden, samples_per_px)
            unhidden *= 1 - opacity
        yield RenderedView(pixel_means(light, samples_per_px) * illumination, visible)


def _depth_in_camera_mm(rt_cam_ref: NDArray[np.float64], plane: TexturedPlane) -> float:
    return float(_plane_in_camera(plane, rt_cam_ref)[0][2])


def _for_colours(grey: NDArray[np.float32], colours: tuple[int, ...]) -> NDArray[np.float32]:
    return grey.reshape(grey.shape + (1,) * len(colours))


def _sample(
    plane: TexturedPlane, rays: NDArray[np.float32], rt_cam_ref: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return reflectance times opacity, and opacity, where each ray meets a plane."""
    origin_mm, axis_x, axis_y = _plane_in_camera(plane, rt_cam_ref)
    normal = np.cross(axis_x, axis_y)
    # The ray s·(x, y, 1) meets the plane at s = n·origin / n·ray. Relative to the origin, that point has coordinates
    # along the plane's axes that are ratios of two linear functions of the ray
    numerators = np.stack(
        [axis @ (np.eye(3) * (normal @ origin_mm) - np.outer(origin_mm, normal)) for axis in (axis_x, axis_y)]
    )
    linear = np.vstack([numerators, normal]).astype(np.float32)
    x, y, scale = (row[0] * rays[:, :, 0] + row[1] * rays[:, :, 1] + row[2] for row in linear)
    in_front = scale * np.float32(normal @ origin_mm) > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        columns = np.where(in_front, x / scale / plane.pitch_mm + (plane.opacity.shape[1] - 1) / 2, -10)
        rows = np.where(in_front, y / scale / plane.pitch_mm + (plane.opacity.shape[0] - 1) / 2, -10)
    place = columns.astype(np.float32), rows.astype(np.float32)
    samples = cv2.remap(plane.texture, *place, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    reflected = samples[:, :, :-1]
    return (reflected if plane.reflectance.ndim == 3 else reflected[:, :, 0]), samples[:, :, -1]


def _plane_in_camera(
    plane: TexturedPlane, rt_cam_ref: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the origin (mm) and the two axes of a plane in camera coordinates."""
    r_cam_ref, _ = cv2.Rodrigues(np.asarray(rt_cam_ref[:3], np.float64))
    r_ref_plane, _ = cv2.Rodrigues(np.asarray(plane.rt_ref_plane[:3], np.float64))
    r_cam_plane = r_cam_ref @ r_ref_plane
    origin_mm = r_cam_ref @ np.asarray(plane.rt_ref_plane[3:]) + rt_cam_ref[3:]
    return origin_mm, r_cam_plane[:, 0], r_cam_plane[:, 1]


def pixel_means(samples: NDArray[np.float32], samples_per_px: int) -> NDArray[np.float32]:
    """Return the mean of the samples of each pixel, (row, column, …)."""
    if samples_per_px == 1:
        return samples
    size = (samples.shape[1] // samples_per_px, samples.shape[0] // samples_per_px)
    return np.asarray(cv2.resize(samples, size, interpolation=cv2.INTER_AREA), np.float32)
