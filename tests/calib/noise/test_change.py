"""Differences of two measurements in units of their errors."""

import numpy as np
import pytest

from faintfield.calib.noise.change import chance, compare_maps, difference_in_sigma


def test_the_difference_is_in_standard_errors_of_both() -> None:
    z = 1.959964
    found = difference_in_sigma(10.0, (10 - 3 * z, 10 + 3 * z), 15.0, (15 - 4 * z, 15 + 4 * z))
    assert found == pytest.approx(1.0, rel=1e-6)
    assert chance(found) == pytest.approx(0.317, abs=1e-3)


def test_lopsided_intervals_count_by_the_side_that_faces_the_other() -> None:
    spread, zero = (3.0, (1.0, 4.0)), (0.0, (0.0, 2.5))
    expected = 3 / (np.hypot(2.5, 2.0) / 1.959964)
    assert difference_in_sigma(*zero, *spread) == pytest.approx(expected, rel=1e-6)
    assert difference_in_sigma(*spread, *zero) == pytest.approx(-expected, rel=1e-6)


def test_numbers_without_errors_have_no_sigma() -> None:
    assert np.isnan(difference_in_sigma(1.0, (1.0, 1.0), 2.0, (2.0, 2.0)))


def test_maps_of_one_sensor_differ_as_their_errors_say() -> None:
    """Posterior means of offsets with spread 2, from means over frames with noise 3 each."""
    frames = (4, 40)
    rng = np.random.default_rng(1)
    truth = 2 * rng.standard_normal(20_000)

    def measured(count: int, moved: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        noise2 = 9 / count
        seen = truth + moved * rng.standard_normal(truth.size) + np.sqrt(noise2) * rng.standard_normal(truth.size)
        kept = 4 / (4 + noise2)
        return 100 + kept * seen, np.full(truth.size, (1 - kept) * 4)

    same = compare_maps(*measured(frames[0]), *measured(frames[1]))
    assert same.rms == pytest.approx(same.expected, rel=0.02)
    assert not same.grown
    changed = compare_maps(*measured(frames[0]), *measured(frames[1], moved=2.0))
    assert changed.grown
    assert changed.chance < 1e-9


def test_a_step_of_all_pixels_is_no_change_of_the_map() -> None:
    values, variance = np.random.default_rng(1).standard_normal(1000), np.full(1000, 0.1)
    assert compare_maps(values, variance, values + 50, variance).rms == pytest.approx(0, abs=1e-9)
