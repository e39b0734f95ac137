"""Poses moved a little, and how the pictures move with them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from faintfield.recon.likelihood.images import Image
from faintfield.recon.surface.pinhole_views import PinholeViews

type Poses = NDArray[np.float64]

# Numbers of a pose: a rotation, then a translation. Numbers of a lens: focal length, first distortion term.
POSE, LENS = 6, 2


@dataclass(frozen=True)
class PosedViews:
    """Views of pinhole cameras whose poses can be moved, and whose common lens can be changed.

    Attributes
    ----------
    views : PinholeViews
        The pictures, with the matrices of the poses.
    rt_cam_ref : float array (view, 6)
        Rodrigues rad and mm, from reference to camera.
    principal_shift : float array (view, 2)
        Subtracted from the rays of views with a principal point of their own.
    free_lens : bool
        True if the lens is to be found, too.
    """

    views: PinholeViews
    rt_cam_ref: Poses
    principal_shift: NDArray[np.float64]
    free_lens: bool = False

    @property
    def lens_parameters(self) -> int:
        """Number of parameters of a lens that is to be found."""
        return LENS if self.free_lens else 0

    def at(self, rt_cam_ref: Poses, lens_change: tuple[float, float] = (0.0, 0.0)) -> "PosedViews":
        """Return the views at other poses, with a changed lens."""
        matrices = np.concatenate([_rotations(rt_cam_ref).as_matrix(), rt_cam_ref[:, 3:, np.newaxis]], axis=2)
        matrices[:, :2] -= self.principal_shift[:, :, np.newaxis] * matrices[:, 2:]
        views = replace(self.views, ray_from_surface=matrices, lens_change=lens_change)
        return replace(self, views=views, rt_cam_ref=rt_cam_ref)

    def binned(self, bins: int) -> "PosedViews":
        """Return the views with `bins` by `bins` pixels added up."""
        return replace(self, views=self.views.binned(bins))


def move_poses(rt_cam_ref: Poses, steps: Poses) -> Poses:
    """Return poses (view, 6) after small steps (ω, τ) (view, 6): `R ← exp([ω]×) R` and `t ← t + τ`."""
    turned = (_rotations(steps) * _rotations(rt_cam_ref)).as_rotvec()
    return np.column_stack([turned, rt_cam_ref[:, 3:] + steps[:, 3:]])


def steps_between(start: Poses, end: Poses) -> Poses:
    """Return the steps (view, 6) for which `move_poses(start, steps)` is `end`."""
    turned = (_rotations(end) * _rotations(start).inv()).as_rotvec()
    return np.column_stack([turned, end[:, 3:] - start[:, 3:]])


def _rotations(poses: Poses) -> Rotation:
    return Rotation.from_rotvec(poses[:, :3])


def motion(x: Image, y: Image, inverse_depth: Image | float) -> NDArray[np.float32]:
    """Return how the ray (x, y, 1) to a point moves: of x and y, by each of the six motions (2, 6, …).

    The point X in the frame of the camera, whose 1/Z is `inverse_depth`, becomes `X + ω × X + τ`.
    """
    zero, q = np.zeros_like(x), np.broadcast_to(np.float32(inverse_depth), x.shape)
    along_x = [-x * y, 1 + x * x, -y, q, zero, -x * q]
    along_y = [-(1 + y * y), x * y, x, zero, q, -y * q]
    return np.array([along_x, along_y], np.float32)


def lens_motion(x: Image, y: Image) -> NDArray[np.float32]:
    """Return how the picture of a ray (x, y, 1) moves with the lens, in focal lengths (2, 2, …): outwards.

    The first of the middle two is for the relative change of the focal length, the second for that of distortion.
    """
    square = x * x + y * y
    return np.array([[x, x * square], [y, y * square]], np.float32)


def motion_of_step(rt_cam_ref: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix (6, 6) from the step of a pose to the motion of all points in the frame of its camera.

    A step turns a point X = R p + t about t, where the reference camera is: `ω × (X − t) + τ`.
    """
    x, y, z = rt_cam_ref[3:]
    matrix = np.eye(POSE)
    matrix[3:, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    return matrix
