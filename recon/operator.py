"""The operator H of eq. (1): what each detector pixel of each view sees of a plane, and its exact adjoint."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from recon import kernels
from recon.errors import GeometryMismatch
from recon.images import ElementalImages, Image
from recon.plane import PlaneGrid


class PlaneOperator:
    """H of one plane: matrix-free, linear, with the adjoint that shares its weights.

    Every view is taken by one camera, so the lens (distortion included) is one shared map from detector pixel to ray,
    and a view is one homography from rays to the plane. H interpolates the plane bilinearly at each detector pixel;
    Hᵀ spreads each pixel to the same four samples with the same weights. The images themselves are never resampled.
    A pixel sees the plane when all four samples around its point exist; otherwise its row of H is zero.

    Parameters
    ----------
    plane_from_ray : array (view, 3, 3)
        Homography from a ray (x, y, 1) to plane coordinates (x, y, 1) in mm; the homogeneous scale is positive for
        points in front of the camera.
    rays : array (row, column, 2) or (lattice, row, column, 2)
        Where each detector pixel looks: x, y at unit depth, lens distortion undone.
    grid : PlaneGrid
        The samples of the plane.
    flat : array (row, column) or (lattice, row, column), optional
        Relative response of each pixel (vignetting); zero for pixels that never count.
    valid : bool array (view, row, column), optional
        False for pixels that do not count in one view.
    lattice_of_view : int array (view,), optional
        Which lattice of detector pixels each view has; all the first by default.
    dtype : dtype
        Of planes and images: float32 for work, float64 for tests.
    workers : int, optional
        Threads; as many as the process may use by default. Sums depend on it in the last digits.

    Raises
    ------
    GeometryMismatch
        Shapes do not fit together, a number is not finite, or no pixel of any view sees the plane.

    Notes
    -----
    f is in expected electrons per detector pixel before flat field; see docs/physics.md, "The operator".
    """

    def __init__(
        self,
        plane_from_ray: NDArray[np.floating],
        rays: NDArray[np.floating],
        grid: PlaneGrid,
        *,
        flat: NDArray[np.floating] | None = None,
        valid: NDArray[np.bool_] | None = None,
        lattice_of_view: NDArray[np.intp] | None = None,
        dtype: type[np.float32] | type[np.float64] = np.float32,
        workers: int | None = None,
    ) -> None:
        self.grid = grid
        self.dtype: np.dtype[np.floating[Any]] = np.dtype(dtype)
        self._workers = workers or int(numba.config.NUMBA_NUM_THREADS)
        self._geometry = _checked_geometry(plane_from_ray, rays, grid, flat, valid, lattice_of_view, dtype)
        self.images_shape = (len(plane_from_ray), *self._geometry.ray_x.shape[1:])
        self.all_views = np.arange(len(plane_from_ray))
        if not self.sensitivity().any():
            raise GeometryMismatch(
                f"no pixel of any of the {len(self.all_views)} views sees the plane of {grid.shape[1]} x "
                f"{grid.shape[0]} samples at {grid.pitch_mm:.3g} mm; check its depth, the poses and their signs, "
                "and that not all pixels are masked (saturated, hot)"
            )

    def forward(self, plane: Image, views: Sequence[int] | NDArray[np.intp] | None = None) -> Image:
        """Return H f: the plane (row, column) as each view sees it, (view, row, column)."""
        views = self._views(views)
        seen = np.empty((len(views), *self.images_shape[1:]), self.dtype)
        image_of_view = np.zeros(self.images_shape[0], np.intp)
        image_of_view[views] = np.arange(len(views))
        self._sweep(kernels.FORWARD, views, image_of_view, plane=self._plane(plane), seen=seen)
        return seen

    def adjoint(self, images: Image, views: Sequence[int] | NDArray[np.intp] | None = None) -> Image:
        """Return Hᵀ g (row, column) of images (view, row, column), summed over `views` (all by default)."""
        return self._sweep(kernels.ADJOINT, self._views(views), self.all_views, images=self._images(images))[1]

    def adjoint_of_map(self, value: float | Image, views: Sequence[int] | NDArray[np.intp] | None = None) -> Image:
        """Return Hᵀ applied to images that all equal one map, broadcastable to (lattice, row, column)."""
        lattices = self._geometry.lattice_of_view
        return self._sweep(kernels.ADJOINT, self._views(views), lattices, images=self._map(value))[1]

    def sensitivity(self, views: Sequence[int] | NDArray[np.intp] | None = None) -> Image:
        """Return s = Hᵀ 1 (row, column): without flat field, the number of views that see each sample."""
        return self.adjoint_of_map(1.0, views)

    def coverage(self, views: Sequence[int] | NDArray[np.intp] | None = None) -> Image:
        """Return Hᵀ H 1 (row, column), by which a back-projection is divided to keep a constant plane constant."""
        return self.adjoint_of_map(self._geometry.response, views)

    def map_of_view(self, value: float | Image, view: int) -> Image:
        """Return the part of a map, broadcastable to (lattice, row, column), that belongs to a view: (row, column)."""
        return np.asarray(np.broadcast_to(value, self._geometry.ray_x.shape)[self._geometry.lattice_of_view[view]])

    def value_and_ratio(
        self, plane: Image, images: ElementalImages, views: Sequence[int] | NDArray[np.intp] | None = None
    ) -> tuple[float, Image]:
        """Return the negative log-likelihood of a plane and Hᵀ r (row, column), in one sweep.

        r is the ratio of `recon.pixel_models`: the negative log-likelihood has the derivative s − Hᵀ r. Terms that do
        not depend on f are left out.
        """
        return self._likelihood(kernels.RATIO, plane, images, views)

    def adjoint_of_ratio(
        self, plane: Image, images: ElementalImages, views: Sequence[int] | NDArray[np.intp] | None = None
    ) -> Image:
        """Return Hᵀ r (row, column) alone: for shifted Poisson data Hᵀ[ (g + σ²)₊ / (H f + b + σ²) ], as in eq. (2)."""
        return self.value_and_ratio(plane, images, views)[1]

    def negative_log_likelihood(
        self, plane: Image, images: ElementalImages, views: Sequence[int] | NDArray[np.intp] | None = None
    ) -> float:
        """Return the negative log-likelihood alone, in a sweep that only reads."""
        return self._likelihood(kernels.VALUE, plane, images, views)[0]

    def _likelihood(
        self,
        operation: int,
        plane: Image,
        images: ElementalImages,
        views: Sequence[int] | NDArray[np.intp] | None,
    ) -> tuple[float, Image]:
        """Run one of the sweeps that compare a plane with the data."""
        if images.valid is not None and not self._geometry.valid.size:
            raise GeometryMismatch("the images have pixels that do not count; make the operator with their `valid`")
        likelihood = images.likelihood
        pixels = kernels.PixelModel(
            likelihood.model,
            self._map(images.background_e),
            self._map(images.read_variance_e2 if likelihood.knows_read_noise else 0.0),
            likelihood.level_e,
        )
        electrons = self._images(images.electrons)
        views = self._views(views)
        return self._sweep(operation, views, self.all_views, plane=self._plane(plane), images=electrons, pixels=pixels)

    def _sweep(
        self,
        operation: int,
        views: NDArray[np.intp],
        image_of_view: NDArray[np.intp],
        *,
        plane: Image | None = None,
        images: Image | None = None,
        seen: Image | None = None,
        pixels: kernels.PixelModel | None = None,
    ) -> tuple[float, Image]:
        """Run one kernel on all workers and return the sums of their values and of their accumulators."""
        nothing = np.empty((1, 1, 1), self.dtype)
        images = nothing if images is None else images
        pixels = pixels or kernels.PixelModel(0, nothing, nothing, 0.0)
        scatters = operation in (kernels.ADJOINT, kernels.RATIO)
        sums = np.zeros((self._workers, *self.grid.shape) if scatters else (self._workers, 1, 1), self.dtype)
        values = [0.0] * self._workers

        def work(worker: int) -> None:
            values[worker] = kernels.sweep(
                operation,
                nothing[0] if plane is None else plane,
                nothing if seen is None else seen,
                sums[worker],
                images,
                image_of_view,
                pixels,
                self._geometry,
                views,
                worker,
                self._workers,
            )

        _on_all(work, self._workers)
        return sum(values), np.asarray(sums.sum(axis=0))

    def _plane(self, plane: Image) -> Image:
        if plane.shape != self.grid.shape:
            raise GeometryMismatch(f"plane has shape {plane.shape}, the operator {self.grid.shape}; give it that")
        return np.ascontiguousarray(plane, self.dtype)

    def _images(self, images: Image) -> Image:
        if images.shape != self.images_shape:
            raise GeometryMismatch(
                f"images have shape {images.shape}, the operator {self.images_shape}; give them that"
            )
        return np.ascontiguousarray(images, self.dtype)

    def _map(self, value: float | Image) -> Image:
        shape = self._geometry.ray_x.shape
        try:
            return np.array(np.broadcast_to(value, shape), self.dtype)
        except ValueError:
            raise GeometryMismatch(
                f"a map has shape {np.shape(value)}, the operator's lattices {shape}; give one per lattice, or a number"
            ) from None

    def _views(self, views: Sequence[int] | NDArray[np.intp] | None) -> NDArray[np.intp]:
        """Return the views to go over, each at most once: the kernels trust them."""
        if views is None:
            return self.all_views
        chosen = np.asarray(views)
        if chosen.size == 0:
            return chosen.astype(np.intp)
        if chosen.dtype.kind not in "iu" or np.unique(chosen).size < chosen.size:
            raise ValueError(f"views must be whole numbers, none of them twice, got {views}")
        if chosen.min() < 0 or chosen.max() >= len(self.all_views):
            raise ValueError(f"views must lie within 0 and {len(self.all_views) - 1}, got {views}")
        return chosen.astype(np.intp)


def compile_kernels() -> None:
    """Compile the kernels for float32, unless the cache beside the code has them.

    Done once per installation, it spares the first reconstruction five seconds and 60 MB.
    """
    PlaneOperator(np.eye(3)[np.newaxis], np.zeros((2, 2, 2)), PlaneGrid((2, 2), 1.0, (0.0, 0.0)))


def _checked_geometry(
    plane_from_ray: NDArray[Any],
    rays: NDArray[Any],
    grid: PlaneGrid,
    flat: NDArray[Any] | None,
    valid: NDArray[np.bool_] | None,
    lattice_of_view: NDArray[np.intp] | None,
    dtype: type[Any],
) -> kernels.Geometry:
    """Bring the pieces into the form that the kernels read, refusing what does not fit."""
    rays = rays[np.newaxis] if rays.ndim == 3 else rays
    views, lattices, detector = len(plane_from_ray), len(rays), rays.shape[1:3]
    flat = np.ones((1, *detector)) if flat is None else flat.reshape(-1, *flat.shape[-2:])
    lattice_of_view = np.zeros(views, np.intp) if lattice_of_view is None else np.asarray(lattice_of_view, np.intp)
    valid = np.zeros((0, 0, 0), bool) if valid is None else np.ascontiguousarray(valid)
    if plane_from_ray.shape != (views, 3, 3) or rays.shape != (lattices, *detector, 2) or views == 0:
        raise GeometryMismatch(
            f"homographies {plane_from_ray.shape} and rays {rays.shape} do not fit; give (view, 3, 3), (row, column, 2)"
        )
    if valid.size and valid.shape != (views, *detector):
        raise GeometryMismatch(f"valid has shape {valid.shape}, the views {(views, *detector)}; give it that")
    if flat.shape not in ((1, *detector), (lattices, *detector)):
        raise GeometryMismatch(f"flat {flat.shape} does not fit rays {rays.shape}; give one per lattice, or one")
    if lattice_of_view.shape != (views,) or not 0 <= lattice_of_view.min() <= lattice_of_view.max() < lattices:
        raise GeometryMismatch(
            f"lattice_of_view has shape {lattice_of_view.shape} and values {np.unique(lattice_of_view).tolist()}; "
            f"give each of the {views} views one of {lattices} lattices, counted from 0"
        )
    if (flat < 0).any():
        raise GeometryMismatch(f"the flat field is negative somewhere, {flat.min():.3g} at least; measure it again")
    if not all(np.isfinite(part).all() for part in (plane_from_ray, rays, flat)):
        raise GeometryMismatch("a pose, ray or flat field is not a finite number; check the calibration they came from")
    return kernels.Geometry(
        np.ascontiguousarray(grid.index_from_plane() @ plane_from_ray, dtype),
        lattice_of_view,
        np.ascontiguousarray(rays[..., 0], dtype),
        np.ascontiguousarray(rays[..., 1], dtype),
        np.array(np.broadcast_to(flat, (lattices, *detector)), dtype),
        valid,
    )


def _on_all(work: Callable[[int], None], workers: int) -> None:
    """Call `work` for each worker, each in a thread of its own when there are several."""
    if workers == 1:
        work(0)
        return
    with ThreadPoolExecutor(workers) as pool:
        for _ in pool.map(work, range(workers)):
            pass
