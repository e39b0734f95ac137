"""H of a surface: what each detector pixel of each view sees of one picture whose samples have depths of their own."""

from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.operator.geometry import DetectorMaps, check_lattices
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.placement import UNSEEN
from faintfield.recon.operator.relief import draw_relief
from faintfield.recon.operator.single_plane import OperatorOptions, PlaneOperator


def homographies_of_surface(ray_from_surface: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the homographies from rays to a plane at infinity, and their change with 1/depth.

    A point in direction a = (x, y, 1) of the reference view at 1/depth q is seen along the ray `r ∝ A a + q b` of a
    view. With s = A⁻¹ r and the view's centre c = −A⁻¹ b, the ray meets the plane at q where

        a ∝ s + q (s₃ c − c₃ s),

    whose third component is s₃: the direction, and so the place on the samples, is linear in q.

    `ray_from_surface` (view, 3, 4) is [A | b]. The homographies plus q times the slopes, both (view, 3, 3), map rays
    (x, y, 1) to directions, homogeneous; the third row of the slopes is zero.
    """
    inverse = np.linalg.inv(ray_from_surface[:, :, :3])
    centre = -np.einsum("vij,vj->vi", inverse, ray_from_surface[:, :, 3])
    slopes = centre[:, :, np.newaxis] * inverse[:, np.newaxis, 2] - centre[:, 2, np.newaxis, np.newaxis] * inverse
    slopes[:, 2] = 0
    return inverse, slopes


class SurfaceOperator(PlaneOperator):
    """H of a surface given by the depth of each sample of the reference view.

    As for a plane, H interpolates the picture bilinearly at each pixel, and Hᵀ spreads with the same weights. Where a
    pixel sees the picture depends on the depth of the surface there, which `recon.operator.relief` draws into each
    view with a depth buffer. Pixels that look past the surface, behind a step, or at both sides of one have weights of
    zero: they take no part in any likelihood. A surface of one depth d is the plane of `grid` times d.

    Parameters
    ----------
    ray_from_surface : array (view, 3, 4)
        From (x, y, 1, 1/depth), a direction of the reference view with a depth, to the ray of each view, homogeneous;
        the scale is positive for points in front of the camera.
    grid : PlaneGrid
        The samples at unit depth: the directions of the reference view that they lie in.
    inverse_depth : array (row, column)
        1/depth of each sample in 1/mm, zero for points at infinity; NaN where there is no surface.
    rays, **options
        As for `recon.operator.scene_operator.SceneOperator`.

    Raises
    ------
    GeometryMismatch
        Shapes do not fit together, a number is not finite, a depth is negative, a view does not see the directions of
        the reference view, or no pixel of any view sees the surface.

    Notes
    -----
    The light of a sample is the same in every direction (Lambert); docs/explanation/physics.md, "Through a surface".
    """

    def __init__(
        self,
        ray_from_surface: NDArray[np.floating],
        rays: NDArray[np.floating] | DetectorMaps,
        grid: PlaneGrid,
        inverse_depth: NDArray[np.floating],
        **options: Unpack[OperatorOptions],
    ) -> None:
        maps = DetectorMaps.of(rays, options.pop("flat", None), options.get("dtype", np.float32))
        rays, matrices = np.ascontiguousarray(maps.rays), ray_from_surface.astype(np.float64)
        lattice_of_view = options.get("lattice_of_view")
        lattices = np.zeros(len(matrices), np.intp) if lattice_of_view is None else np.asarray(lattice_of_view)
        _check_surface(matrices, len(rays), grid, inverse_depth, lattices)
        self._relief = draw_relief(inverse_depth, grid, matrices, rays, lattices.tolist(), options.get("workers"))
        at_infinity, slopes = homographies_of_surface(matrices)
        surface = grid.index_from_plane() @ slopes, self._relief
        super().__init__(at_infinity + self._relief.origin * slopes, maps, grid, surface=surface, **options)

    def inverse_depth_of_pixels(self) -> NDArray[np.float32]:
        """Return 1/depth at which each pixel (view, row, column) meets the surface, 0 where it sees no part of it."""
        codes, step, origin = self._relief
        return np.where(codes == UNSEEN, np.float32(0), codes * np.float32(step) + np.float32(origin))


def _check_surface(
    ray_from_surface: NDArray[np.float64],
    lattices: int,
    grid: PlaneGrid,
    inverse_depth: NDArray[np.floating],
    lattice_of_view: NDArray[np.intp],
) -> None:
    """Refuse what cannot be drawn (GeometryMismatch); the rest is checked with the geometry."""
    if ray_from_surface.ndim != 3 or ray_from_surface.shape[1:] != (3, 4):
        raise GeometryMismatch(f"matrices of shape {ray_from_surface.shape} do not fit; give (view, 3, 4)")
    check_lattices(lattice_of_view, len(ray_from_surface), lattices)
    if inverse_depth.shape != grid.shape:
        raise GeometryMismatch(
            f"inverse_depth has shape {inverse_depth.shape}, the samples {grid.shape}; give it that shape"
        )
    if np.isinf(inverse_depth).any() or (inverse_depth < 0).any():
        raise GeometryMismatch("a depth of the surface is zero or negative; give 1/depth ≥ 0, or NaN for no surface")
    if not np.isfinite(ray_from_surface).all():
        raise GeometryMismatch("a pose is not a finite number; check the calibration it came from")
    if (np.linalg.det(ray_from_surface[:, :, :3]) <= 0).any():
        raise GeometryMismatch("a view sees a mirror image of the directions of the reference; check its pose")
