"""H of a surface: what each detector pixel of each view sees of one picture whose samples have depths of their own."""

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.operator.placement import UNSEEN
from faintfield.recon.operator.relief import draw_relief


def homographies_of_surface(
    ray_from_surface: NDArray[np.floating],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return homographies (view, 3, 3) from rays to directions (x, y, 1) of the reference, and their change with 1/depth.

    A sample in direction a = (x, y, 1) at 1/depth q is seen along the ray `A a + q b` of a view. With s = A⁻¹ r and
    c = −A⁻¹ b, the ray r meets it at `a ∝ s + q (s₃ c − c₃ s)`, whose third component is s₃.
    """
    inverse = np.linalg.inv(ray_from_surface[:, :, :3])
    centre = -np.einsum("vij,vj->vi", inverse, ray_from_surface[:, :, 3])
    slope = centre[:, :, np.newaxis] * inverse[:, np.newaxis, 2] - centre[:, 2, np.newaxis, np.newaxis] * inverse
    slope[:, 2] = 0
    return inverse, slope


class SurfaceOperator(PlaneOperator):
    """H of a surface given by the depth of each sample of the reference view."""

    def __init__(
        self,
        ray_from_surface: NDArray[np.floating],
        rays: NDArray[np.floating],
        grid: PlaneGrid,
        inverse_depth: NDArray[np.floating],
        *,
        flat: NDArray[np.floating] | None = None,
        valid: NDArray[np.bool_] | None = None,
        lattice_of_view: NDArray[np.intp] | None = None,
        dtype: type[np.float32] | type[np.float64] = np.float32,
        workers: int | None = None,
    ) -> None:
        rays = rays[np.newaxis] if rays.ndim == 3 else rays
        lattices = np.zeros(len(ray_from_surface), np.intp) if lattice_of_view is None else lattice_of_view
        relief = draw_relief(inverse_depth, grid, ray_from_surface, rays, lattices.tolist(), workers)
        self._relief = relief
        at_zero, slope = homographies_of_surface(ray_from_surface)
        in_samples = np.einsum("ij,vjk->vik", grid.index_from_plane(), slope)
        super().__init__(
            at_zero + relief.origin * slope,
            rays,
            grid,
            flat=flat,
            valid=valid,
            lattice_of_view=lattice_of_view,
            dtype=dtype,
            workers=workers,
            surface=(in_samples, relief),
        )

    def inverse_depth_of_pixels(self) -> NDArray[np.float32]:
        """Return 1/depth at which each pixel (view, row, column) meets the surface, 0 where it sees no part of it."""
        codes, step, origin = self._relief
        return np.where(codes == UNSEEN, np.float32(0), codes * np.float32(step) + np.float32(origin))
