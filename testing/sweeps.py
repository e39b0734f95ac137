"""The contract of sweeps over detector pixels, which every implementation must meet, and sweeps by sparse matrices."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.special import logsumexp, softmax, xlogy
from scipy.stats import norm, poisson

from faintfield.recon.likelihood.images import Image
from faintfield.recon.likelihood.pixel_models import LEAST_SQUARES, POISSON_GAUSSIAN, SHIFTED_POISSON
from faintfield.recon.operator import kernels
from faintfield.recon.operator.geometry import DetectorMaps, scene_geometry
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.kernels import Hiding
from faintfield.recon.operator.occlusion import Occluders, hiding_of
from faintfield.recon.operator.placement import EDGE_TOLERANCE, UNSEEN
from faintfield.recon.operator.relief import Relief
from faintfield.recon.operator.sweeps import Sweep, Sweeps

type Scene = tuple[kernels.SceneGeometry, Hiding]

# Counts that the exact model sums over; the scenes below have at most thirty electrons.
_COUNTS = np.arange(80.0)

_FOCAL_PX, _DETECTOR = 60.0, (5, 150)


class ArraySweeps:
    """Sweeps by one sparse matrix per view: slow, plainly written, and nothing in them is compiled for the purpose."""

    def __init__(self, geometry: kernels.SceneGeometry, hiding: Hiding, workers: int) -> None:
        del workers
        self._geometry, self._hiding = geometry, hiding
        self._dtype = geometry.maps.dtype
        self._kept: dict[int, list[sparse.csr_array]] = {}

    def run(self, sweep: Sweep) -> tuple[float, Image]:
        """Do an operation view by view."""
        operation, views, image_of_view, samples, images, expected_images, pixels, seed = sweep
        value, sums = 0.0, np.zeros(kernels.size_of(self._geometry))
        light = None if samples is None else samples.reshape(-1).astype(np.float64)
        for view in views.tolist():
            planes, image = self._planes(view), image_of_view[view]
            matrix = sparse.hstack(planes, "csr")
            if operation == kernels.REACH:
                self._reach(view)
            elif operation == kernels.ADJOINT:
                assert images is not None
                sums += matrix.T @ images[image].reshape(-1)
            else:
                assert light is not None
                expected = matrix @ light
                if operation == kernels.FORWARD:
                    assert expected_images is not None
                    expected_images[image] = expected.reshape(expected_images.shape[1:])
                elif operation == kernels.NORMAL:
                    sums += matrix.T @ expected
                elif operation in (kernels.SQUARES, kernels.VARIANCE_OF_SQUARES, kernels.NOISE):
                    _, background, variance, _ = self._known(view, pixels)
                    mean = expected + background
                    if operation == kernels.SQUARES:
                        assert images is not None
                        sums += matrix.T @ (images[image].reshape(-1) - mean) ** 2
                    elif operation == kernels.VARIANCE_OF_SQUARES:
                        sums += matrix.T @ (mean + 2 * (mean + variance) ** 2)
                    else:
                        key = _scramble(np.array([seed * len(self._geometry.lattice_of_view) + view], np.uint32))
                        odd = _scramble(np.arange(mean.size, dtype=np.uint32) ^ key) % 2
                        sums += matrix.T @ (np.where(odd, -1, 1) * np.sqrt(mean + variance))
                elif operation in (kernels.PRECISION, kernels.PRECISION_OF_EACH):
                    precision = 1 / self._variance(view, expected, pixels)
                    alone = [matrix] if operation == kernels.PRECISION else planes
                    sums += np.concatenate([part.T @ (precision * part.sum(axis=1)) for part in alone])
                else:
                    assert images is not None
                    response = np.max([part.sum(axis=1) for part in planes], axis=0)
                    of_view, ratio = self._compare(view, expected, images[image].reshape(-1), response, pixels)
                    value += of_view
                    sums += matrix.T @ ratio
        reads = operation in kernels.ONLY_READING
        return value, np.zeros(1, self._dtype) if reads else np.asarray(sums, self._dtype)

    def _places(self, view: int) -> Iterator[tuple[Image, Image, NDArray[np.bool_], tuple[int, int]]]:
        """Yield the row and column of each pixel on each plane, whether it sees the plane, and the plane's shape."""
        rows, columns, _ = self._geometry.detector
        views = len(self._geometry.lattice_of_view)
        homographies = self._geometry.homographies.reshape(-1, views, 3, 3).astype(np.float64)
        x, y, _ = self._maps(view)
        rays = np.stack([x, y, np.ones_like(x)])
        for plane, (_, height, width, _) in enumerate(self._geometry.layout.tolist()):
            column, row, scale = np.tensordot(homographies[plane, view], rays, 1)
            if self._geometry.bent:
                codes = self._geometry.relief.reshape(views, rows, columns)[view]
                nearer = np.where(codes == UNSEEN, np.nan, codes * float(self._geometry.relief_step))
                moved = np.tensordot(homographies[1, view], rays, 1) * nearer
                column, row = column + moved[0], row + moved[1]
            with np.errstate(divide="ignore", invalid="ignore"):
                column, row = column / scale, row / scale
                outside = np.maximum(np.abs(column - (width - 1) / 2) - (width - 1) / 2, 0)
                outside = np.maximum(outside, np.abs(row - (height - 1) / 2) - (height - 1) / 2)
                sees = (scale > 0) & (outside <= EDGE_TOLERANCE)
            clipped = (np.clip(at, 0, last - 1) for at, last in ((row, height), (column, width)))
            row, column = (np.where(sees, at, 0.0) for at in clipped)
            yield row, column, sees, (height, width)

    def _maps(self, view: int) -> Image:
        """Return the rays' x and y and the response of each pixel of a view (3, row, column)."""
        rows, columns, padded = self._geometry.detector
        maps = self._geometry.maps.reshape(3, -1, rows, padded)
        return np.asarray(maps[:, self._geometry.lattice_of_view[view], :, :columns], np.float64)

    def _planes(self, view: int) -> list[sparse.csr_array]:
        """Return H of one view for each plane, made once."""
        if view not in self._kept:
            self._kept[view] = self._matrices(view)
        return self._kept[view]

    def _matrices(self, view: int) -> list[sparse.csr_array]:
        """Return H of one view for each plane: bilinear weights times the response and what nearer planes leave."""
        bilinear = []
        for row, column, sees, shape in self._places(view):
            top, left = np.minimum(np.floor(row), shape[0] - 2), np.minimum(np.floor(column), shape[1] - 2)
            down, right = row - top, column - left
            parts = []
            for dy, dx, weight in (
                (0, 0, (1 - down) * (1 - right)),
                (0, 1, (1 - down) * right),
                (1, 0, down * (1 - right)),
                (1, 1, down * right),
            ):
                at = ((top + dy) * shape[1] + left + dx).astype(np.intp).reshape(-1)
                entries = ((weight * sees).reshape(-1), (np.arange(at.size), at))
                parts.append(sparse.coo_array(entries, (at.size, shape[0] * shape[1])).tocsr())
            bilinear.append(sum(parts[1:], parts[0]))
        counts = self._maps(view)[2].reshape(-1)
        if self._geometry.valid.size:
            counts = counts * self._geometry.valid.reshape(-1, counts.size)[view]
        return [
            sparse.csr_array(sparse.diags_array(counts * through) @ matrix)
            for matrix, through in zip(bilinear, self._transmission(bilinear), strict=True)
        ]

    def _transmission(self, bilinear: list[sparse.csr_array]) -> list[Image]:
        """Return what nearer planes leave of each plane's light, for each pixel."""
        through: list[Image] = [np.ones(matrix.shape[0]) for matrix in bilinear]
        if not self._hiding.opacities.size:
            return through
        alphas = np.split(self._hiding.opacities, self._geometry.layout[1:, 0])
        for near, (matrix, alpha) in enumerate(zip(bilinear, alphas, strict=True)):
            left = np.maximum(1 - matrix @ alpha.astype(np.float64), 0)
            for far in range(len(bilinear)):
                if self._hiding.depths[far] > self._hiding.depths[near]:
                    through[far] *= left
        return through

    def _reach(self, view: int) -> None:
        """Write the columns at which each row's pixels see any plane."""
        sees = np.any([place[2] for place in self._places(view)], axis=0)
        for row, of_row in enumerate(sees):
            columns = np.flatnonzero(of_row)
            self._geometry.reach[view, row] = (columns[0], columns[-1] + 1) if columns.size else (0, 0)

    def _known(self, view: int, pixels: kernels.PixelModel | None) -> tuple[int, Image, Image, float]:
        """Return the model, the background and the variance of a view's pixels, and the level."""
        assert pixels is not None
        lattice, size = self._geometry.lattice_of_view[view], self._geometry.detector[0] * self._geometry.detector[1]
        background, variance = (np.asarray(part, np.float64).reshape(-1, size)[lattice] for part in pixels[1:3])
        return pixels.model, background, variance, pixels.level

    def _variance(self, view: int, expected: Image, pixels: kernels.PixelModel | None) -> Image:
        model, _, variance, level = self._known(view, pixels)
        response = self._maps(view)[2].reshape(-1)
        return variance + (level * response if model == LEAST_SQUARES else np.maximum(expected, level))

    def _compare(
        self, view: int, expected: Image, observed: Image, response: Image, pixels: kernels.PixelModel | None
    ) -> tuple[float, Image]:
        """Return the negative log-likelihood of the pixels that see a plane, and the ratio of each."""
        model, background, variance, level = self._known(view, pixels)
        mean, sees = expected + background, response > 0
        if model == SHIFTED_POISSON:
            shifted, mean = np.maximum(observed + variance, 0), mean + variance
            return float((mean - shifted + xlogy(shifted, shifted / mean))[sees].sum()), shifted / mean
        if model == LEAST_SQUARES:
            scaled = (observed - mean) / (level * response + background + variance)
            return float((0.5 * scaled * (observed - mean))[sees].sum()), 1 + scaled
        joint = poisson.logpmf(_COUNTS, mean[:, np.newaxis])
        joint += norm.logpdf(observed[:, np.newaxis], _COUNTS, np.sqrt(variance)[:, np.newaxis])
        value = -logsumexp(joint, axis=1) - 0.5 * np.log(2 * np.pi * variance)
        return float(value[sees].sum()), softmax(joint, axis=1) @ _COUNTS / mean


def _scramble(bits: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return the bits that `kernels.scramble` gives, all at once."""
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        bits = (bits ^ (bits >> np.uint32(shift))) * np.uint32(factor)
    return bits ^ (bits >> np.uint32(16))


def sweeps_contract(make: Callable[[kernels.SceneGeometry, Hiding, int], Sweeps]) -> None:
    """Check sweeps over planes, planes that hide one another, a mosaic and a surface, in float32 and float64.

    Parameters
    ----------
    make : callable
        The class to be checked: (geometry, hiding, workers) to sweeps.

    Raises
    ------
    AssertionError
        The sweeps differ from those of sparse matrices, or change what they only read.
    """
    for dtype, tolerance in ((np.float64, 1e-9), (np.float32, 2e-3)):
        for number, make_scene in enumerate((_planes, _hidden_planes, _mosaic, _surface)):
            for workers in (1, 3):
                generator = np.random.default_rng((number, workers))
                scene = make_scene(generator, np.dtype(dtype))
                _check_scene(make, scene, workers, generator, tolerance)


def _check_scene(
    make: Callable[[kernels.SceneGeometry, Hiding, int], Sweeps],
    scene: Scene,
    workers: int,
    generator: np.random.Generator,
    tolerance: float,
) -> None:
    """Check all operations on one scene, on all views and on some in another order."""
    geometry, hiding = scene
    dtype, views = geometry.maps.dtype, len(geometry.lattice_of_view)
    rows, columns, _ = geometry.detector
    lattices = geometry.maps.size // (3 * rows * geometry.detector[2])
    tested, truth = make(_own_reach(geometry), hiding, workers), ArraySweeps(_own_reach(geometry), hiding, 1)
    everything = np.arange(views)
    tested.run(Sweep(kernels.REACH, everything, everything))
    samples = generator.uniform(0.2, 6.0, kernels.size_of(geometry)).astype(dtype)
    images = generator.normal(4.0, 3.0, (views, rows, columns)).astype(dtype)
    background, variance = generator.uniform(0.2, 3.0, (2, lattices, rows, columns)).astype(dtype)
    kept = samples.copy(), images.copy()

    def check_sums(operation: int, chosen: NDArray[np.intp], allowed: float = tolerance, **arrays: Any) -> None:
        sums, wanted = (sweeps.run(Sweep(operation, chosen, everything, **arrays))[1] for sweeps in (tested, truth))
        _close(sums, wanted, allowed)

    for chosen in (everything, everything[-2::-2].copy()):
        check_sums(kernels.ADJOINT, chosen, images=images)
        check_sums(kernels.NORMAL, chosen, samples=samples)
        # Images numbered in the order in which views are chosen
        image_of_view = np.zeros(views, np.intp)
        image_of_view[chosen] = np.arange(len(chosen))
        found, wanted = np.zeros((2, len(chosen), rows, columns), dtype)
        tested.run(Sweep(kernels.FORWARD, chosen, image_of_view, samples=samples, expected_images=found))
        truth.run(Sweep(kernels.FORWARD, chosen, image_of_view, samples=samples, expected_images=wanted))
        assert wanted.any(), "the scene of the contract is seen"
        _close(found, wanted, tolerance)
        for model in (SHIFTED_POISSON, POISSON_GAUSSIAN, LEAST_SQUARES):
            pixels = kernels.PixelModel(model, background, variance, 1.5)
            check_sums(kernels.PRECISION, chosen, samples=samples, pixels=pixels)
            check_sums(kernels.PRECISION_OF_EACH, chosen, samples=samples, pixels=pixels)
            of_data: dict[str, Any] = {"samples": samples, "images": images, "pixels": pixels}
            check_sums(kernels.SQUARES, chosen, **of_data)
            check_sums(kernels.VARIANCE_OF_SQUARES, chosen, samples=samples, pixels=pixels)
            for seed in (0, 5):
                check_sums(kernels.NOISE, chosen, samples=samples, pixels=pixels, seed=seed)
            # The exact model's sum over counts may leave out what is below 1e-7
            allowed = max(tolerance, 1e-6) if model == POISSON_GAUSSIAN else tolerance
            value, ratio = truth.run(Sweep(kernels.VALUE_AND_RATIO, chosen, everything, **of_data))
            for operation in (kernels.RATIO, kernels.VALUE, kernels.VALUE_AND_RATIO):
                tested_value, tested_ratio = tested.run(Sweep(operation, chosen, everything, **of_data))
                if operation != kernels.RATIO:
                    assert abs(tested_value - value) <= allowed * abs(value), (tested_value, value)
                if operation != kernels.VALUE:
                    _close(tested_ratio, ratio, allowed)
    for array, before in zip((samples, images), kept, strict=True):
        np.testing.assert_array_equal(array, before, "what a sweep reads is left as it is")


def _close(actual: Image, desired: Image, tolerance: float) -> None:
    np.testing.assert_allclose(actual.reshape(-1), desired.reshape(-1), rtol=tolerance, atol=tolerance * desired.max())


def _own_reach(geometry: kernels.SceneGeometry) -> kernels.SceneGeometry:
    return geometry._replace(reach=geometry.reach.copy())


def _rays() -> Image:
    rows, columns = _DETECTOR
    x, y = np.meshgrid(np.arange(columns) - 70.3, np.arange(rows) - 2.2)
    return np.stack([x, y], axis=-1)[np.newaxis] / _FOCAL_PX


def _grid(rows: int, columns: int, pitch: float, depth_mm: float) -> PlaneGrid:
    pitch_mm = pitch * depth_mm / _FOCAL_PX
    return PlaneGrid((rows, columns), pitch_mm, (-columns * pitch_mm / 2, -rows * pitch_mm / 2))


def _homographies(generator: np.random.Generator, views: int, depth_mm: float) -> Image:
    """Return views displaced by a few samples and turned a little; the last one sees only an edge of the plane."""
    turns = generator.uniform(-0.02, 0.02, (views, 3))
    moved_mm = np.random.default_rng(3).uniform(-20, 20, (views, 2))  # the same for all planes
    moved_mm[-1, 0] = 900.0
    homographies = np.zeros((views, 3, 3))
    for homography, (yaw, pitch, roll), (x_mm, y_mm) in zip(homographies, turns, moved_mm, strict=True):
        homography[:] = [[depth_mm, -roll * depth_mm, x_mm], [roll * depth_mm, depth_mm, y_mm], [yaw, pitch, 1.0]]
    return homographies


def _planes(generator: np.random.Generator, dtype: np.dtype[np.floating]) -> Scene:
    """Return two planes, a response that varies and is zero somewhere, pixels that do not count."""
    depths_mm, views = (500.0, 700.0), 4
    grids = [_grid(12, 130, 1.0, depths_mm[0]), _grid(9, 90, 1.7, depths_mm[1])]
    homographies = np.stack([_homographies(generator, views, depth) for depth in depths_mm])
    flat = generator.uniform(0.4, 1.0, _DETECTOR) * (generator.random(_DETECTOR) > 0.1)
    valid = generator.random((views, *_DETECTOR)) > 0.1
    return scene_geometry(homographies, DetectorMaps(_rays(), flat, dtype), grids, valid, None), hiding_of(
        None, grids, dtype
    )


def _hidden_planes(generator: np.random.Generator, dtype: np.dtype[np.floating]) -> Scene:
    """Return three planes, two of the same depth, the nearest last."""
    depths_mm = (700.0, 700.0, 300.0)
    grids = [_grid(12, 130, 1.0, 700.0), _grid(9, 90, 1.7, 700.0), _grid(10, 120, 1.0, 300.0)]
    homographies = np.stack([_homographies(generator, 3, depth) for depth in depths_mm])
    opacities = [(generator.random(grid.shape) < 0.1) * generator.uniform(0, 1, grid.shape) for grid in grids]
    opacities[2][3:6, 40:60] = 1.0
    geometry = scene_geometry(homographies, DetectorMaps(_rays(), None, dtype), grids, None, None)
    return geometry, hiding_of(Occluders(opacities, depths_mm), grids, dtype)


def _mosaic(generator: np.random.Generator, dtype: np.dtype[np.floating]) -> Scene:
    """Return views on two lattices of pixels that advance by two samples."""
    lattice_of_view = np.array([0, 1, 1, 0, 0])
    grids = [_grid(12, 280, 0.5, 500.0)]
    rays = np.concatenate([_rays(), _rays() + 0.5 / _FOCAL_PX])
    flat = generator.uniform(0.4, 1.0, (2, *_DETECTOR))
    homographies = _homographies(generator, 5, 500.0)[np.newaxis]
    geometry = scene_geometry(homographies, DetectorMaps(rays, flat, dtype), grids, None, lattice_of_view)
    return geometry, hiding_of(None, grids, dtype)


def _surface(generator: np.random.Generator, dtype: np.dtype[np.floating]) -> Scene:
    """Return a plane bent by some samples, with pixels that see nothing."""
    grids = [_grid(14, 150, 1.0, 500.0)]
    homographies = _homographies(generator, 3, 500.0)[np.newaxis]
    slopes = np.zeros((3, 3, 3))
    slopes[:, 0] = generator.uniform(-1, 1, (3, 3))
    slopes[:, 1] = generator.uniform(-0.3, 0.3, (3, 3))
    codes = (3000 * np.sin(np.arange(_DETECTOR[1]) / 20) * np.ones((3, *_DETECTOR))).astype(np.int16)
    codes[generator.random(codes.shape) < 0.05] = UNSEEN
    relief = Relief(codes, 1e-3, 0.0)
    geometry = scene_geometry(homographies, DetectorMaps(_rays(), None, dtype), grids, None, None, (slopes, relief))
    return geometry, hiding_of(None, grids, dtype)
