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
    """Options of `recon.operator.scene_operator.SceneOperator` that the operators of one plane take, too.

    Attributes
    ----------
    flat, valid : array (row, column) or (lattice, row, column), bool array (view, row, column), optional
        Relative response of each pixel; False for pixels that do not count in one view.
    lattice_of_view : int array (view,), optional
        The lattice of detector pixels of each view; the first by default.
    dtype, workers : dtype, int, optional
        Type of samples and images, and number of threads, by default as many as the process may use.
    """

    flat: NDArray[np.floating] | None
    valid: NDArray[np.bool_] | None
    lattice_of_view: NDArray[np.intp] | None
    dtype: type[np.float32] | type[np.float64]
    workers: int | None


class PlaneOperator(SceneOperator):
    """H of one plane in `g = H f + n`, eq. (1) of docs/explanation/physics.md: the plane as the views see it.

    H interpolates the plane bilinearly where the ray of each pixel meets it; Hᵀ spreads each pixel to the same four
    samples with the same weights. Samples f are an array (row, column), images g an array (view, row, column).

    Parameters
    ----------
    plane_from_ray : array (view, 3, 3)
        Homography from a ray (x, y, 1) to plane coordinates (x, y, 1) in mm; the homogeneous scale is positive for
        points in front of the camera. The function of this name makes them from poses.
    rays : array (row, column, 2) or (lattice, row, column, 2), or DetectorMaps
        Direction of each detector pixel: x, y at unit depth, lens distortion undone. `Lens.rays` makes them.
    grid : PlaneGrid
        The samples of the plane.
    surface : (array (view, 3, 3), Relief), optional
        Bend of the plane to a surface, for `recon.operator.surface_operator.SurfaceOperator`.
    **options
        Options of `recon.operator.scene_operator.SceneOperator`: `flat` (row, column) is the relative response of each
        pixel, `valid` (view, row, column) is False for pixels that do not count, `lattice_of_view` is for mosaics,
        `dtype` is float32 or float64, and `workers` is the number of threads.

    Raises
    ------
    GeometryMismatch
        Shapes do not fit together, a number is not finite, or no pixel of any view sees the plane.

    Examples
    --------
    Three cameras, 20 mm apart in a row, and a plane at 400 mm:

    >>> import numpy as np
    >>> from faintfield import Lens, PlaneGrid, PlaneOperator
    >>> from faintfield import fronto_parallel_rt_ref_plane, plane_from_ray
    >>> lens = Lens((32, 24), fx_px=40.0, fy_px=40.0, cx_px=15.5, cy_px=11.5)
    >>> poses_rt_cam_ref = np.array([[0.0, 0.0, 0.0, x_mm, 0.0, 0.0] for x_mm in (20.0, 0.0, -20.0)])
    >>> homographies = plane_from_ray(poses_rt_cam_ref, fronto_parallel_rt_ref_plane(depth_mm=400.0))
    >>> grid = PlaneGrid.covering(-160.0, -120.0, 160.0, 120.0, pitch_mm=10.0)
    >>> operator = PlaneOperator(homographies, lens.rays(), grid)
    >>> operator.forward(np.ones(grid.shape)).shape
    (3, 24, 32)
    >>> operator.sensitivity()[12, ::4].round()  # number of views that see a sample
    array([2., 3., 3., 3., 3., 3., 3., 3.], dtype=float32)
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
