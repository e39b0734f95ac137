"""The homographies of a plane: from what a camera sees to where on the plane it lies."""

import cv2
import numpy as np
from numpy.typing import NDArray


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
