"""H of several planes at once: what each detector pixel of each view sees of a scene, and the exact adjoint."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator import blocks, kernels
from faintfield.recon.operator.geometry import checked_geometry
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.threads import at_once

type Views = Sequence[int] | NDArray[np.integer] | None


class SceneOperator:
    """H of a scene of planes, each with a grid of its own: what a pixel sees is the sum of what it sees of each.

    `g = Σ_z H_z f_z`, in one sweep over the pixels. All that is said of one plane in `recon.operator.plane.PlaneOperator`
    holds for each of these.

    Parameters
    ----------
    plane_from_ray : array (plane, view, 3, 3)
        Homographies from a ray (x, y, 1) to the coordinates (x, y, 1) of each plane in mm; the homogeneous scale is
        positive for points in front of the camera.
    rays, flat, valid, lattice_of_view, dtype, workers
        As of `recon.operator.plane.PlaneOperator`.
    grids : sequence of PlaneGrid
        The samples of each plane.
    transmission : float array (plane, view, row, column), optional
        How much of a plane's light reaches a pixel, past what stands before it: multiplies H and Hᵀ. One by default.

    Raises
    ------
    GeometryMismatch
        Shapes do not fit together, a number is not finite, a transmission is negative, or no pixel of any view sees one
        of the planes.
    """

    def __init__(
        self,
        plane_from_ray: NDArray[np.floating],
        rays: NDArray[np.floating],
        grids: Sequence[PlaneGrid],
        *,
        flat: NDArray[np.floating] | None = None,
        valid: NDArray[np.bool_] | None = None,
        transmission: NDArray[np.floating] | None = None,
        lattice_of_view: NDArray[np.intp] | None = None,
        dtype: type[np.float32] | type[np.float64] = np.float32,
        workers: int | None = None,
    ) -> None:
        self.grids = tuple(grids)
        self.dtype: np.dtype[np.floating[Any]] = np.dtype(dtype)
        self._workers = workers or int(numba.config.NUMBA_NUM_THREADS)
        rays = rays[np.newaxis] if rays.ndim == 3 else rays
        self._geometry = checked_geometry(
            plane_from_ray, rays, self.grids, flat, valid, transmission, lattice_of_view, self.dtype
        )
        self.maps_shape: tuple[int, int, int] = (rays.shape[0], rays.shape[1], rays.shape[2])
        self.images_shape = (plane_from_ray.shape[1], *self.maps_shape[1:])
        self.all_views = np.arange(self.images_shape[0])
        self._sweep(kernels.REACH, self.all_views, self.all_views)
        for grid, sensitivity in zip(self.grids, self.sensitivity(), strict=True):
            if not sensitivity.any():
                raise GeometryMismatch(
                    f"no pixel of any of the {len(self.all_views)} views sees the plane of {grid.shape[1]} x "
                    f"{grid.shape[0]} samples at {grid.pitch_mm:.3g} mm; check its depth, the poses and their signs, "
                    "and that not all pixels are masked (saturated, hot)"
                )

    def forward(self, planes: Sequence[Image], views: Views = None) -> Image:
        """Return Σ_z H_z f_z: the planes (row, column) as each view sees them together, (view, row, column)."""
        chosen = self._views(views)
        seen = np.zeros((len(chosen), *self.images_shape[1:]), self.dtype)
        image_of_view = np.zeros(self.images_shape[0], np.intp)
        image_of_view[chosen] = np.arange(len(chosen))
        self._sweep(kernels.FORWARD, chosen, image_of_view, planes=self.samples_of(planes), seen=seen)
        return seen

    def adjoint(self, images: Image, views: Views = None) -> list[Image]:
        """Return H_zᵀ g (row, column) of each plane for images (view, row, column), summed over `views`."""
        return self._sweep(kernels.ADJOINT, self._views(views), self.all_views, images=self._images(images))[1]

    def adjoint_of_map(self, value: float | Image, views: Views = None) -> list[Image]:
        """Return Hᵀ applied to images that all equal one map, broadcastable to (lattice, row, column)."""
        lattices = self._geometry.lattice_of_view
        return self._sweep(kernels.ADJOINT, self._views(views), lattices, images=self._map(value))[1]

    def sensitivity(self, views: Views = None) -> list[Image]:
        """Return s_z = H_zᵀ 1 (row, column) of each plane."""
        return self.adjoint_of_map(1.0, views)

    @cached_property
    def seeing_views(self) -> NDArray[np.intp]:
        """The views of which some pixel that counts sees one of the planes."""
        return np.array([view for view in self.all_views.tolist() if any(s.any() for s in self.sensitivity([view]))])

    def response(self) -> Image:
        """Return the relative response of each pixel (lattice, row, column)."""
        maps = self._geometry.maps.reshape(3, *self.maps_shape[:2], -1)
        return np.asarray(maps[2, ..., : self.maps_shape[2]])

    def value_and_ratio(
        self, planes: Sequence[Image], images: ElementalImages, views: Views = None
    ) -> tuple[float, list[Image]]:
        """Return the negative log-likelihood of the planes together and H_zᵀ r (row, column) of each, in one sweep.

        r is the ratio of `recon.likelihood.pixel_models`: the negative log-likelihood has the derivatives s_z − H_zᵀ r. Terms that
        depend on no plane are left out.
        """
        return self._likelihood(kernels.VALUE_AND_RATIO, planes, images, views)

    def adjoint_of_ratio(self, planes: Sequence[Image], images: ElementalImages, views: Views = None) -> list[Image]:
        """Return H_zᵀ r (row, column) of each plane alone: a pass of an EM iteration."""
        return self._likelihood(kernels.RATIO, planes, images, views)[1]

    def negative_log_likelihood(self, planes: Sequence[Image], images: ElementalImages, views: Views = None) -> float:
        """Return the negative log-likelihood alone, in a sweep that only reads."""
        return self._likelihood(kernels.VALUE, planes, images, views)[0]

    def _likelihood(
        self, operation: int, planes: Sequence[Image], images: ElementalImages, views: Views
    ) -> tuple[float, list[Image]]:
        """Run one of the sweeps that compare planes with the data."""
        if images.valid is not None and not self._geometry.valid.size:
            raise GeometryMismatch("the images have pixels that do not count; make the operator with their `valid`")
        likelihood = images.likelihood
        pixels = kernels.PixelModel(
            likelihood.model,
            _read_only(self._map(images.background_e)),
            _read_only(self._map(images.read_variance_e2 if likelihood.knows_read_noise else 0.0)),
            likelihood.level_e,
        )
        samples, electrons, chosen = self.samples_of(planes), self._images(images.electrons), self._views(views)
        return self._sweep(operation, chosen, self.all_views, planes=samples, images=electrons, pixels=pixels)

    def _sweep(
        self,
        operation: int,
        views: NDArray[np.intp],
        image_of_view: NDArray[np.intp],
        *,
        planes: Image | None = None,
        images: Image | None = None,
        seen: Image | None = None,
        pixels: kernels.PixelModel | None = None,
    ) -> tuple[float, list[Image]]:
        """Run one kernel on all workers and return the sums of their values and of their accumulators."""
        nothing = _read_only(np.zeros(1, self.dtype))
        scatters = operation in (kernels.ADJOINT, kernels.RATIO, kernels.VALUE_AND_RATIO)
        size = sum(grid.shape[0] * grid.shape[1] for grid in self.grids) if scatters else 1
        sums = [np.zeros(size, self.dtype) for _ in range(self._workers)]
        values = [0.0] * self._workers

        def work(worker: int) -> None:
            values[worker] = kernels.sweep(
                operation,
                nothing if planes is None else _read_only(planes),
                np.zeros(1, self.dtype) if seen is None else seen.reshape(-1),
                sums[worker],
                nothing if images is None else _read_only(images),
                _read_only(image_of_view),
                pixels or kernels.PixelModel(0, nothing, nothing, 0.0),
                self._geometry,
                blocks.workspace(len(self.grids), self.dtype),
                _read_only(views),
                worker,
                self._workers,
            )

        at_once(work, range(self._workers))
        for other in sums[1:]:
            sums[0] += other
        return sum(values), self.planes_of(sums[0]) if scatters else []

    def planes_of[Number: np.generic](self, samples: NDArray[Number]) -> list[NDArray[Number]]:
        """Return each plane (row, column) of all samples (sample,), which lie one plane after the other."""
        parts = np.split(samples, self._geometry.layout[1:, 0])
        return [part.reshape(grid.shape) for part, grid in zip(parts, self.grids, strict=True)]

    def map_of_views(self, value: float | Image, views: NDArray[np.intp]) -> float | Image:
        """Return a map (lattice, row, column) as each view has it, (view, row, column); a number as it is."""
        return value if np.ndim(value) == 0 else self._map(value)[self._geometry.lattice_of_view[views]]

    def samples_of(self, planes: Sequence[Image]) -> Image:
        """Return all planes (sample,), one after the other; a single one is not copied."""
        if [plane.shape for plane in planes] != [grid.shape for grid in self.grids]:
            shapes = " and ".join(str(plane.shape) for plane in planes)
            wanted = " and ".join(str(grid.shape) for grid in self.grids)
            raise GeometryMismatch(
                f"the planes given have the shapes {shapes}, those of the operator {wanted}; give them those"
            )
        flat = [np.ascontiguousarray(plane, self.dtype).reshape(-1) for plane in planes]
        return flat[0] if len(flat) == 1 else np.concatenate(flat)

    def _images(self, images: Image) -> Image:
        if images.shape != self.images_shape:
            raise GeometryMismatch(
                f"images have shape {images.shape}, the operator {self.images_shape}; give them that"
            )
        return np.ascontiguousarray(images, self.dtype)

    def _map(self, value: float | Image) -> Image:
        try:
            return np.ascontiguousarray(np.broadcast_to(value, self.maps_shape), self.dtype)
        except ValueError:
            raise GeometryMismatch(
                f"a map has shape {np.shape(value)}, the operator's lattices {self.maps_shape}; give "
                "one per lattice, or a number"
            ) from None

    def _views(self, views: Views) -> NDArray[np.intp]:
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


def _read_only[Number: np.generic](array: NDArray[Number]) -> NDArray[Number]:
    """Return all elements in a row, as a view that cannot be written to.

    Arrays that can and cannot are different types to the compiler, and a memory map may be of either kind.
    """
    flat = array.reshape(-1)
    flat.flags.writeable = False
    return flat
