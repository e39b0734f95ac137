"""Homographies from camera rays to points of a plane, and the transfer between two views by a plane."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.lens import Lens

# Step of the central differences over 1 + |value|: rounding and curvature both stay below 1e-6 of a derivative.
_STEP = 1e-6

# Points along each side of the default lattice of an image.
_POINTS_ACROSS = 5


def rotation_matrix(rt: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the rotation matrix (3, 3) of a pose (6,), Rodrigues rad and mm."""
    return np.asarray(cv2.Rodrigues(np.asarray(rt[:3], np.float64))[0], np.float64)


def fronto_parallel_rt_ref_plane(depth_mm: float) -> NDArray[np.float64]:
    """Return the pose of the plane at a depth normal to the reference camera's axis, its origin on the axis.

    Parameters
    ----------
    depth_mm : float
        Distance of the plane from the reference camera.

    Returns
    -------
    float array (6,)
        rt_ref_plane: Rodrigues rad and mm, from plane to reference.

    Examples
    --------
    >>> from faintfield import fronto_parallel_rt_ref_plane
    >>> fronto_parallel_rt_ref_plane(depth_mm=500.0)
    array([  0.,   0.,   0.,   0.,   0., 500.])
    """
    return np.array([0.0, 0.0, 0.0, 0.0, 0.0, depth_mm])


def plane_from_ray(
    rt_cam_ref: NDArray[np.floating],
    rt_ref_plane: NDArray[np.floating],
    principal_shift: NDArray[np.floating] | None = None,
) -> NDArray[np.float64]:
    """Return the homography of each view from rays (x, y, 1) to plane coordinates (X, Y, 1) in mm.

    A point (X, Y) of the plane lies at `R (X r₁ + Y r₂ + o) + t` in a camera of pose (R, t), where r₁, r₂ and o are the
    axes and origin of the plane in the reference frame; so `ray ∝ [R r₁, R r₂, R o + t] (X, Y, 1)`, and the homography
    is the inverse of that 3 x 3 matrix. For a plane normal to the axis at depth d it is `[r₁ r₂ d·r₃ + t]⁻¹`.

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
        Scaled so that the third coordinate of a result is positive where the plane is in front of the camera; all zeros
        for a camera that lies in the plane and sees nothing of it.

    Examples
    --------
    Two cameras 50 mm apart look in one direction, and see points 50 mm apart on a plane at 500 mm:

    >>> import numpy as np
    >>> from faintfield import fronto_parallel_rt_ref_plane, plane_from_ray
    >>> poses_rt_cam_ref = np.zeros((2, 6))
    >>> poses_rt_cam_ref[1, 3] = -50.0  # to the right of the first
    >>> homographies = plane_from_ray(poses_rt_cam_ref, fronto_parallel_rt_ref_plane(depth_mm=500.0))
    >>> points = homographies @ [0.1, 0.2, 1.0]
    >>> (points[:, :2] / points[:, 2:]).round(6)
    array([[ 50., 100.],
           [100., 100.]])
    """
    r_ref_plane = rotation_matrix(rt_ref_plane)
    homographies = np.zeros((len(rt_cam_ref), 3, 3))
    for view, rt in enumerate(np.asarray(rt_cam_ref, np.float64)):
        ray_from_plane = rotation_matrix(rt) @ np.column_stack([r_ref_plane[:, 0], r_ref_plane[:, 1], rt_ref_plane[3:]])
        ray_from_plane[:, 2] += rt[3:]
        shift = np.eye(3)
        if principal_shift is not None:
            shift[:2, 2] = principal_shift[view]
        if np.linalg.cond(ray_from_plane) < 1e12:
            homographies[view] = np.linalg.inv(ray_from_plane) @ shift
    return homographies


def ray_from_surface(
    rt_cam_ref: NDArray[np.floating], principal_shift: NDArray[np.floating] | None = None
) -> NDArray[np.float64]:
    """Return the matrices (view, 3, 4) from directions of the reference view, with 1/depth, to rays of each view.

    The point in direction (x, y, 1) at depth d lies at `R (x, y, 1) d + t` in a camera of pose (R, t), on the ray
    `[R | t] (x, y, 1, 1/d)`.

    Parameters
    ----------
    rt_cam_ref : array (view, 6)
        Rodrigues rad and mm, from reference to camera.
    principal_shift : array (view, 2), optional
        As for `plane_from_ray`; it is subtracted from the rays.
    """
    matrices = np.array([np.column_stack([rotation_matrix(rt), rt[3:]]) for rt in np.asarray(rt_cam_ref, np.float64)])
    if principal_shift is not None:
        matrices[:, :2] -= np.asarray(principal_shift)[:, :, np.newaxis] * matrices[:, 2:]
    return matrices


def image_lattice(size_px: tuple[int, int], across: int = _POINTS_ACROSS) -> NDArray[np.float64]:
    """Return `across` by `across` pixels (point, 2) spread evenly over an image, as column, row."""
    shares = (np.arange(across) + 0.5) / across
    columns, rows = np.meshgrid(shares * size_px[0] - 0.5, shares * size_px[1] - 0.5)
    return np.column_stack([columns.ravel(), rows.ravel()])


def transfer(
    lens: Lens, rt_cam_ref: NDArray[np.floating], rt_ref_plane: NDArray[np.floating], pixels: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return where a view sees the points of a plane (point, 2) that the reference view sees at `pixels` (point, 2).

    Both have one lens; poses of view and plane (6,) are Rodrigues rad and mm. NaN where the plane is not in front of
    both cameras.
    """
    rays = np.column_stack([lens.rays_at(pixels), np.ones(len(pixels))])
    normal = rotation_matrix(rt_ref_plane)[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_mm = normal @ np.asarray(rt_ref_plane[3:]) / (rays @ normal)
        points = rays * np.where(depth_mm > 0, depth_mm, np.nan)[:, np.newaxis]
    return lens.project(points @ rotation_matrix(rt_cam_ref).T + rt_cam_ref[3:])


def transfer_sigma_px(
    lens: Lens,
    rt_cam_ref: NDArray[np.floating],
    covariances: Sequence[NDArray[np.floating]],
    rt_ref_plane: NDArray[np.floating],
    pixels: NDArray[np.floating] | None = None,
) -> NDArray[np.float64]:
    """Return the standard deviation of the transfer by a plane that the covariance of lens and pose implies.

    With D the derivative of `transfer` by lens and pose, σ² = trace(D Σ Dᵀ) is the mean square distance in the view
    between computed and true pixel, both axes together.

    Parameters
    ----------
    lens, rt_cam_ref : Lens, array (view, 6)
        Lens of all views, and their poses.
    covariances : sequence of array (4 + distortion + 6, square)
        Covariance of `lens.parameters` and the view's pose, for each view.
    rt_ref_plane, pixels : array (6,), (point, 2)
        Pose of the plane, which may be tilted; pixels of the reference view, by default a lattice over its image.

    Returns
    -------
    array (view, point)
        In pixels; NaN where the point lies outside of the view's image.
    """
    points = image_lattice(lens.size_px) if pixels is None else np.asarray(pixels, np.float64)
    sigma_px = np.full((len(rt_cam_ref), len(points)), np.nan)
    for view, (rt, covariance) in enumerate(zip(np.asarray(rt_cam_ref, float), covariances, strict=True)):
        slope = transfer_derivative(lens, rt, rt_ref_plane, points)
        variances = np.einsum("pai,ij,paj->p", slope, covariance, slope)
        visible = np.isfinite(slope).all(axis=(1, 2))
        sigma_px[view, visible] = np.sqrt(np.maximum(variances[visible], 0))
    return sigma_px


def transfer_derivative(
    lens: Lens, rt_cam_ref: NDArray[np.float64], rt_ref_plane: NDArray[np.floating], pixels: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the derivative (point, 2, parameter) of `transfer` by lens and pose, from central differences.

    It is NaN where the view does not see the point.
    """
    values = np.array([*lens.parameters, *rt_cam_ref])
    derivative = np.empty((len(pixels), 2, len(values)))
    for index, value in enumerate(values):
        step = _STEP * (1 + abs(value))
        ahead, behind = (
            transfer(Lens.from_parameters(lens.size_px, moved[:-6]), moved[-6:], rt_ref_plane, pixels)
            for moved in values + step * np.eye(len(values))[index] * [[1], [-1]]
        )
        derivative[:, :, index] = (ahead - behind) / (2 * step)
    images_px = transfer(lens, rt_cam_ref, rt_ref_plane, pixels)
    visible = ((images_px >= -0.5) & (images_px <= np.array(lens.size_px) - 0.5)).all(axis=1)
    derivative[~visible] = np.nan
    return derivative
