"""H of a single plane, for callers that have one plane: its samples are an array (row, column)."""

from copy import copy
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator.geometry import DetectorMaps, Surface, window_geometry
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.scene_operator import SceneOperator


class OperatorOptions(TypedDict, total=False):
    """Options of `recon.operator.scene_operator.SceneOperator` that the operators of one plane take, too."""

    flat: NDArray[np.floating] | None
    valid: NDArray[np.bool_] | None
    lattice_of_view: NDArray[np.intp] | None
    dtype: type[np.float32] | type[np.float64]
    workers: int | None


class PlaneOperator(SceneOperator):
    """H of one plane, a scene of one, whose samples have the shape (row, column).

    Parameters
    ----------
    plane_from_ray : array (view, 3, 3)
        Homography from a ray (x, y, 1) to plane coordinates (x, y, 1) in mm; the homogeneous scale is positive for
        points in front of the camera.
    grid : PlaneGrid
        The samples of the plane.
    rays, surface, **options
        As for `recon.operator.scene_operator.SceneOperator`.

    Raises
    ------
    GeometryMismatch
        Shapes do not fit together, a number is not finite, or no pixel of any view sees the plane.
    """

    def __init__(
        self,
        plane_from_ray: NDArray[np.floating],
        rays: NDArray[np.floating] | DetectorMaps,
        grid: PlaneGrid,
        *,
        surface: Surface | None = None,
        **options: Unpack[OperatorOptions],
    ) -> None:
        super().__init__(plane_from_ray[np.newaxis], rays, [grid], surface=surface, **options)
        self.grid, self.samples_shape = grid, grid.shape

    def window(
        self, rows: slice, columns: slice, workers: int | None = None, kept_maps: dict[float, Image] | None = None
    ) -> "PlaneOperator":
        """Return H of a part of the samples, on the same images; pixels that see another part see nothing.

        It shares all maps with this operator, and its sweeps take about as much less time as it has fewer samples.

        Parameters
        ----------
        rows, columns : slice
            The samples, with a start and a stop.
        workers : int, optional
            Number of threads; as many as this operator has by default.
        kept_maps : dict, optional
            Place for maps of numbers, which windows can share: making one takes as long as a sweep of a window.

        Raises
        ------
        GeometryMismatch
            No pixel of any view sees this part.
        """
        grid, part = self.grid.window(rows, columns), copy(self)
        for cached in ("_sensitivity", "seeing_views"):
            part.__dict__.pop(cached, None)
        part.grid, part.workers, part._kept_maps = grid, workers or self.workers, kept_maps  # noqa: SLF001
        part._see(window_geometry(self._geometry, grid, (rows.start, columns.start)), (grid,))  # noqa: SLF001
        part.samples_shape = grid.shape
        return part
