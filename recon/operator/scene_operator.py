"""The operator H of eq. (1): what each detector pixel of each view sees of the planes of a scene, and its adjoint."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator import kernels
from faintfield.recon.operator.geometry import DetectorMaps, Surface, scene_geometry
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.occlusion import Occluders, hiding_of
from faintfield.recon.operator.sweeps import CompiledSweeps, Sweep, Sweeps

type ViewSelection = Sequence[int] | NDArray[np.integer] | None


class SceneOperator:
    """H of the planes of a scene, `g = Σ_z H_z f_z`: matrix-free and linear, with an adjoint that shares its weights.

    One camera takes every view, so the lens (distortion included) is one shared map from detector pixel to ray, and a
    view is one homography from rays to each plane. H interpolates a plane bilinearly at each detector pixel; Hᵀ spreads
    each pixel to the same four samples with the same weights. The images are never resampled. A pixel sees a plane when
    all four samples around its point exist; otherwise its weights on that plane are zero.

    *Samples* are an array of the shape `samples_shape`: those of all planes, one after the other. Methods that take
    `views` use all views by default. `recon.operator.single_plane.PlaneOperator` is the scene of one plane.

    Parameters
    ----------
    plane_from_ray : array (plane, view, 3, 3)
        Homographies from a ray (x, y, 1) to the coordinates (x, y, 1) of each plane in mm; the homogeneous scale is
        positive for points in front of the camera.
    rays : array (row, column, 2) or (lattice, row, column, 2), or DetectorMaps
        Direction of each detector pixel: x, y at unit depth, lens distortion undone. Operators that are given the same
        maps, which include `flat`, share their memory.
    grids : sequence of PlaneGrid
        The samples of each plane.
    flat, valid : array (row, column) or (lattice, row, column), bool array (view, row, column), optional
        Relative response of each pixel (vignetting), zero for pixels that never count; False for pixels that do not
        count in one view.
    occluders : Occluders, optional
        Opacities by which planes hide those behind them, in H and Hᵀ; none by default.
    lattice_of_view : int array (view,), optional
        The lattice of detector pixels of each view; the first by default.
    dtype, workers : dtype, int, optional
        Type of samples and images, and number of threads, by default as many as the process may use; the last digits
        of sums depend on them.
    surface : (array (view, 3, 3), Relief), optional
        Bend of the only plane to a surface, for `recon.operator.surface_operator.SurfaceOperator`.
    sweeps : class, optional
        Passes over the pixels on another processor: see `recon.operator.sweeps`.

    Raises
    ------
    GeometryMismatch
        Shapes do not fit together, a number is not finite, an opacity is negative, or no pixel of any view sees one of
        the planes.

    Notes
    -----
    f is in expected electrons per detector pixel before the flat field (docs/explanation/physics.md, "The operator").
    """

    def __init__(
        self,
        plane_from_ray: NDArray[np.floating],
        rays: NDArray[np.floating] | DetectorMaps,
        grids: Sequence[PlaneGrid],
        *,
        flat: NDArray[np.floating] | None = None,
        valid: NDArray[np.bool_] | None = None,
        occluders: Occluders | None = None,
        lattice_of_view: NDArray[np.intp] | None = None,
        dtype: type[np.float32] | type[np.float64] = np.float32,
        workers: int | None = None,
        surface: Surface | None = None,
        sweeps: type[Sweeps] = CompiledSweeps,
    ) -> None:
        self.dtype: np.dtype[np.floating[Any]] = np.dtype(dtype)
        grids = tuple(grids)
        self.workers = workers or int(numba.config.NUMBA_NUM_THREADS)
        maps = DetectorMaps.of(rays, flat, dtype)
        geometry = scene_geometry(plane_from_ray, maps, grids, valid, lattice_of_view, surface)
        self._make_sweeps, self._hiding = sweeps, hiding_of(occluders, grids, self.dtype)
        self.maps_shape = maps.shape
        self._kept_maps: dict[float, Image] | None = None
        self.images_shape = (plane_from_ray.shape[1], *self.maps_shape[1:])
        self.all_views, self.lattice_of_view = np.arange(self.images_shape[0]), geometry.lattice_of_view
        # Each pixel that sees the scene has weights that sum to its response: H 1 is known without a sweep
        self.row_sums_are_response = len(grids) == 1 and occluders is None
        self._see(geometry, grids)

    def _see(self, geometry: kernels.SceneGeometry, grids: tuple[PlaneGrid, ...]) -> None:
        """Take the planes, and find which pixels see them; refuse planes that none sees."""
        self._geometry, self.grids = geometry, grids
        self._sweeps = self._make_sweeps(geometry, self._hiding, self.workers)
        self.samples_shape: tuple[int, ...] = (kernels.size_of(geometry),)
        self._sweeps.run(Sweep(kernels.REACH, self.all_views, self.all_views))
        for grid, sensitivity in zip(grids, self.planes_of(self.sensitivity()), strict=True):
            if not sensitivity.any():
                raise GeometryMismatch(
                    f"no pixel of any of the {len(self.all_views)} views sees the plane of {grid.shape[1]} x "
                    f"{grid.shape[0]} samples; check its depth, the poses and their signs, "
                    "and that not all pixels are masked (saturated, hot)"
                )

    def forward(self, samples: Image, views: ViewSelection = None) -> Image:
        """Return H f: the planes as each view sees them together, (view, row, column)."""
        chosen = self._views(views)
        expected = np.zeros((len(chosen), *self.images_shape[1:]), self.dtype)
        samples = self._checked("samples", samples, self.samples_shape)
        image_of_view = np.zeros(self.images_shape[0], np.intp)
        image_of_view[chosen] = np.arange(len(chosen))
        self._sweeps.run(Sweep(kernels.FORWARD, chosen, image_of_view, samples=samples, expected_images=expected))
        return expected

    def adjoint(self, images: Image, views: ViewSelection = None) -> Image:
        """Return Hᵀ g (samples) of images (view, row, column), summed over `views`."""
        images = self._checked("images", images, self.images_shape)
        return self._sums(Sweep(kernels.ADJOINT, self._views(views), self.all_views, images=images))

    def adjoint_of_forward(self, samples: Image, views: ViewSelection = None) -> Image:
        """Return Hᵀ H f (samples), with no array as large as the images."""
        samples = self._checked("samples", samples, self.samples_shape)
        return self._sums(Sweep(kernels.NORMAL, self._views(views), self.all_views, samples))

    def adjoint_of_precision(
        self,
        samples: Image,
        images: ElementalImages,
        min_light_e: float,
        views: ViewSelection = None,
        *,
        of_each: bool = False,
    ) -> Image:
        """Return `Hᵀ[ (H 1)/(H f + b + σ²) ]` (samples), with no array as large as the images.

        The light of a pixel is at least `min_light_e` > 0, or for least squares that of its level. With `of_each`,
        return `H_zᵀ[ (H_z 1)/(H f + b + σ²) ]` of each plane z instead.
        """
        likelihood, known = images.likelihood, self._map(images.known_variance_e2())
        level = likelihood.level_e if likelihood.name == "least-squares" else min_light_e
        pixels = kernels.PixelModel(likelihood.model, known, known, level)
        operation = kernels.PRECISION_OF_EACH if of_each else kernels.PRECISION
        samples = self._checked("samples", samples, self.samples_shape)
        return self._sums(Sweep(operation, self._views(views), self.all_views, samples, pixels=pixels))

    def adjoint_of_squares(self, samples: Image, images: ElementalImages, views: ViewSelection = None) -> Image:
        """Return Hᵀ r² (samples) of the residuals `r = g − b − H f`."""
        return self._sums(self._comparison(kernels.SQUARES, samples, images, views, images.read_variance_e2))

    def adjoint_of_variance_of_squares(
        self, samples: Image, images: ElementalImages, views: ViewSelection = None
    ) -> Image:
        """Return `Hᵀ( m + 2 (m + σ²)² )` (samples), m = H f + b: the variance of squared residuals that are noise."""
        operation, known = kernels.VARIANCE_OF_SQUARES, images.read_variance_e2
        return self._sums(self._comparison(operation, samples, images, views, known))

    def adjoint_of_noise(
        self, samples: Image, images: ElementalImages, seed: int = 0, views: ViewSelection = None
    ) -> Image:
        """Return Hᵀ n (samples) of a draw of the noise n of data: its deviation √(H f + b + σ²) with random signs.

        Each number from zero on is the seed of another draw.
        """
        sweep = self._comparison(kernels.NOISE, samples, images, views, images.read_variance_e2)
        return self._sums(sweep._replace(seed=seed))

    def adjoint_of_map(self, value: float | Image, views: ViewSelection = None) -> Image:
        """Return Hᵀ g (samples) of images that all equal one map, broadcastable to (lattice, row, column)."""
        if np.ndim(value) == 0:
            if value == 0:
                return np.zeros(self.samples_shape, self.dtype)
            return self.dtype.type(value) * self.sensitivity(views)
        return self._sums(Sweep(kernels.ADJOINT, self._views(views), self.lattice_of_view, images=self._map(value)))

    def sensitivity(self, views: ViewSelection = None) -> Image:
        """Return s = Hᵀ 1 (samples): without flat field, the number of views that see each sample."""
        if views is None:
            return self._sensitivity.reshape(self.samples_shape)
        return self._sums(Sweep(kernels.ADJOINT, self._views(views), self.lattice_of_view, images=self._map(1.0)))

    @cached_property
    def _sensitivity(self) -> Image:
        sensitivity = self.sensitivity(self.all_views)
        sensitivity.flags.writeable = False
        return sensitivity

    def coverage(self, views: ViewSelection = None) -> Image:
        """Return Hᵀ H 1 (samples), by which a back-projection is divided to keep constant planes constant."""
        if self.row_sums_are_response:
            return self.sensitivity(views) if self._binary_response else self.adjoint_of_map(self.response(), views)
        return self.adjoint_of_forward(np.ones(self.samples_shape, self.dtype), views)

    @cached_property
    def _binary_response(self) -> bool:
        """True if each pixel's response is 1 or 0: then Hᵀ H 1 = Hᵀ 1."""
        response = self.response()
        return bool(((response == 0) | (response == 1)).all())

    @cached_property
    def seeing_views(self) -> NDArray[np.intp]:
        """Views in which some pixel that counts sees one of the planes."""
        reach = self._geometry.reach
        reaching = np.flatnonzero((reach[:, :, 1] > reach[:, :, 0]).any(axis=1))
        if self._geometry.valid.size == 0 and (self.response() > 0).all():
            return reaching  # every pixel that meets planes counts, and sees the nearest
        return np.array([view for view in reaching.tolist() if self.sensitivity([view]).any()], np.intp)

    def response(self) -> Image:
        """Return the relative response of each pixel (lattice, row, column)."""
        maps = self._geometry.maps.reshape(3, *self.maps_shape[:2], -1)
        return np.asarray(maps[2, ..., : self.maps_shape[2]])

    def value_and_ratio(
        self, samples: Image, images: ElementalImages, views: ViewSelection = None
    ) -> tuple[float, Image]:
        """Return the negative log-likelihood of samples, up to a constant, and Hᵀ r (samples), in one sweep.

        r is the ratio of `recon.likelihood.pixel_models`: the gradient of the negative log-likelihood is s − Hᵀ r.
        """
        value, sums = self._sweeps.run(self._likelihood(kernels.VALUE_AND_RATIO, samples, images, views))
        return value, sums.reshape(self.samples_shape)

    def adjoint_of_ratio(self, samples: Image, images: ElementalImages, views: ViewSelection = None) -> Image:
        """Return Hᵀ r (samples) alone: for shifted Poisson data Hᵀ[ (g + σ²)₊ / (H f + b + σ²) ], as in eq. (2)."""
        return self._sums(self._likelihood(kernels.RATIO, samples, images, views))

    def negative_log_likelihood(self, samples: Image, images: ElementalImages, views: ViewSelection = None) -> float:
        """Return the negative log-likelihood alone, up to a constant, in a sweep that only reads.

        For the shifted Poisson model it is `Σ m − y + y ln(y/m)`, with `y = (g + σ²)₊` and `m = H f + b + σ²`, over the
        pixels that see a plane.
        """
        return self._sweeps.run(self._likelihood(kernels.VALUE, samples, images, views))[0]

    def planes_of[Number: np.generic](self, samples: NDArray[Number]) -> list[NDArray[Number]]:
        """Return each plane (row, column) of samples, as views into them."""
        parts = np.split(samples.reshape(-1), self._geometry.layout[1:, 0])
        return [part.reshape(grid.shape) for part, grid in zip(parts, self.grids, strict=True)]

    def samples_of(self, planes: Sequence[Image]) -> Image:
        """Return the samples of planes (row, column); a single plane is not copied."""
        if [plane.shape for plane in planes] != [grid.shape for grid in self.grids]:
            shapes, wanted = (" and ".join(str(part.shape) for part in parts) for parts in (planes, self.grids))
            raise GeometryMismatch(
                f"the planes given have the shapes {shapes}, those of the operator {wanted}; give them those"
            )
        flat = [np.ascontiguousarray(plane, self.dtype).reshape(-1) for plane in planes]
        return (flat[0] if len(flat) == 1 else np.concatenate(flat)).reshape(self.samples_shape)

    def map_of_views(self, value: float | Image, views: NDArray[np.intp]) -> float | Image:
        """Return a map (lattice, row, column) as each view has it, (view, row, column); a number as it is."""
        return float(value) if np.ndim(value) == 0 else self._map(value)[self.lattice_of_view[views]]

    def _sums(self, sweep: Sweep) -> Image:
        return self._sweeps.run(sweep)[1].reshape(self.samples_shape)

    def _likelihood(self, operation: int, samples: Image, images: ElementalImages, views: ViewSelection) -> Sweep:
        known = images.read_variance_e2 if images.likelihood.knows_read_noise else 0.0
        return self._comparison(operation, samples, images, views, known)

    def _comparison(
        self,
        operation: int,
        samples: Image,
        images: ElementalImages,
        views: ViewSelection,
        read_variance_e2: float | Image,
    ) -> Sweep:
        """Return a sweep that compares samples with images of this variance besides that of light."""
        if images.valid is not None and not self._geometry.valid.size:
            raise GeometryMismatch("the images have pixels that do not count; make the operator with their `valid`")
        likelihood = images.likelihood
        known = self._map(images.background_e), self._map(read_variance_e2)
        pixels = kernels.PixelModel(likelihood.model, *known, likelihood.level_e)
        samples = self._checked("samples", samples, self.samples_shape)
        data = self._checked("images", images.electrons, self.images_shape)
        return Sweep(operation, self._views(views), self.all_views, samples, data, pixels=pixels)

    def _checked(self, name: str, array: Image, shape: tuple[int, ...]) -> Image:
        """Return samples or images in the operator's dtype, copied only where they have to be."""
        if array.shape != shape:
            raise GeometryMismatch(f"{name} have shape {array.shape}, the operator {shape}; give {name} of that shape")
        return np.ascontiguousarray(array, self.dtype)

    def _map(self, value: float | Image) -> Image:
        """Return a map of all lattices; those of numbers are kept if this operator has a place for them."""
        if np.ndim(value) == 0 and self._kept_maps is not None:
            number = float(value)
            if number not in self._kept_maps:
                self._kept_maps[number] = np.full(self.maps_shape, number, self.dtype)
            return self._kept_maps[number]
        try:
            return np.ascontiguousarray(np.broadcast_to(value, self.maps_shape), self.dtype)
        except ValueError:
            raise GeometryMismatch(
                f"a map has shape {np.shape(value)}, the operator's lattices {self.maps_shape}; give one map per "
                "lattice, or a number"
            ) from None

    def _views(self, views: ViewSelection) -> NDArray[np.intp]:
        """Return the selected views, each at most once: the kernels do not check them."""
        if views is None:
            return self.all_views
        chosen = np.asarray(views)
        if chosen.size == 0:
            return chosen.astype(np.intp)
        if chosen.dtype.kind not in "iu" or np.unique(chosen).size < chosen.size:
            raise ValueError(f"views must be whole numbers, none of them twice, got {views}")
        if chosen.min() < 0 or chosen.max() >= len(self.all_views):
            raise ValueError(f"views must lie within 0 and {len(self.all_views) - 1}, got {views}")
        return np.ascontiguousarray(chosen, np.intp)
