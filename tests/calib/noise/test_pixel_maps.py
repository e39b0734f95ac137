"""Read noise, gain, seams and telegraph pixels of sensors whose every pixel is known."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.noise import Conditions, NoiseCalibration, Series, calibrate, measure_series
from faintfield.calib.noise.maps.read_noise import PixelReadNoise, kept_variance, line_shifts, measure_read_noise
from faintfield.calib.noise.maps.seams import find_seams, share_of_seam

type Array = NDArray[np.float64]

SHAPE = (64, 72)


def dark_series(sigma_dn: Array, frames: int, rng: np.random.Generator, shot_dn2: float = 0.0) -> Series:
    """Return the statistics of darks with this noise of each pixel and offsets that differ by 3 DN."""
    offset = 200 + 3 * rng.standard_normal(sigma_dn.shape)
    noise = np.sqrt(sigma_dn**2 + shot_dn2)
    taken = [
        (f"{k}", np.rint(offset + noise * rng.standard_normal(sigma_dn.shape)).astype(np.uint16)) for k in range(frames)
    ]
    return measure_series(taken, Conditions("dark", 0.1))


def read_noise(sigma_dn: Array, frames: int, seed: int) -> PixelReadNoise:
    """Return the read noise that is measured of a sensor whose mean noise is known."""
    mean_dn2 = float(np.mean(sigma_dn**2))
    series = dark_series(sigma_dn, frames, np.random.default_rng(seed))
    return measure_read_noise([series], mean_dn2, [mean_dn2 + 1 / 12], np.ones(sigma_dn.shape, bool))


def test_a_spot_of_less_noise_keeps_its_own() -> None:
    """A prior with one centre draws the quiet pixels up by 9 %, and the means of rows and columns by another 5 %."""
    rows, columns = np.indices(SHAPE)
    spot = (rows - 30) ** 2 + (columns - 40) ** 2 < 20**2
    truth = np.where(spot, 4.0, 8.0)
    found = read_noise(truth, 40, 1)
    assert np.median(found.read_noise_dn[spot]) == pytest.approx(4.0, rel=0.02)
    assert np.median(found.read_noise_dn[~spot]) == pytest.approx(8.0, rel=0.02)
    assert np.mean((found.read_noise_dn / truth - 1) ** 2) < 0.2 / (2 * 39), "a fifth of the error of its own frames"


def test_log_normal_noise_has_nearly_the_error_of_the_best_estimate_and_states_it() -> None:
    """With ln σ ~ N(m, s²) and errors of ln σ of variance 1/(2ν), the posterior has variance 1/(1/s² + 2ν)."""
    rng = np.random.default_rng(2)
    truth = 5.0 * np.exp(0.08 * rng.standard_normal(SHAPE))
    found = read_noise(truth, 40, 3)
    error = found.read_noise_dn / truth - 1
    assert error.std() < 1.05 * (1 / 0.08**2 + 2 * 39) ** -0.5
    assert np.sqrt(np.mean((error * truth / found.se_dn) ** 2)) == pytest.approx(1.0, abs=0.12)


def test_columns_that_differ_are_part_of_the_population() -> None:
    rng = np.random.default_rng(4)
    truth = 6.0 * np.exp(0.15 * rng.standard_normal((1, SHAPE[1]))) * np.ones((SHAPE[0], 1))
    found = read_noise(truth, 20, 5)
    # A column of 64 pixels of 19 degrees of freedom each tells its noise to 2 %, where a pixel tells it to 16 %.
    assert np.std(found.read_noise_dn / truth) < 0.035


def test_noise_of_one_pixel_in_a_hundred_is_its_own() -> None:
    rng = np.random.default_rng(6)
    truth = np.full(SHAPE, 4.0)
    loud = rng.random(SHAPE) < 0.01
    truth[loud] = rng.uniform(16.0, 30.0, loud.sum())
    found = read_noise(truth, 40, 7)
    assert np.std((found.read_noise_dn / truth)[loud]) < 0.15
    assert np.std((found.read_noise_dn / truth)[~loud]) < 0.03


def test_pixels_that_are_alike_have_one_noise() -> None:
    found = read_noise(np.full(SHAPE, 5.0), 20, 8)
    assert not found.resolved
    np.testing.assert_allclose(found.read_noise_dn, 5.0)
    assert 0 < found.se_dn.max() < 0.05 * 5.0


def test_shot_noise_of_longer_exposures_is_no_read_noise() -> None:
    rng = np.random.default_rng(9)
    truth = 5.0 * np.exp(0.3 * rng.standard_normal(SHAPE))
    mean_dn2 = float(np.mean(truth**2))
    series = [dark_series(truth, 20, rng), dark_series(truth, 30, rng, shot_dn2=40.0)]
    found = measure_read_noise(series, mean_dn2, [mean_dn2 + 1 / 12, mean_dn2 + 40 + 1 / 12], np.ones(SHAPE, bool))
    assert found.read_noise_dn.mean() == pytest.approx(truth.mean(), rel=0.01)
    assert np.std(np.log(found.read_noise_dn / truth)) < 0.14


def test_subtracting_means_of_rows_and_columns_mixes_variances_as_matrices_do() -> None:
    rng = np.random.default_rng(10)
    variance = rng.uniform(1, 9, (5, 7))
    rows, columns = np.eye(5) - 1 / 5, np.eye(7) - 1 / 7
    whole = np.kron(rows, columns)
    expected = np.diag(whole @ np.diag(variance.ravel()) @ whole.T).reshape(5, 7)
    np.testing.assert_allclose(kept_variance(variance, np.ones((5, 7), bool)), expected, rtol=1e-12)


def test_rows_that_do_not_differ_are_not_shifted() -> None:
    rng = np.random.default_rng(11)
    values = rng.standard_normal(SHAPE)
    assert not any(shifts.any() for shifts in line_shifts(values, np.ones(SHAPE, bool)))
    own = 0.5 * rng.standard_normal((SHAPE[0], 1))
    of_rows, of_columns = line_shifts(values + own, np.ones(SHAPE, bool))
    shifts = np.add.outer(of_rows, of_columns)
    assert np.std(shifts - own) < 1.3 * (1 / 0.5**2 + SHAPE[1]) ** -0.5, "the error of the posterior mean"


@pytest.mark.parametrize(("lines", "regions"), [("columns", "halves"), ("columns", "alternate"), ("rows", "quarters")])
def test_a_seam_is_found_beside_a_gradient(lines: str, regions: str) -> None:
    rng = np.random.default_rng(12)
    rows, columns = np.indices(SHAPE)
    at, size = (rows, SHAPE[0]) if lines == "rows" else (columns, SHAPE[1])
    region = {"halves": 2 * at // size, "quarters": 4 * at // size % 2, "alternate": at % 2}[regions]
    smooth = 0.5 * columns / SHAPE[1] + 0.3 * (rows / SHAPE[0]) ** 2
    noise = rng.standard_normal(SHAPE)
    (found,) = find_seams(smooth + noise + 0.5 * region, np.ones(SHAPE))
    assert (found.lines, found.regions) == (lines, regions)
    assert found.difference == pytest.approx(0.5, abs=4 * found.se)
    assert not find_seams(smooth + noise, np.ones(SHAPE)), "a gradient is no seam"
    share, se = share_of_seam(found, 0.7 * found.of(slice(None)) + noise, np.ones(SHAPE))
    assert share == pytest.approx(0.7, abs=4 * se)


def calibrated(
    seed: int, *, gain: Array | float = 2.0, response: Array | float = 1.0, jump_e: Array | float = 0.0
) -> NoiseCalibration:
    """Calibrate a sensor from 40 darks and 40 flats each of three levels; pixels that jump are up half of the time."""
    rng = np.random.default_rng(seed)
    read_e = 1.5 * np.exp(0.15 * rng.standard_normal(SHAPE))

    def frame(light_e: float) -> NDArray[np.uint16]:
        electrons = rng.poisson(light_e * response * np.ones(SHAPE)) + read_e * rng.standard_normal(SHAPE)
        electrons = electrons + jump_e * (rng.random(SHAPE) < 0.5)
        return np.rint(100 + gain * electrons).astype(np.uint16)

    series = []
    for level, light_e in enumerate((0.0, 1000.0, 4000.0, 12000.0)):
        conditions = Conditions("flat", 0.1, level, light_e) if light_e else Conditions("dark", 0.1)
        series.append(measure_series([(f"{level} {k}", frame(light_e)) for k in range(40)], conditions))
    return calibrate(series, 65535)


def test_gains_of_pixels_and_of_two_taps_are_found_and_not_taken_for_response() -> None:
    rng = np.random.default_rng(13)
    taps = np.where(np.arange(SHAPE[1]) < SHAPE[1] // 2, 0.98, 1.02)
    gain = 2.0 * taps * (1 + 0.03 * rng.standard_normal(SHAPE))
    found = calibrated(14, gain=gain)
    maps = found.maps
    assert maps.gain_dn_per_e is not None
    assert maps.gain_se_dn_per_e is not None
    assert maps.relative_response is not None
    assert np.std(maps.gain_dn_per_e / gain) < 0.007, "one number is off by 3.6 %"
    assert maps.gain_se_dn_per_e.mean() / 2 < 0.015
    assert np.std(maps.relative_response) < 0.007, "divided by its gain each pixel has the same light"
    assert any("halves of the columns" in warning for warning in found.warnings)
    model = found.noise_model()
    np.testing.assert_array_equal(model.gain_dn_per_e, maps.gain_dn_per_e)
    assert np.ptp(model.read_variance_e2()) > 1.0


def test_a_step_of_gain_is_none_of_the_response_and_dark_noise_is_that_of_each_half() -> None:
    """Pairs of frames, and dim flats, of which a half of the variance is dark noise that the gain scales, too."""
    rng, shape, light_e = np.random.default_rng(23), (128, 160), 300.0
    gain = np.where(np.arange(shape[1]) < shape[1] // 2, 0.5, 0.55)
    response = 1 + 0.01 * rng.standard_normal(shape)
    series = []
    for level, light in enumerate((0.0, 0.3 * light_e, 0.6 * light_e, light_e)):
        conditions = Conditions("flat", 0.1, level, light) if light else Conditions("dark", 0.1)
        frames = [
            np.rint(100 + gain * (rng.poisson(light * response) + 15.0 * rng.standard_normal(shape))) for _ in range(4)
        ]
        series.append(
            measure_series([(f"{level} {k}", it.astype(np.uint16)) for k, it in enumerate(frames)], conditions)
        )
    found = calibrate(series, 65535)
    assert found.maps.gain_dn_per_e is not None
    assert found.maps.read_noise_e is not None
    halves = [found.maps.gain_dn_per_e[:, half].mean() for half in (slice(0, 70), slice(90, 160))]
    assert halves[1] / halves[0] == pytest.approx(1.1, abs=0.003)
    assert found.maps.read_noise_e[:, :70].mean() == pytest.approx(found.maps.read_noise_e[:, 90:].mean(), rel=0.03)
    prnu = found.estimates["prnu"]
    assert prnu.value == pytest.approx(0.01, abs=4 * (prnu.se or 0.0))


def test_pixels_that_see_less_light_have_no_gain_of_their_own() -> None:
    rng = np.random.default_rng(15)
    halves = np.where(np.arange(SHAPE[1]) < SHAPE[1] // 2, 0.98, 1.02)
    found = calibrated(16, response=halves * (1 + 0.03 * rng.standard_normal(SHAPE)))
    assert found.maps.gain_dn_per_e is None
    assert "nothing shows that gains differ" in found.maps.absent["gain_dn_per_e"]
    assert not any("halves" in warning for warning in found.warnings)


def test_telegraph_pixels_are_told_from_pixels_that_are_noisy() -> None:
    rng = np.random.default_rng(17)
    jump_e = np.where(rng.random(SHAPE) < 0.02, rng.uniform(8.0, 12.0, SHAPE), 0.0)
    found = calibrated(18, jump_e=jump_e)
    assert (found.telegraph & (jump_e > 0)).sum() > 0.9 * (jump_e > 0).sum()
    assert (found.telegraph & (jump_e == 0)).sum() <= 2
    assert any("jump between two levels" in warning for warning in found.warnings)


def test_normal_noise_that_is_strong_is_no_telegraph_noise_but_the_pixels_own() -> None:
    rng = np.random.default_rng(19)
    sigma_dn = np.where(rng.random(SHAPE) < 0.03, 12.0, 3.0)
    found = calibrate([dark_series(sigma_dn, 40, rng)])
    assert found.telegraph.sum() <= 2
    assert found.noisy.sum() <= 2
    assert not found.maps.unusable[sigma_dn > 3].all()


def test_third_and_fourth_powers_are_those_of_the_deviations() -> None:
    rng = np.random.default_rng(20)
    frames = rng.integers(400, 700, (6, 9, 10))
    found = measure_series([(f"{k}", frame.astype(np.uint16)) for k, frame in enumerate(frames)], Conditions("dark", 1))
    rest = frames - frames.mean((1, 2), keepdims=True)
    rest = rest - rest.mean(2, keepdims=True)
    rest = rest - rest.mean(1, keepdims=True)
    rest = rest - rest.mean(0)
    np.testing.assert_allclose(found.cubes_dn3, np.sum(rest**3, axis=0), rtol=1e-4, atol=10)
    np.testing.assert_allclose(found.fourths_dn4, np.sum(rest**4, axis=0), rtol=1e-4)
