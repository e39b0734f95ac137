"""The homographies of a plane: from what a camera sees to where on the plane it lies, and how well that is known."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.lens import Lens

# Step of the central differences over 1 + |value|: rounding and curvature both stay below 1e-6 of a derivative.
_STEP = 1e-6
_POINTS_ACROSS = 5


def fronto_parallel_rt_ref_plane(depth_mm: float) -> NDArray[np.float64]:
    """Return the pose (6,) of the plane across the reference camera's axis at a depth, its origin on the axis."""
    return np.array([0.0, 0.0, 0.0, 0.0, 0.0, depth_mm])


def plane_from_ray(
    rt_cam_ref: NDArray[np.floating],
    rt_ref_plane: NDArray[np.floating],
    principal_shift: NDArray[np.floating] | None = None,
) -> NDArray[np.float64]:
    """Return the homography of each view from rays (x, y, 1) to plane coordinates (X, Y, 1) in mm.

    A point (X, Y) of the plane lies at `R (X r₁ + Y r₂ + o) + t` in a camera of pose (R, t), where r₁, r₂ and o are the
    axes and origin of the plane in the reference frame; so `ray ∝ [R r₁, R r₂, R o + t] (X, Y, 1)`, and the homography
    is the inverse of that 3 x 3 matrix. For a plane across the axis at depth d this is `[r₁ r₂ d·r₃ + t]⁻¹`.

    Parameters
    ----------
    rt_cam_ref : array (view, 6)
        Rodrigues rad and mm, from reference to camera.
    rt_ref_plane : array (6,)
        Rodrigues rad and mm, from plane to reference.
    principal_shift : array (view, 2), optional
        Added to each view's rays x, y: (cx − cx_view) / fx, for views whose principal point is not the camera's.

    Returns
    -------
    array (view, 3, 3)
        Scaled so that the third coordinate of a result is positive where the plane is in front of the camera; a
        camera that lies in the plane sees nothing of it and has all zeros.
    """
    r_ref_plane, _ = cv2.Rodrigues(np.asarray(rt_ref_plane[:3], np.float64))
    homographies = np.zeros((len(rt_cam_ref), 3, 3))
    for view, rt in enumerate(np.asarray(rt_cam_ref, np.float64)):
        r_cam_ref, _ = cv2.Rodrigues(rt[:3])
        ray_from_plane = r_cam_ref @ np.column_stack([r_ref_plane[:, 0], r_ref_plane[:, 1], rt_ref_plane[3:]])
        ray_from_plane[:, 2] += rt[3:]
        shift = np.eye(3)
        if principal_shift is not None:
            shift[:2, 2] = principal_shift[view]
        if np.linalg.cond(ray_from_plane) < 1e12:
            homographies[view] = np.linalg.inv(ray_from_plane) @ shift
    return homographies


def image_lattice(size_px: tuple[int, int], across: int = _POINTS_ACROSS) -> NDArray[np.float64]:
    """Return pixels (point, 2) spread evenly over an image, `across` by `across`, each in the middle of its share."""
    shares = (np.arange(across) + 0.5) / across
    columns, rows = np.meshgrid(shares * size_px[0] - 0.5, shares * size_px[1] - 0.5)
    return np.column_stack([columns.ravel(), rows.ravel()])


def transfer(
    lens: Lens, rt_cam_ref: NDArray[np.floating], rt_ref_plane: NDArray[np.floating], pixels: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return where one view sees what the reference view sees on a plane.

    Parameters
    ----------
    lens : Lens
        Of both.
    rt_cam_ref, rt_ref_plane : array (6,)
        Poses of the view and of the plane, Rodrigues rad and mm.
    pixels : array (point, 2)
        Column, row in the reference view.

    Returns
    -------
    array (point, 2)
        NaN where the plane is not in front of both cameras.
    """
    rays = np.column_stack([lens.rays_at(pixels), np.ones(len(pixels))])
    normal = np.asarray(cv2.Rodrigues(np.asarray(rt_ref_plane[:3], np.float64))[0])[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_mm = normal @ np.asarray(rt_ref_plane[3:]) / (rays @ normal)
        points = rays * np.where(depth_mm > 0, depth_mm, np.nan)[:, np.newaxis]
    rotation = np.asarray(cv2.Rodrigues(np.asarray(rt_cam_ref[:3], np.float64))[0])
    return lens.project(points @ rotation.T + rt_cam_ref[3:])


def transfer_sigma_px(
    lens: Lens,
    rt_cam_ref: NDArray[np.floating],
    covariances: Sequence[NDArray[np.floating]],
    rt_ref_plane: NDArray[np.floating],
    pixels: NDArray[np.floating] | None = None,
) -> NDArray[np.float64]:
    """Return how well the transfer by a plane is known: the covariance of lens and pose carried to pixels.

    With D the derivative of `transfer` by lens and pose, σ² = trace(D Σ Dᵀ): the mean square distance, both axes
    together, by which a pixel of the view is missed.

    Parameters
    ----------
    lens : Lens
        Of all views.
    rt_cam_ref : array (view, 6)
        Poses.
    covariances : sequence of array (4 + distortion + 6, square)
        Per view, of fx, fy, cx, cy, the distortion, and its pose.
    rt_ref_plane : array (6,)
        Of the plane, in any direction.
    pixels : array (point, 2), optional
        In the reference view; a lattice over its image by default.

    Returns
    -------
    array (view, point)
        NaN where the view does not see the point within its image.
    """
    points = image_lattice(lens.size_px) if pixels is None else np.asarray(pixels, np.float64)
    sigma_px = np.full((len(rt_cam_ref), len(points)), np.nan)
    for view, (rt, covariance) in enumerate(zip(np.asarray(rt_cam_ref, float), covariances, strict=True)):
        derivative = _transfer_derivative(lens, rt, rt_ref_plane, points)
        variances = np.einsum("pai,ij,paj->p", derivative, covariance, derivative)
        seen_at = transfer(lens, rt, rt_ref_plane, points)
        seen = ((seen_at >= -0.5) & (seen_at <= np.array(lens.size_px) - 0.5)).all(axis=1)
        sigma_px[view, seen] = np.sqrt(np.maximum(variances[seen], 0))
    return sigma_px


def _transfer_derivative(
    lens: Lens, rt_cam_ref: NDArray[np.float64], rt_ref_plane: NDArray[np.floating], pixels: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the derivative (point, 2, parameter) of `transfer` by lens and pose, from central differences."""
    values = np.array([lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, *lens.distortion, *rt_cam_ref])
    derivative = np.empty((len(pixels), 2, len(values)))
    for index, value in enumerate(values):
        step = _STEP * (1 + abs(value))
        ends = []
        for end in (value + step, value - step):
            moved = values.copy()
            moved[index] = end
            fx_px, fy_px, cx_px, cy_px, *distortion = moved[:-6].tolist()
            moved_lens = Lens(lens.size_px, fx_px, fy_px, cx_px, cy_px, tuple(distortion))
            ends.append(transfer(moved_lens, moved[-6:], rt_ref_plane, pixels))
        derivative[:, :, index] = (ends[0] - ends[1]) / (2 * step)
    return derivative
