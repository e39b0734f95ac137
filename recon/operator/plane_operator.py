"""H of a single plane, for callers that have one plane: its samples are an array (row, column)."""

from copy import copy

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator.geometry import DetectorMaps, Surface, window_geometry
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.kernels import SceneGeometry
from faintfield.recon.operator.scene_operator import SceneOperator


class PlaneOperator(SceneOperator):
    """H of one plane, a scene of one, whose samples have the shape (row, column).

    Parameters
    ----------
    plane_from_ray : array (view, 3, 3)
        Homography from a ray (x, y, 1) to plane coordinates (x, y, 1) in mm; the homogeneous scale is positive for
        points in front of the camera.
    rays, flat, valid, lattice_of_view, dtype, workers, surface
        As for `recon.operator.scene_operator.SceneOperator`.
    grid : PlaneGrid
        The samples of the plane.

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
        flat: NDArray[np.floating] | None = None,
        valid: NDArray[np.bool_] | None = None,
        lattice_of_view: NDArray[np.intp] | None = None,
        dtype: type[np.float32] | type[np.float64] = np.float32,
        workers: int | None = None,
        surface: Surface | None = None,
    ) -> None:
        super().__init__(
            plane_from_ray[np.newaxis],
            rays,
            [grid],
            flat=flat,
            valid=valid,
            lattice_of_view=lattice_of_view,
            dtype=dtype,
            workers=workers,
            surface=surface,
        )
        self.grid = grid
        self.samples_shape = grid.shape

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
        grid = self.grid.window(rows, columns)
        part = copy(self)
        part.workers, part._kept_maps = workers or self.workers, kept_maps  # noqa: SLF001
        part._take_window(grid, window_geometry(self._geometry, grid, (rows.start, columns.start)))  # noqa: SLF001
        return part

    def _take_window(self, grid: PlaneGrid, geometry: SceneGeometry) -> None:
        for cached in ("_sensitivity", "seeing_views"):
            self.__dict__.pop(cached, None)
        self.grid = grid
        self._see(geometry, (grid,))
        self.samples_shape = grid.shape
