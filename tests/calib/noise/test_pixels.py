"""Defects and shrinkage of single pixels against their formulas."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.noise import Conditions, Series, measure_series
from faintfield.calib.noise.pixels import (
    hot_pixels,
    measure_response,
    noisy_pixels,
    pixel_levels,
    shrunk_variance_ratio,
)
from faintfield.calib.noise.statistics import robust_sigma
from tests.calib.noise.darkroom import darks, specimen


def ratios(variance: float) -> NDArray[np.float64]:
    """Return 10 000 ratios of mean 1 and of exactly this variance."""
    ratio = np.random.default_rng(4).normal(size=(100, 100))
    ratio -= ratio.mean()
    return np.asarray(1 + np.sqrt(variance) * ratio / ratio.std())


@pytest.mark.parametrize("freedom", [9.0, 27.0])
def test_variances_are_shrunk_once_their_scatter_exceeds_chance_by_three_standard_errors(freedom: float) -> None:
    usable = np.ones((100, 100), bool)
    chance = 2 / freedom
    se = chance * np.sqrt(2 / 10_000)
    for excess in (-se, 0.0, 2.9 * se):
        np.testing.assert_array_equal(shrunk_variance_ratio(ratios(chance + excess), freedom, usable), 1.0)
    for excess in (3.1 * se, 0.5, 4.0):
        found = shrunk_variance_ratio(ratios(chance + excess), freedom, usable)
        assert found.std() > 0
    np.testing.assert_array_equal(shrunk_variance_ratio(ratios(4.0), 0.0, usable), 1.0)


def test_halves_of_a_sensor_keep_their_own_noise() -> None:
    """2 and 4 e⁻: a prior with one centre draws the quiet half up by an eighth."""
    rng = np.random.default_rng(3)
    freedom, truth = 27.0, np.where(np.arange(100) < 50, 0.4, 1.6) * np.ones((100, 1))
    ratio = truth * rng.chisquare(freedom, truth.shape) / freedom
    found = shrunk_variance_ratio(ratio, freedom, np.ones(truth.shape, bool))
    for half in (slice(0, 50), slice(50, 100)):
        assert np.sqrt(found[:, half]).mean() == pytest.approx(np.sqrt(truth[0, half][0]), rel=0.02)
    assert np.std(found / truth) < 0.55 * np.std(ratio / truth)


def test_variances_of_a_known_population_have_their_posterior_means() -> None:
    """Inverse gamma variances have conjugate posteriors: (ν₀ s² + ν r)/(ν₀ + ν − 2), the best that can be done."""
    rng = np.random.default_rng(5)
    freedom, prior = 20.0, 12.0
    truth = prior / rng.chisquare(prior, (150, 150))
    ratio = truth * rng.chisquare(freedom, truth.shape) / freedom
    best = (prior + freedom * ratio) / (prior + freedom - 2)
    found = shrunk_variance_ratio(ratio, freedom, np.ones(truth.shape, bool))
    rms = [np.sqrt(np.mean((one - truth) ** 2)) for one in (found, best, ratio)]
    assert rms[0] < 1.05 * rms[1] < rms[2]


def test_only_usable_pixels_tell_the_scatter() -> None:
    usable = np.ones((100, 100), bool)
    usable[:, :50] = False
    ratio = ratios(2 / 9)
    ratio[:, :50] *= 100.0
    ratio[:, 50:] = ratios(2 / 9)[:, :50]
    found = shrunk_variance_ratio(ratio, 9.0, usable)
    even = shrunk_variance_ratio(ratio[:, 50:], 9.0, usable[:, 50:])
    np.testing.assert_allclose(found[:, 50:], even)


def test_a_pixel_in_a_hundred_sensors_is_noisy_by_chance() -> None:
    generator = np.random.default_rng(1)
    flagged = sum(int(noisy_pixels(generator.chisquare(20, (200, 200)) / 20, 20.0).sum()) for _ in range(50))
    assert flagged <= 4
    ratio = generator.chisquare(20, (200, 200)) / 20
    ratio[3, 4] = 4.5
    assert np.argwhere(noisy_pixels(ratio, 20.0)).tolist() == [[3, 4]]


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
    noise_dn2, pattern_dn2 = [48.0, 56.0, 96.0], 1.5
    hot = np.zeros((24, 20), bool)
    hot[3, 4] = True
    found = pixel_levels(taken, values, noise_dn2, pattern_dn2, hot)
    t = np.array([0.1, 10.0, 60.0])
    design = np.stack([np.ones(3), t], axis=1)
    weights = np.diag(np.array([10, 8, 5]) / noise_dn2)
    means = np.array([one.mean_dn - one.mean_dn.mean(where=~hot) for one in taken])
    for place, prior in (((5, 6), np.diag([1 / 10.5, 1 / 0.002])), ((3, 4), np.diag([1 / 10.5, 1e-12]))):
        covariance = np.linalg.inv(design.T @ weights @ design + prior)
        expected = np.array([100.0, 0.4]) + covariance @ design.T @ weights @ means[:, *place]
        assert found.offset_dn[place] == pytest.approx(expected[0], rel=1e-9)
        assert found.dark_signal_dn_per_s[place] == pytest.approx(expected[1], rel=1e-9)
        assert found.offset_variance_dn2[place] == pytest.approx(covariance[0, 0], rel=1e-9)
        assert found.dark_signal_variance_dn2_per_s2[place] == pytest.approx(covariance[1, 1], rel=1e-9)


def test_without_a_second_exposure_a_hot_pixel_has_the_common_dark_signal() -> None:
    taken = [series(1.0, 10, 1)]
    hot = np.zeros((24, 20), bool)
    hot[3, 4] = True
    found = pixel_levels(taken, {"offset_dn": 100.0, "dsnu_dn2": 9.0}, [48.0], 0.0, hot)
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
    found = measure_response(signals, [noise_dn2, 0.5 * noise_dn2], usable)
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
