"""Defects and shrinkage of single pixels against their formulas."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.noise import Conditions, Series, measure_series
from faintfield.calib.noise.maps.photo_response import measure_response
from faintfield.calib.noise.maps.pixels import (
    LinePattern,
    hot_pixels,
    line_pattern,
    noisy_pixels,
    outlying_pixels,
    pixel_levels,
)
from faintfield.calib.noise.series.statistics import robust_sigma
from tests.calib.noise.darkroom import darks, specimen


def test_a_pixel_in_a_hundred_sensors_lies_out_by_chance() -> None:
    generator = np.random.default_rng(1)
    flagged = sum(int(outlying_pixels(generator.chisquare(20, (200, 200)) / 20, 20.0).sum()) for _ in range(50))
    assert flagged <= 4
    ratio = generator.chisquare(20, (200, 200)) / 20
    ratio[3, 4] = 4.5
    assert np.argwhere(outlying_pixels(ratio, 20.0)).tolist() == [[3, 4]]


def test_a_population_with_a_tail_towards_much_noise_lies_out_by_chance_only_but_jumping_pixels_do() -> None:
    """Variances of pixels as of an sCMOS sensor: log-normal, 60 % wide; one jumps and has thirty times the usual."""
    generator = np.random.default_rng(4)
    flagged = 0
    for _ in range(20):
        own = np.exp(0.6 * generator.standard_normal((60, 80)))
        ratio = own / own.mean() * generator.chisquare(42, own.shape) / 42
        ratio[5, 6] = 30.0
        found = outlying_pixels(ratio, 42.0)
        assert found[5, 6]
        flagged += int(found.sum()) - 1
    assert flagged <= 4


def test_outlying_pixels_are_of_no_use_at_five_times_the_usual_noise_or_twice_if_they_jump() -> None:
    ratio = np.full((5, 5), 2.0)
    ratio[0] = [49.0, 51.0, 7.9, 8.1, 51.0]
    outlying, telegraph = np.zeros((5, 5), bool), np.zeros((5, 5), bool)
    outlying[0, :4] = telegraph[0, 2:4] = True
    assert np.argwhere(noisy_pixels(outlying, ratio, telegraph)).tolist() == [[0, 1], [0, 3]]


def series(exposure_s: float, frames: int, seed: int, **changes: object) -> Series:
    chip, _ = specimen(11, shape=(24, 20), **changes)
    taken = darks(chip, [exposure_s], frames, np.random.default_rng(seed))[exposure_s]
    return measure_series(taken, Conditions("dark", exposure_s))


def test_hot_pixels_lie_five_robust_deviations_above_the_median_rise_from_the_shortest_to_the_longest() -> None:
    taken = [series(10.0, 20, 1), series(0.1, 20, 2), series(60.0, 20, 3, hot_fraction=0.02)]
    rise_dn = taken[2].mean_dn - taken[1].mean_dn
    found = hot_pixels(taken)
    np.testing.assert_array_equal(found, rise_dn > np.median(rise_dn) + 5 * robust_sigma(rise_dn))
    assert 3 <= found.sum() <= 20
    assert not hot_pixels([taken[1], taken[1]]).any(), "one exposure tells no dark signal"


def test_the_levels_of_a_pixel_are_the_posterior_means_of_its_own_linear_model() -> None:
    taken = [series(0.1, 10, 1), series(10.0, 8, 2), series(60.0, 5, 3)]
    values = {"offset_dn": 100.0, "dark_signal_dn_per_s": 0.4, "dsnu_dn2": 9.0, "dcnu_dn2_per_s2": 0.002}
    own_dn2 = np.arange(480.0).reshape(24, 20)
    noise_dn2: list[Callable[[slice], NDArray[np.float64] | float]]
    noise_dn2 = [lambda rows: 48.0 + own_dn2[rows], lambda rows: 56.0, lambda rows: 96.0]
    pattern = LinePattern(np.zeros(24), np.linspace(-3, 3, 20), 1.5)
    hot = np.zeros((24, 20), bool)
    hot[3, 4] = True
    found = pixel_levels(taken, values, noise_dn2, pattern, hot)
    t = np.array([0.1, 10.0, 60.0])
    design = np.stack([np.ones(3), t], axis=1)
    means = np.array([one.mean_dn - one.mean_dn.mean(where=~hot) for one in taken]) - pattern.of(slice(None))
    for place, prior in (((5, 6), np.diag([1 / 10.5, 1 / 0.002])), ((3, 4), np.diag([1 / 10.5, 1e-12]))):
        weights = np.diag(np.array([10, 8, 5]) / [48.0 + 20 * place[0] + place[1], 56.0, 96.0])
        covariance = np.linalg.inv(design.T @ weights @ design + prior)
        expected = np.array([100.0, 0.4]) + covariance @ design.T @ weights @ means[:, *place]
        assert found.offset_dn[place] == pytest.approx(expected[0] + pattern.column_dn[place[1]], rel=1e-6)
        assert found.dark_signal_dn_per_s[place] == pytest.approx(expected[1], rel=1e-6)
        assert found.offset_variance_dn2[place] == pytest.approx(covariance[0, 0], rel=1e-6)
        assert found.dark_signal_variance_dn2_per_s2[place] == pytest.approx(covariance[1, 1], rel=1e-6)


def test_the_pattern_of_columns_is_shrunk_by_the_chance_of_its_means() -> None:
    rng = np.random.default_rng(12)
    # Column means scatter by 2² of their own, by 4²/64 of the pixels' offsets and by 3²/64/8 of their noise.
    own, offsets = 2.0 * rng.standard_normal((1, 90)), 4.0 * rng.standard_normal((64, 90))
    frames = [
        (f"{k}", np.rint(500 + own + offsets + 3.0 * rng.standard_normal((64, 90))).astype(np.uint16)) for k in range(8)
    ]
    found = line_pattern([measure_series(frames, Conditions("dark", 0.1))], 16.0)
    chance = 16 / 64 + 9 / 64 / 8
    kept = 4 / (4 + chance)
    profile = own + offsets.mean(axis=0)
    np.testing.assert_allclose(found.column_dn, (kept * (profile - profile.mean()))[0], atol=0.4)
    assert found.variance_dn2 == pytest.approx(kept * chance, rel=0.2)
    assert np.ptp(found.row_dn) < 1.0, "rows share next to nothing"


def test_without_a_second_exposure_a_hot_pixel_has_the_common_dark_signal() -> None:
    taken = [series(1.0, 10, 1)]
    hot = np.zeros((24, 20), bool)
    hot[3, 4] = True
    pattern = LinePattern(np.zeros(24), np.zeros(20), 0.0)
    found = pixel_levels(taken, {"offset_dn": 100.0, "dsnu_dn2": 9.0}, [lambda rows: 48.0], pattern, hot)
    assert found.dark_signal_dn_per_s[3, 4] == pytest.approx(0.0, abs=1e-6)


def test_the_response_is_vignetting_times_what_pixels_differ_beyond_noise() -> None:
    generator = np.random.default_rng(9)
    rows, columns = np.indices((160, 200))
    vignetting = 1 - 0.3 * (((columns - 99.5) / 200) ** 2 + ((rows - 79.5) / 160) ** 2)
    prnu, noise_dn2, level_dn = 0.01, 900.0, 5000.0
    true = vignetting * (1 + prnu * generator.standard_normal(vignetting.shape))
    true[20, 30] = 0.3 * vignetting[20, 30]
    signals = [
        level_dn * share * true + np.sqrt(share * vignetting * noise_dn2) * generator.standard_normal(true.shape)
        for share in (1.0, 0.5)
    ]
    usable = np.ones(true.shape, bool)
    usable[100, 100] = False
    found = measure_response(signals[0] + signals[1], 1.5 * noise_dn2, usable)
    assert np.argwhere(found.dead).tolist() == [[20, 30]]
    assert found.prnu == pytest.approx(prnu, abs=3 * found.prnu_se)
    # The scatter of the quotients of signal and vignetting is that of PRNU and noise together
    total2 = prnu**2 + noise_dn2 * 1.5 / (1.5 * level_dn) ** 2
    assert found.prnu_se == pytest.approx(total2 * np.sqrt(2 / true.size) / (2 * prnu), rel=0.05)
    inner = np.s_[12:-12, 12:-12]
    np.testing.assert_allclose(found.vignetting[inner], (vignetting / vignetting.mean())[inner], rtol=0.01)
    off = (found.relative / (true / true.mean()) - 1)[inner][(usable & ~found.dead)[inner]]
    noise2 = noise_dn2 * 1.5 / (1.5 * level_dn) ** 2
    # Shrunk by k = p²/(p² + n), the error is that of the best linear estimate
    assert off.std() == pytest.approx(np.sqrt(prnu**2 * noise2 / (prnu**2 + noise2)), rel=0.1)
    assert found.relative[100, 100] == found.vignetting[100, 100]
    stated = (found.relative_se / found.relative)[inner][(usable & ~found.dead)[inner]]
    assert np.sqrt(np.mean((off / stated) ** 2)) == pytest.approx(1.0, abs=0.1)
