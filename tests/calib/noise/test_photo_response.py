"""Dead pixels, vignetting and PRNU of responses that are made of known parts."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.noise.maps.photo_response import Response, _kept_share, _running_mean, measure_response

type Array = NDArray[np.float64]

SHAPE = (48, 64)


def measured(response: Array, noise_dn2: float = 1.0, seed: int = 1) -> Response:
    """Measure the response to a signal of 10 000 DN with noise."""
    rng = np.random.default_rng([seed, 1])
    signal = 1e4 * response + np.sqrt(noise_dn2) * rng.standard_normal(response.shape)
    return measure_response(signal, noise_dn2, np.ones(response.shape, bool))


def spread(seed: int, shape: tuple[int, int] = SHAPE) -> Array:
    return np.asarray(1 + 0.01 * np.random.default_rng(seed).standard_normal(shape))


def test_the_part_of_prnu_that_the_running_mean_takes_is_given_back() -> None:
    """Each sensor tells it to 1.3 %; the mean of 40 to 0.2 %, and the running mean takes 1 %."""
    found = [measured(spread(seed), 400.0, seed) for seed in range(100, 140)]
    assert np.mean([it.prnu for it in found]) == pytest.approx(0.01, rel=0.006)
    z = np.array([(it.prnu - 0.01) / it.prnu_se for it in found])
    assert abs(z.mean()) < 3 / np.sqrt(z.size)
    assert 0.7 < z.std() < 1.3


def test_the_given_part_is_that_of_the_running_mean_as_a_matrix() -> None:
    """Of a unit response in one pixel at a time, brute force."""
    shape, usable = (17, 19), np.ones((17, 19), bool)
    units = np.eye(usable.size).reshape(-1, *shape)
    rest = np.array([unit - _running_mean(unit, usable, 15) for unit in units])
    np.testing.assert_allclose(_kept_share(usable)(slice(None)), np.square(rest).sum(axis=0), rtol=1e-9)


@pytest.mark.parametrize("times", [4.0, 10.0])
def test_an_edge_or_a_corner_of_the_light_makes_no_dead_pixels(times: float) -> None:
    rows, columns = np.indices(SHAPE)
    for bright in (rows < 20, (rows < 20) | (columns > 40), (rows < 20) & (columns > 40)):
        found = measured(spread(2) * np.where(bright, times, 1.0))
        assert not found.dead.any()
        assert "times as bright in one part" in found.why_no_prnu
        assert found.prnu_estimate(1.96).value is None


def test_dead_pixels_are_found_on_both_sides_of_an_edge() -> None:
    response = spread(3) * np.where(np.arange(SHAPE[0]) < 20, 4.0, 1.0)[:, None]
    dead = {(10, 30), (10, 31), (22, 10), (0, 0), (40, 63)}
    for at in dead:
        response[at] *= 0.3
    assert {tuple(at) for at in np.argwhere(measured(response).dead).tolist()} == dead


def test_light_that_differs_by_less_than_two_leaves_a_prnu() -> None:
    x = np.linspace(-1, 1, SHAPE[1])
    found = measured(spread(4) * (1 - 0.35 * x**2))
    assert not found.why_no_prnu
    assert found.prnu == pytest.approx(0.01, rel=0.05)


def test_colour_filters_that_nobody_stated_are_hinted_at() -> None:
    filters = np.tile([[0.5, 1.0], [1.0, 0.3]], (SHAPE[0] // 2, SHAPE[1] // 2))
    found = measured(spread(5) * filters)
    assert not found.dead.any()
    assert "mosaic =" in found.why_no_prnu
    assert found.prnu_estimate(1.96).why == found.why_no_prnu
    assert not measured(spread(5) * np.where(filters > 0.5, 1.05, 1.0)).why_no_prnu
