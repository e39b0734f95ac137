"""Maps of sensors whose every pixel is known: read noise, gain, response, offsets and defects."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.noise import Conditions, NoiseCalibration, Series, calibrate, measure_series
from faintfield.calib.noise.likelihood.response import quantum_efficiency
from faintfield.calib.noise.maps.defects import outlying_pixels
from faintfield.calib.noise.maps.measure import LinePattern, line_pattern, pixel_levels
from faintfield.calib.noise.maps.photo_response import (
    Response,
    SignalNoise,
    _kept_share,
    kept_freedom,
    measure_response,
    running_mean,
)
from faintfield.calib.noise.maps.read_noise_map import PixelReadNoise, kept_of, measure_read_noise
from faintfield.calib.noise.maps.seams import find_seams, share_of_seam
from tests.calib.noise import darkroom
from tests.calib.noise.darkroom import darks, specimen, with_flats

type Array = NDArray[np.float64]

SHAPE = (64, 72)
LEFT = np.arange(SHAPE[1]) < SHAPE[1] // 2
EVERY = np.ones(SHAPE, bool)
NO_CURRENT = {"dark_current_e_per_s": 0.0}


def measured(stack: list[Array], conditions: Conditions) -> Series:
    return measure_series([(str(k), np.rint(frame)) for k, frame in enumerate(stack)], conditions)


def dark_series(sigma_dn: Array, frames: int, rng: np.random.Generator, shot_dn2: float = 0.0) -> Series:
    """Return the statistics of darks with this noise of each pixel and offsets that differ by 3 DN."""
    noise_dn = np.sqrt(sigma_dn**2 + shot_dn2)
    chip, _ = specimen(rng, shape=sigma_dn.shape, gain_dn_per_e=1.0, read_noise_e=noise_dn, dsnu_e=3.0, **NO_CURRENT)
    return darkroom.dark_series(chip, (0.1,), frames, rng)[0]


def read_noise(sigma_dn: Array, frames: int, seed: int) -> PixelReadNoise:
    """Return the read noise that is measured of a sensor whose mean noise is known."""
    mean_dn2 = float(np.mean(sigma_dn**2))
    series = dark_series(sigma_dn, frames, np.random.default_rng(seed))
    return measure_read_noise([series], mean_dn2, [mean_dn2 + 1 / 12], EVERY)


def test_spot_of_less_noise_keeps_its_own() -> None:
    """A prior with one centre draws the quiet pixels up by 9 %, and the means of rows and columns by another 5 %."""
    rows, columns = np.indices(SHAPE)
    spot = (rows - 30) ** 2 + (columns - 40) ** 2 < 20**2
    truth = np.where(spot, 4.0, 8.0)
    noise_dn = read_noise(truth, 40, 1).read_noise_dn
    assert np.median(noise_dn[spot]) == pytest.approx(4.0, rel=0.02)
    assert np.median(noise_dn[~spot]) == pytest.approx(8.0, rel=0.02)
    assert np.mean((noise_dn / truth - 1) ** 2) < 0.2 / (2 * 39), "a fifth of the error of its own frames"


def test_log_normal_noise_has_the_posterior_error() -> None:
    """With ln σ ~ N(m, s²) and errors of ln σ of variance 1/(2ν), the posterior has variance 1/(1/s² + 2ν)."""
    truth = 5.0 * np.exp(0.08 * np.random.default_rng(2).standard_normal(SHAPE))
    noise = read_noise(truth, 40, 3)
    error = noise.read_noise_dn / truth - 1
    assert error.std() < 1.05 * (1 / 0.08**2 + 2 * 39) ** -0.5
    assert np.sqrt(np.mean((error * truth / noise.se_dn) ** 2)) == pytest.approx(1.0, abs=0.12)


def test_columns_and_single_pixels_keep_their_noise() -> None:
    """A column of 64 pixels of 19 degrees of freedom each tells its noise to 2 %, where a pixel tells it to 16 %."""
    rng = np.random.default_rng(4)
    columns = 6.0 * np.exp(0.15 * rng.standard_normal((1, SHAPE[1]))) * np.ones((SHAPE[0], 1))
    assert np.std(read_noise(columns, 20, 5).read_noise_dn / columns) < 0.035
    truth, loud = np.full(SHAPE, 4.0), rng.random(SHAPE) < 0.01
    truth[loud] = rng.uniform(16.0, 30.0, loud.sum())
    ratio = read_noise(truth, 40, 7).read_noise_dn / truth
    assert np.std(ratio[loud]) < 0.15
    assert np.std(ratio[~loud]) < 0.03


def test_like_pixels_have_one_noise() -> None:
    noise = read_noise(np.full(SHAPE, 5.0), 20, 8)
    assert not noise.resolved
    np.testing.assert_allclose(noise.read_noise_dn, 5.0)
    assert 0 < noise.se_dn.max() < 0.05 * 5.0


def test_shot_noise_is_no_read_noise() -> None:
    rng = np.random.default_rng(9)
    truth = 5.0 * np.exp(0.3 * rng.standard_normal(SHAPE))
    mean_dn2 = float(np.mean(truth**2))
    series = [dark_series(truth, 20, rng), dark_series(truth, 30, rng, shot_dn2=40.0)]
    noise = measure_read_noise(series, mean_dn2, [mean_dn2 + 1 / 12, mean_dn2 + 40 + 1 / 12], EVERY)
    assert noise.read_noise_dn.mean() == pytest.approx(truth.mean(), rel=0.01)
    assert np.std(np.log(noise.read_noise_dn / truth)) < 0.14


def test_subtracted_means_mix_variances_as_matrices() -> None:
    variance = np.random.default_rng(10).uniform(1, 9, (5, 7))
    whole = np.kron(np.eye(5) - 1 / 5, np.eye(7) - 1 / 7)
    expected = np.diag(whole @ np.diag(variance.ravel()) @ whole.T).reshape(5, 7)
    kept = kept_of(lambda rows: variance[rows], np.ones((5, 7), bool))
    np.testing.assert_allclose(kept(slice(None), variance), expected, rtol=1e-12)


@pytest.mark.parametrize(("lines", "regions"), [("columns", "halves"), ("columns", "alternate"), ("rows", "quarters")])
def test_seam_is_measured_beside_a_gradient(lines: str, regions: str) -> None:
    rows, columns = np.indices(SHAPE)
    at, size = (rows, SHAPE[0]) if lines == "rows" else (columns, SHAPE[1])
    region = {"halves": 2 * at // size, "quarters": 4 * at // size % 2, "alternate": at % 2}[regions]
    smooth = 0.5 * columns / SHAPE[1] + 0.3 * (rows / SHAPE[0]) ** 2
    noise = np.random.default_rng(12).standard_normal(SHAPE)
    (seam,) = find_seams(smooth + noise + 0.5 * region, np.ones(SHAPE))
    assert (seam.lines, seam.regions) == (lines, regions)
    assert seam.difference == pytest.approx(0.5, abs=4 * seam.se)
    assert not find_seams(smooth + noise, np.ones(SHAPE)), "a gradient is no seam"
    share, se = share_of_seam(seam, 0.7 * seam.of(slice(None)) + noise, np.ones(SHAPE))
    assert share == pytest.approx(0.7, abs=4 * se)


def calibrated(
    seed: int, *, gain: Array | float = 2.0, response: Array | float = 1.0, jump_e: Array | float = 0.0
) -> NoiseCalibration:
    """Calibrate a sensor from 40 darks and 40 flats each of three levels."""
    read_e = 1.5 * np.exp(0.15 * np.random.default_rng([seed, 1]).standard_normal(SHAPE))
    chip, rng = specimen(
        seed, shape=SHAPE, gain_dn_per_e=gain, read_noise_e=read_e, dsnu_e=0.0, jump_e=jump_e, **NO_CURRENT
    )
    chip = replace(chip, response=response * np.ones(SHAPE))
    return calibrate(with_flats(chip, rng, (2000.0, 8000.0, 24000.0), (0.1,), 40, 40), 65535)


def test_gains_of_pixels_and_taps_are_measured() -> None:
    gain = 2.0 * np.where(LEFT, 0.98, 1.02) * (1 + 0.03 * np.random.default_rng(13).standard_normal(SHAPE))
    result = calibrated(14, gain=gain)
    maps = result.maps
    assert maps.gain_dn_per_e is not None
    assert maps.gain_se_dn_per_e is not None
    assert maps.relative_response is not None
    assert np.std(maps.gain_dn_per_e / gain) < 0.007, "one number is off by 3.6 %"
    assert maps.gain_se_dn_per_e.mean() / 2 < 0.015
    assert np.std(maps.relative_response) < 0.007, "divided by its gain each pixel has the same light"
    assert any("halves of the columns" in warning for warning in result.warnings)
    model = result.noise_model()
    np.testing.assert_array_equal(model.gain_dn_per_e, maps.gain_dn_per_e)
    assert np.ptp(model.read_variance_e2()) > 1.0


def test_step_of_gain_is_none_of_the_response() -> None:
    """Pairs of frames, and dim flats, of which a half of the variance is dark noise that the gain scales, too."""
    rng, shape, series = np.random.default_rng(35), (128, 160), []
    gain = np.where(np.arange(shape[1]) < shape[1] // 2, 0.5, 0.55)
    response = 1 + 0.01 * rng.standard_normal(shape)
    for level, light in enumerate((0.0, 90.0, 180.0, 300.0)):
        conditions = Conditions("flat", 0.1, level, light) if light else Conditions("dark", 0.1)
        stack = [100 + gain * (rng.poisson(light * response) + 15.0 * rng.standard_normal(shape)) for _ in range(4)]
        series.append(measured(stack, conditions))
    result = calibrate(series, 65535)
    assert result.maps.gain_dn_per_e is not None
    assert result.maps.read_noise_e is not None
    left, right = (result.maps.gain_dn_per_e[:, half].mean() for half in (slice(0, 70), slice(90, 160)))
    assert right / left == pytest.approx(1.1, abs=0.003)
    noise_e = result.maps.read_noise_e
    assert noise_e[:, :70].mean() == pytest.approx(noise_e[:, 90:].mean(), rel=0.03)
    prnu = result.estimates["prnu"]
    assert prnu.value == pytest.approx(0.01, abs=4 * (prnu.se or 0.0))


def test_less_light_is_no_gain_of_pixels() -> None:
    own = 1 + 0.03 * np.random.default_rng(15).standard_normal(SHAPE)
    result = calibrated(16, response=np.where(LEFT, 0.98, 1.02) * own)
    assert result.maps.gain_dn_per_e is None
    assert "nothing shows that gains differ" in result.maps.absent["gain_dn_per_e"]
    assert not any("halves" in warning for warning in result.warnings)


def test_telegraph_pixels_are_marked() -> None:
    rng = np.random.default_rng(17)
    jump_e = np.where(rng.random(SHAPE) < 0.02, rng.uniform(8.0, 12.0, SHAPE), 0.0)
    result = calibrated(18, jump_e=jump_e)
    for marked in (result.pixels.telegraph, result.pixels.noisy):
        assert (marked & (jump_e > 0)).sum() > 0.9 * (jump_e > 0).sum()
    assert (result.pixels.telegraph & (jump_e == 0)).sum() <= 2
    assert any("jump between two levels" in warning for warning in result.warnings)


def test_strong_normal_noise_is_no_telegraph_noise() -> None:
    rng = np.random.default_rng(19)
    sigma_dn = np.where(rng.random(SHAPE) < 0.03, 12.0, 3.0)
    result = calibrate([dark_series(sigma_dn, 40, rng)])
    assert result.pixels.telegraph.sum() <= 2
    assert result.pixels.noisy.sum() <= 2


@pytest.mark.parametrize(("freedom", "spread", "jump"), [(20, 0.0, 4.5), (42, 0.6, 30.0)], ids=["alike", "sCMOS"])
def test_few_pixels_lie_out_by_chance(freedom: int, spread: float, jump: float) -> None:
    """Variances of pixels of an sCMOS sensor are log-normal, 60 % wide; a pixel that jumps lies out in each sensor."""
    rng, flagged = np.random.default_rng(4), 0
    for _ in range(20):
        own = np.exp(spread * rng.standard_normal((100, 120)))
        ratio = own / own.mean() * rng.chisquare(freedom, own.shape) / freedom
        ratio[5, 6] = jump
        outlying = outlying_pixels(ratio, float(freedom))
        assert outlying[5, 6]
        flagged += int(outlying.sum()) - 1
    assert flagged <= 4


def test_pixel_levels_are_posterior_means() -> None:
    """Each pixel has a linear model of its own; a hot one has a wide prior of its dark signal."""
    t, counts = np.array([0.1, 10.0, 60.0]), np.array([10, 8, 5])
    chip = specimen(11, shape=(24, 20))[0]
    series = [
        measure_series(darks(chip, [at], n, np.random.default_rng(n))[at], Conditions("dark", at))
        for at, n in zip(t.tolist(), counts.tolist(), strict=True)
    ]
    values = {"offset_dn": 100.0, "dark_signal_dn_per_s": 0.4, "dsnu_dn2": 9.0, "dcnu_dn2_per_s2": 0.002}
    own_dn2 = np.arange(480.0).reshape(24, 20)
    noise_dn2: list[Callable[[slice], Array | float]]
    noise_dn2 = [lambda rows: 48.0 + own_dn2[rows], lambda rows: 56.0, lambda rows: 96.0]
    pattern = LinePattern(np.zeros(24), np.linspace(-3, 3, 20), 1.5)
    hot = np.zeros((24, 20), bool)
    hot[3, 4] = True
    levels = pixel_levels(series, values, noise_dn2, pattern, hot)
    design = np.stack([np.ones(3), t], axis=1)
    means = np.array([dark.mean_dn - dark.mean_dn.mean(where=~hot) for dark in series]) - np.add.outer(
        pattern.row_dn, pattern.column_dn
    )
    for place, prior in (((5, 6), np.diag([1 / 10.5, 1 / 0.002])), ((3, 4), np.diag([1 / 10.5, 1e-12]))):
        weights = np.diag(counts / [48.0 + 20 * place[0] + place[1], 56.0, 96.0])
        covariance = np.linalg.inv(design.T @ weights @ design + prior)
        expected = np.array([100.0, 0.4]) + covariance @ design.T @ weights @ means[:, *place]
        assert levels.offset_dn[place] == pytest.approx(expected[0] + pattern.column_dn[place[1]], rel=1e-6)
        assert levels.dark_signal_dn_per_s[place] == pytest.approx(expected[1], rel=1e-6)
        assert levels.offset_variance_dn2[place] == pytest.approx(covariance[0, 0], rel=1e-6)
        assert levels.dark_signal_variance_dn2_per_s2[place] == pytest.approx(covariance[1, 1], rel=1e-6)
    alone = pixel_levels(series[:1], {"offset_dn": 100.0, "dsnu_dn2": 9.0}, noise_dn2[:1], pattern, hot)
    assert alone.dark_signal_dn_per_s[3, 4] == pytest.approx(0.0, abs=1e-6), "one exposure tells no dark signal"


def test_pattern_of_columns_is_shrunk() -> None:
    """Column means scatter by 2² of their own, by 4²/64 of the pixels' offsets and by 3²/64/8 of their noise."""
    rng = np.random.default_rng(12)
    own, offsets = 2.0 * rng.standard_normal((1, 90)), 4.0 * rng.standard_normal((64, 90))
    stack = [500 + own + offsets + 3.0 * rng.standard_normal((64, 90)) for _ in range(8)]
    pattern = line_pattern([measured(stack, Conditions("dark", 0.1))], 16.0)
    chance = 16 / 64 + 9 / 64 / 8
    kept, profile = 4 / (4 + chance), own + offsets.mean(axis=0)
    np.testing.assert_allclose(pattern.column_dn, (kept * (profile - profile.mean()))[0], atol=0.4)
    assert pattern.variance_dn2 == pytest.approx(kept * chance, rel=0.2)
    assert np.ptp(pattern.row_dn) < 1.0, "rows share next to nothing"


def test_quantum_efficiency_is_a_line_through_zero() -> None:
    photons, charges = np.array([100.0, 200.0, 400.0]), np.array([52.0, 98.0, 203.0])
    slope, se = quantum_efficiency(photons, charges, 0.01)
    (expected,), (squares,), *_ = np.linalg.lstsq(photons[:, None], charges)
    assert slope == pytest.approx(expected)
    assert se == pytest.approx(np.hypot(0.01 * slope, np.sqrt(squares / 2 / np.sum(photons**2))))
    assert quantum_efficiency(photons[:1], charges[:1], 0.01) == pytest.approx((0.52, 0.0052))


def responding(response: Array, noise_dn2: float = 1.0, seed: int = 1) -> Response:
    """Measure the response to a signal of 10 000 DN with noise."""
    noise = np.sqrt(noise_dn2) * np.random.default_rng([seed, 1]).standard_normal(response.shape)
    return measure_response(1e4 * response + noise, SignalNoise(noise_dn2, 0.0), np.ones(response.shape, bool))


def spread(seed: int) -> Array:
    return np.asarray(1 + 0.01 * np.random.default_rng(seed).standard_normal((48, 64)))


def test_prnu_lost_in_the_running_mean_is_restored() -> None:
    """Each sensor tells it to 1.3 %; the mean of 40 to 0.2 %, and the running mean takes 1 %."""
    responses = [responding(spread(seed), 400.0, seed) for seed in range(100, 140)]
    assert np.mean([response.prnu for response in responses]) == pytest.approx(0.01, rel=0.006)
    z = np.array([(response.spread2 - 0.01**2) / response.spread2_se for response in responses])
    assert abs(z.mean()) < 3 / np.sqrt(z.size)
    assert 0.7 < z.std() < 1.3


def test_sensor_without_prnu_is_shown_as_such() -> None:
    """Its interval holds zero as often as it says, and no more than one in a thousand is hidden."""
    found = [responding(np.ones((32, 40)), 900.0, seed).prnu_estimate() for seed in range(200)]
    assert sum(prnu.value is None for prnu in found) <= 1
    assert np.mean([(prnu.ci95 or (0.0, 0.0))[0] == 0 for prnu in found]) > 0.94


def test_freedom_that_smoothing_keeps_is_that_of_a_matrix() -> None:
    shape, usable = (17, 19), np.ones((17, 19), bool)
    bases = [np.linalg.qr(np.vander(np.linspace(-1, 1, size), 5, increasing=True))[0] for size in shape]
    surface = [np.outer(bases[0][:, i], bases[1][:, k]) for i in range(5) for k in range(5 - i)]
    units = np.eye(usable.size).reshape(-1, *shape)
    units = units - sum(np.multiply.outer(basis.ravel(), basis) for basis in surface)
    rest = np.array([unit - running_mean(unit, usable, 15) for unit in units])
    kept = kept_freedom(usable)
    assert kept.total == pytest.approx(np.square(rest).sum(), rel=1e-9)
    assert kept.rows == pytest.approx(np.square(rest.mean(2) * np.sqrt(19)).sum(), rel=0.1)
    assert kept.columns == pytest.approx(np.square(rest.mean(1) * np.sqrt(17)).sum(), rel=0.1)


def test_kept_share_is_that_of_a_matrix() -> None:
    usable = np.ones((17, 19), bool)
    units = np.eye(usable.size).reshape(-1, *usable.shape)
    rest = np.array([unit - running_mean(unit, usable, 15) for unit in units])
    np.testing.assert_allclose(_kept_share(usable)(slice(None)), np.square(rest).sum(axis=0), rtol=1e-9)


@pytest.mark.parametrize("times", [4.0, 10.0])
def test_edges_of_light_make_no_dead_pixels(times: float) -> None:
    rows, columns = np.indices((48, 64))
    for bright in (rows < 20, (rows < 20) | (columns > 40), (rows < 20) & (columns > 40)):
        response = responding(spread(2) * np.where(bright, times, 1.0))
        assert not response.dead.any()
        assert "times as bright in one part" in response.why_no_prnu
        assert response.prnu_estimate().value is None


def test_dead_pixels_beside_an_edge_are_found() -> None:
    response = spread(3) * np.where(np.arange(48) < 20, 4.0, 1.0)[:, None]
    dead = [(0, 0), (10, 30), (10, 31), (22, 10), (40, 63)]
    for place in dead:
        response[place] *= 0.3
    assert [tuple(place) for place in np.argwhere(responding(response).dead).tolist()] == dead


def test_colour_filters_hint_at_a_mosaic() -> None:
    filters = np.tile([[0.5, 1.0], [1.0, 0.3]], (24, 32))
    response = responding(spread(5) * filters)
    assert not response.dead.any()
    assert "mosaic =" in response.why_no_prnu
    assert response.prnu_estimate().why == response.why_no_prnu
    assert not responding(spread(5) * np.where(filters > 0.5, 1.05, 1.0)).why_no_prnu


def test_response_is_vignetting_times_prnu() -> None:
    """Light that differs by less than two leaves a PRNU, shrunk as the best linear estimate."""
    rng = np.random.default_rng(9)
    rows, columns = np.indices((160, 200))
    vignetting = 1 - 0.3 * (((columns - 99.5) / 200) ** 2 + ((rows - 79.5) / 160) ** 2)
    prnu, noise_dn2, level_dn = 0.01, 900.0, 5000.0
    true = vignetting * (1 + prnu * rng.standard_normal(vignetting.shape))
    true[20, 30] = 0.3 * vignetting[20, 30]
    signals = [
        level_dn * share * true + np.sqrt(share * vignetting * noise_dn2) * rng.standard_normal(true.shape)
        for share in (1.0, 0.5)
    ]
    usable = np.ones(true.shape, bool)
    usable[100, 100] = False
    response = measure_response(signals[0] + signals[1], SignalNoise(1.5 * noise_dn2, 0.0), usable)
    assert not response.why_no_prnu
    assert np.argwhere(response.dead).tolist() == [[20, 30]]
    assert response.spread2 == pytest.approx(prnu**2, abs=3 * response.spread2_se)
    # The scatter of the quotients of signal and vignetting is that of PRNU and noise together
    noise2 = noise_dn2 * 1.5 / (1.5 * level_dn) ** 2
    assert response.prnu_estimate().se == pytest.approx(
        (prnu**2 + noise2) * np.sqrt(2 / true.size) / (2 * prnu), rel=0.05
    )
    inner = np.s_[12:-12, 12:-12]
    regular = (usable & ~response.dead)[inner]
    np.testing.assert_allclose(response.vignetting[inner], (vignetting / vignetting.mean())[inner], rtol=0.01)
    error = (response.relative / (true / true.mean()) - 1)[inner][regular]
    assert error.std() == pytest.approx(np.sqrt(prnu**2 * noise2 / (prnu**2 + noise2)), rel=0.1)
    assert response.relative[100, 100] == response.vignetting[100, 100]
    stated = (response.relative_se / response.relative)[inner][regular]
    assert np.sqrt(np.mean((error / stated) ** 2)) == pytest.approx(1.0, abs=0.1)
