"""Edges of depths move to where light and views have them; a row of samples against all its divisions."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from faintfield.recon.surface.edges import moved_edges, near_side, values_at

FAR, NEAR, DEPTHS = 10, 20, 32
SHAPE = (24, 40)


def _step(column: int) -> NDArray[np.float32]:
    """Depths that are near before a column."""
    return np.tile(np.where(np.arange(SHAPE[1]) < column, NEAR, FAR), (SHAPE[0], 1)).astype(np.float32)


def _light(column: int) -> NDArray[np.float32]:
    return np.tile(np.where(np.arange(SHAPE[1]) < column, 8.0, 2.0), (SHAPE[0], 1)).astype(np.float32)


def _ratios(column: int, strength: float) -> NDArray[np.float32]:
    """Views that show what is near before a column, and what is far from there."""
    ratios = np.zeros((*SHAPE, DEPTHS), np.float32)
    ratios[:, :column, NEAR] = ratios[:, column:, FAR] = strength
    return ratios


@pytest.mark.parametrize("truth", [16, 24])
def test_an_edge_four_samples_off_returns_to_the_edge_of_light(truth: int) -> None:
    found = moved_edges(_step(20), np.zeros((*SHAPE, DEPTHS), np.float32), _light(truth))
    np.testing.assert_array_equal(found, _step(truth))


@pytest.mark.parametrize("truth", [16, 24])
def test_an_edge_four_samples_off_returns_to_where_the_views_see_it(truth: int) -> None:
    found = moved_edges(_step(20), _ratios(truth, 0.5), np.full(SHAPE, 5, np.float32))
    np.testing.assert_array_equal(found, _step(truth))


def test_an_edge_moves_no_farther_than_the_band() -> None:
    found = moved_edges(_step(20), _ratios(36, 5.0), _light(36))
    np.testing.assert_array_equal(found, _step(29))  # eight samples beyond the first far one


def test_both_sides_keep_the_depths_they_have() -> None:
    """Where the near side is slanted, the samples that join it have the depth of its edge, and no third depth."""
    index = _step(20) + np.where(_step(20) == NEAR, np.linspace(0, 2, SHAPE[0])[:, np.newaxis], 0).astype(np.float32)
    found = moved_edges(index, np.zeros((*SHAPE, DEPTHS), np.float32), _light(24))
    np.testing.assert_array_equal(found[:, :20], index[:, :20])
    np.testing.assert_array_equal(found[:, 24:], FAR)
    np.testing.assert_allclose(found[:, 20:24], np.repeat(index[:, 19:20], 4, axis=1), atol=0.1)


def test_a_map_without_edges_is_returned_as_it_is() -> None:
    slanted = (2 * np.indices(SHAPE)[1] / 3).astype(np.float32)
    found = moved_edges(slanted, _ratios(9, 5.0), _light(11))
    np.testing.assert_array_equal(found, slanted)


@cache
def _divisions() -> NDArray[np.int8]:
    """All ways to divide the 18 samples of the band, between a near one and a far one."""
    sides = np.ones((2**18, 20), np.int8)
    sides[:, -1] = 0
    sides[:, 1:-1] = np.arange(2**18)[:, np.newaxis] >> np.arange(18) & 1
    return sides


@pytest.mark.parametrize("seed", [0, 4])
def test_a_row_is_divided_as_the_best_of_all_its_divisions(seed: int) -> None:
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
    found = moved_edges(_step(20), ratios, light)
    np.testing.assert_array_equal(found[12, first:last], np.where(best, NEAR, FAR))


def test_the_sides_of_an_edge() -> None:
    index = np.zeros((5, 6))
    index[1:3, 2:5] = 4
    index[4, 0] = 3  # not more than a slope
    near, far = near_side(index), near_side(index, of_near=False)
    assert np.argwhere(near).tolist() == [[1, 2], [1, 3], [1, 4], [2, 2], [2, 3], [2, 4]]
    beside = [[0, 2], [0, 3], [0, 4], [1, 1], [1, 5], [2, 1], [2, 5], [3, 2], [3, 3], [3, 4]]
    assert np.argwhere(far).tolist() == beside


def test_values_between_two_depths_are_interpolated() -> None:
    volume = np.random.default_rng(2).normal(size=(3, 4, 6)).astype(np.float32)
    index = np.random.default_rng(3).uniform(0, 5, (3, 4))
    index[0, 0], index[2, 3] = 0, 5
    expected = [np.interp(index[at], np.arange(6), volume[at]) for at in np.ndindex(3, 4)]
    np.testing.assert_allclose(values_at(volume, index).ravel(), expected, rtol=1e-5, atol=1e-6)
