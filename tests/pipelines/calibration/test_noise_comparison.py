"""Differences of two measurements in units of their errors."""

import numpy as np
import pytest

from faintfield.pipelines.calibration.noise_comparison import chance, compare_maps, difference_in_sigma


def test_difference_is_in_standard_errors() -> None:
    z = 1.959964
    difference = difference_in_sigma(10.0, (10 - 3 * z, 10 + 3 * z), 15.0, (15 - 4 * z, 15 + 4 * z))
    assert difference == pytest.approx(1.0, rel=1e-6)
    assert chance(difference) == pytest.approx(0.317, abs=1e-3)
    assert np.isnan(difference_in_sigma(1.0, (1.0, 1.0), 2.0, (2.0, 2.0)))


def test_lopsided_intervals_count_by_facing_sides() -> None:
    spread, zero = (3.0, (1.0, 4.0)), (0.0, (0.0, 2.5))
    expected = 3 / (np.hypot(2.5, 2.0) / 1.959964)
    assert difference_in_sigma(*zero, *spread) == pytest.approx(expected, rel=1e-6)
    assert difference_in_sigma(*spread, *zero) == pytest.approx(-expected, rel=1e-6)


def test_maps_of_a_sensor_differ_by_errors() -> None:
    """Posterior means of offsets with spread 2, from means over frames with noise 3 each."""
    rng = np.random.default_rng(1)
    truth = 2 * rng.standard_normal(20_000)

    def measured(count: int, moved: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        noise2 = 9 / count
        mean = truth + moved * rng.standard_normal(truth.size) + np.sqrt(noise2) * rng.standard_normal(truth.size)
        kept = 4 / (4 + noise2)
        return 100 + kept * mean, np.full(truth.size, (1 - kept) * 4)

    rms, expected, probability = compare_maps(*measured(4), *measured(40))
    assert rms == pytest.approx(expected, rel=0.02)
    assert probability == 1
    assert compare_maps(*measured(4), *measured(40, moved=2.0))[2] < 1e-9


def test_common_step_is_no_change_of_maps() -> None:
    values, variance = np.random.default_rng(1).standard_normal(1000), np.full(1000, 0.1)
    assert compare_maps(values, variance, values + 50, variance)[0] == pytest.approx(0, abs=1e-9)
