"""Edges of depths against all divisions of a row of samples; samples with light, by thresholds in closed form."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from faintfield.recon.surface.edges import moved_edges, near_side, values_at
from faintfield.recon.surface.goodness import lit_samples
from faintfield.recon.surface.pinhole_views import UNKNOWN
from tests.recon import surface_scene
from tests.recon.surface_scene import CENTRES_MM, FOCAL_PX, NODES, READ_VARIANCE_E2, UNMOVED, views_of

FAR, NEAR, DEPTHS = 10, 20, 32
SHAPE = (24, 40)


def _step(column: int) -> NDArray[np.float32]:
    """Return depths that are near before a column."""
    return np.tile(np.where(np.arange(SHAPE[1]) < column, NEAR, FAR), (SHAPE[0], 1)).astype(np.float32)


def _light(column: int) -> NDArray[np.float32]:
    return np.tile(np.where(np.arange(SHAPE[1]) < column, 8.0, 2.0), (SHAPE[0], 1)).astype(np.float32)


def _ratios(column: int, strength: float) -> NDArray[np.float32]:
    """Return views that show what is near before a column, and what is far from there."""
    ratios = np.zeros((*SHAPE, DEPTHS), np.float32)
    ratios[:, :column, NEAR] = ratios[:, column:, FAR] = strength
    return ratios


@pytest.mark.parametrize("truth", [16, 24])
@pytest.mark.parametrize(("light", "strength"), [(True, 0.0), (False, 0.5)], ids=["light", "views"])
def test_edge_returns_to_light_and_views(truth: int, light: bool, strength: float) -> None:
    guide = _light(truth) if light else np.full(SHAPE, 5, np.float32)
    np.testing.assert_array_equal(moved_edges(_step(20), _ratios(truth, strength), guide), _step(truth))


def test_edge_moves_no_farther_than_the_band() -> None:
    result = moved_edges(_step(20), _ratios(36, 5.0), _light(36))
    np.testing.assert_array_equal(result, _step(29))  # eight samples beyond the first far one


def test_both_sides_keep_their_depths() -> None:
    """Beside a slanted near side, the samples that join it have the depth of its edge, and no third depth."""
    index = _step(20) + np.where(_step(20) == NEAR, np.linspace(0, 2, SHAPE[0])[:, np.newaxis], 0).astype(np.float32)
    result = moved_edges(index, np.zeros((*SHAPE, DEPTHS), np.float32), _light(24))
    np.testing.assert_array_equal(result[:, :20], index[:, :20])
    np.testing.assert_array_equal(result[:, 24:], FAR)
    np.testing.assert_allclose(result[:, 20:24], np.repeat(index[:, 19:20], 4, axis=1), atol=0.1)


def test_map_without_edges_is_unchanged() -> None:
    slanted = (2 * np.indices(SHAPE)[1] / 3).astype(np.float32)
    result = moved_edges(slanted, _ratios(9, 5.0), _light(11))
    np.testing.assert_array_equal(result, slanted)


@cache
def _divisions() -> NDArray[np.int8]:
    """Return all ways to divide the 18 samples of the band, between a near one and a far one."""
    sides = np.ones((2**18, 20), np.int8)
    sides[:, -1] = 0
    sides[:, 1:-1] = np.arange(2**18)[:, np.newaxis] >> np.arange(18) & 1
    return sides


@pytest.mark.parametrize("seed", [0, 4])
def test_row_is_divided_as_the_best_division(seed: int) -> None:
    """Light and views disagree, sample by sample."""
    generator = np.random.default_rng(seed)
    light = np.tile(generator.uniform(0, 3, SHAPE[1]), (SHAPE[0], 1)).astype(np.float32)
    ratios = np.zeros((*SHAPE, DEPTHS), np.float32)
    ratios[:, :, NEAR] = generator.normal(0, 0.5, SHAPE[1])
    ratios[:, :, FAR] = generator.normal(0, 0.5, SHAPE[1])
    independent = 4 * np.pi * 1.5**2 * 0.3
    gain = (ratios[0, :, NEAR] - ratios[0, :, FAR]).astype(float)
    preferred = independent * gaussian_filter(gain, 1.5, mode="mirror")
    cost = 0.05 + np.exp(-((np.diff(light[0]) / (0.2 * light.std())) ** 2))
    first, last = 11, 29  # the band: eight samples beyond those at the edge
    sides = _divisions()
    energies = np.abs(np.diff(sides)) @ cost[first - 1 : last] - sides[:, 1:-1] @ np.clip(preferred, -3, 3)[first:last]
    best = sides[energies.argmin(), 1:-1]
    assert np.abs(np.diff(best)).sum() >= 2  # more than one cut
    result = moved_edges(_step(20), ratios, light)
    np.testing.assert_array_equal(result[12, first:last], np.where(best, NEAR, FAR))


def test_the_sides_of_an_edge() -> None:
    index = np.zeros((5, 6))
    index[1:3, 2:5] = 4
    index[4, 0] = 3  # not more than a slope
    near, far = near_side(index), near_side(index, of_near=False)
    assert np.argwhere(near).tolist() == [[1, 2], [1, 3], [1, 4], [2, 2], [2, 3], [2, 4]]
    far_samples = [[0, 2], [0, 3], [0, 4], [1, 1], [1, 5], [2, 1], [2, 5], [3, 2], [3, 3], [3, 4]]
    assert np.argwhere(far).tolist() == far_samples


def test_values_between_two_depths_are_interpolated() -> None:
    volume = np.random.default_rng(2).normal(size=(3, 4, 6)).astype(np.float32)
    index = np.random.default_rng(3).uniform(0, 5, (3, 4))
    index[0, 0], index[2, 3] = 0, 5
    expected = [np.interp(index[at], np.arange(6), volume[at]) for at in np.ndindex(3, 4)]
    np.testing.assert_allclose(values_at(volume, index).ravel(), expected, rtol=1e-5, atol=1e-6)


EVERYWHERE = np.full(surface_scene.SHAPE, UNMOVED)

# The window of 1.5 samples averages as much noise as this many equal weights
WINDOW = 4 * np.pi * 1.5**2


def _lit(light_e: NDArray[np.floating], inverse_depth: NDArray[np.floating] = EVERYWHERE) -> NDArray[np.bool_]:
    return lit_samples(views_of(light_e), inverse_depth)


def _even(left_e: float, right_e: float | None = None, views: int = len(NODES)) -> NDArray[np.float64]:
    """Return views of one brightness, or of two with a border in the middle; all but the first `views` are unknown."""
    light = np.full((len(NODES), *surface_scene.SHAPE), left_e)
    light[:, :, surface_scene.SHAPE[1] // 2 :] = left_e if right_e is None else right_e
    light[views:] = UNKNOWN
    return light


def test_light_of_four_standard_deviations_stands_out() -> None:
    views = 5
    share = 16 / (views * WINDOW)
    limit_e = (share + np.sqrt(share**2 + 4 * share * READ_VARIANCE_E2)) / 2
    assert not _lit(_even(0.98 * limit_e, views=views)).any()
    assert _lit(_even(1.02 * limit_e, views=views)).all()


def test_light_below_three_percent_does_not_count() -> None:
    # The level is that of the bright half, over √2
    for dim_e, stands_out in ((0.97 * 3 / np.sqrt(2), False), (1.03 * 3 / np.sqrt(2), True)):
        lit = _lit(_even(100.0, dim_e))
        assert lit[:, :30].all()
        assert (lit[:, 50:] == stands_out).all()


def test_noise_alone_is_not_light() -> None:
    generator = np.random.default_rng(3)
    noise = generator.normal(0, READ_VARIANCE_E2**0.5, (len(NODES), *surface_scene.SHAPE))
    assert not _lit(noise).any()


def test_light_is_that_at_the_surfaces_depth() -> None:
    # A disc around column 40 and row 30, so dim that one view alone would not stand out
    q = 1 / 300
    row, column = np.indices(surface_scene.SHAPE, float)
    light = np.array(
        [
            np.where(np.hypot(column + right * (q - UNMOVED) - 40, row + down * (q - UNMOVED) - 30) < 6, 0.5, 0)
            for right, down in FOCAL_PX * CENTRES_MM
        ]
    )
    lit = _lit(light, np.full(surface_scene.SHAPE, q))
    assert lit[30, 40]
    assert not lit[30, 60]
    assert not _lit(light)[30, 40]
