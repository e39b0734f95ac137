"""Results of a calibration, and quantities that it declines to state."""

from dataclasses import replace

import numpy as np
import pytest

from faintfield.calib.errors import CalibrationError, CopiedFrame, NotIdentifiable, TooFewFrames
from faintfield.calib.noise import Conditions, NoiseCalibration, calibrate, measure_series
from faintfield.calib.noise.sensor_fit import NoiseLikelihood
from tests.calib.noise.darkroom import EXPOSURES_S, dark_series, darks, expose, flat_series, specimen, with_flats

IN_ELECTRONS = ("gain_dn_per_e", "read_noise_e", "dark_current_e_per_s", "dsnu_e", "dcnu_e_per_s")


def value(result: NoiseCalibration, name: str) -> float:
    estimate = result.estimates[name]
    assert estimate.value is not None, estimate.why
    return estimate.value


def test_short_darks_give_no_gain(capfd: pytest.CaptureFixture[str]) -> None:
    chip, rng = specimen(0, shape=(128, 128))
    result = calibrate(dark_series(chip, (0.1, 0.3, 1.0), 10, rng))
    for name in IN_ELECTRONS:
        estimate = result.estimates[name]
        assert (estimate.value, estimate.se, estimate.ci95) == (None, None, None)
        assert estimate.why
    assert "record" in str(result.estimates["gain_dn_per_e"].why)
    assert result.maps.read_noise_e is result.maps.dark_current_e_per_s is None
    assert value(result, "read_noise_dn") == pytest.approx(2 * 12**0.5, rel=0.01)
    with pytest.raises(NotIdentifiable, match="gain_dn_per_e: no value"):
        result.noise_model()
    assert capfd.readouterr() == ("", ""), "the solver prints nothing"


def test_one_exposure_with_flats_gives_the_gain() -> None:
    series = with_flats(*specimen(1), exposures_s=(0.1,))
    assert calibrate(series[:1]).estimates["gain_dn_per_e"].value is None
    result = calibrate(series)
    assert value(result, "gain_dn_per_e") == pytest.approx(2, rel=0.02)
    assert "one exposure" in str(result.estimates["dark_current_e_per_s"].why)


def test_absent_dark_current_has_an_interval_around_zero() -> None:
    series = with_flats(*specimen(2, dark_current_e_per_s=0.0))
    interval = calibrate(series).estimates["dark_current_e_per_s"].ci95
    assert interval is not None
    assert interval[0] <= 0 <= interval[1] < 0.01
    assert calibrate(series[:-1]).estimates["gain_dn_per_e"].value is None


def test_falling_dark_level_is_no_dark_current() -> None:
    chip, rng = specimen(18, dark_current_e_per_s=0.0)
    series = [
        measure_series([(name, frame - np.uint16(0.5 * t)) for name, frame in frames], Conditions("dark", t))
        for t, frames in darks(chip, (1.0, 10.0, 20.0), 6, rng).items()
    ]
    result = calibrate([*series, flat_series(chip, 8000.0, 10, rng)])
    assert "the dark level falls with exposure time" in str(result.estimates["dark_current_e_per_s"].why)
    longest = result.histograms[-1]
    assert longest.exposure_s == 20
    mean, fitted = (np.average(longest.value_dn, weights=w) for w in (longest.count, longest.expected))
    assert fitted == pytest.approx(mean, abs=0.3)
    assert fitted == pytest.approx(result.points[2].model_mean_dn, abs=0.3)


@pytest.mark.parametrize(
    ("read_noise_e", "dsnu_e", "invisible"),
    [
        (0.3, 1.5, {"dsnu_row_dn", "dsnu_column_dn"}),
        (12**0.5, 0.0, {"dsnu_e", "dcnu_e_per_s", "frame_jitter_dn", "row_noise_dn", "column_noise_dn"}),
    ],
)
def test_invisible_spread_is_not_certainly_zero(read_noise_e: float, dsnu_e: float, invisible: set[str]) -> None:
    chip, rng = specimen(1, dsnu_e=dsnu_e, dark_current_e_per_s=0.5, read_noise_e=read_noise_e, shape=(32, 32))
    estimates = calibrate(dark_series(chip, EXPOSURES_S, 10, rng)).estimates
    assert invisible <= {name for name, estimate in estimates.items() if estimate.ci95 and estimate.ci95[0] == 0}
    for name, estimate in estimates.items():
        assert estimate.se is None or estimate.se > 0, name
        assert estimate.ci95 is None or estimate.ci95[0] < estimate.ci95[1], name
        assert (estimate.value is None) == (estimate.why is not None), name


def test_hot_pixels_are_kept_out() -> None:
    chip, rng = specimen(3, shape=(256, 256), hot_fraction=0.005, dcnu=0.1)
    result = calibrate(dark_series(chip, EXPOSURES_S, 10, rng))
    right = (result.pixels.hot & chip.hot).sum()
    assert right / chip.hot.sum() >= 0.99
    assert right / result.pixels.hot.sum() >= 0.95
    assert value(result, "dark_current_e_per_s") == pytest.approx(0.2, rel=0.02)
    np.testing.assert_array_equal(result.maps.unusable, result.pixels.hot | result.pixels.noisy | result.pixels.dead)


def test_flats_give_response_and_efficiency() -> None:
    chip, rng = specimen(5, shape=(96, 96), prnu=0.02)
    chip.response[40, 50] = 0.1
    result = calibrate(with_flats(chip, rng, (500.0, 5000.0, 20000.0), frames=8))
    assert np.argwhere(result.pixels.dead).tolist() == [[40, 50]]
    assert value(result, "prnu") == pytest.approx(0.02, rel=0.05)
    efficiency, bend = result.estimates["quantum_efficiency"], result.estimates["nonlinearity_per_dn"]
    assert efficiency.ci95 is not None
    assert efficiency.ci95[0] < 0.5 < efficiency.ci95[1]
    assert bend.se is not None
    assert abs(value(result, "nonlinearity_per_dn")) < 3 * bend.se < 1e-6
    response = result.maps.relative_response
    assert response is not None
    assert np.std((response - chip.response)[~result.maps.unusable]) < 0.004


def test_bent_response_is_measured_beside_the_gain() -> None:
    bend_per_dn = 2e-6
    chip, rng = specimen(6, shape=(128, 128), bend_per_dn=bend_per_dn)
    result = calibrate(with_flats(chip, rng, (500.0, 4000.0, 10000.0, 20000.0, 28000.0)))
    assert value(result, "nonlinearity_per_dn") == pytest.approx(bend_per_dn, rel=0.15)
    assert value(result, "gain_dn_per_e") == pytest.approx(2, rel=0.01)


def test_maps_beat_raw_means_and_state_their_error() -> None:
    chip, rng = specimen(7, shape=(128, 128), dcnu=0.2)
    series = dark_series(chip, EXPOSURES_S, 10, rng)
    maps = calibrate(series).maps
    error = maps.offset_dn - chip.offset_dn
    assert np.sqrt(np.mean(error**2)) < 0.75 * np.sqrt(np.mean((series[0].mean_dn - chip.offset_dn) ** 2))
    assert np.mean(error**2 / maps.offset_variance_dn2) == pytest.approx(1, abs=0.1)
    assert maps.dark_current_e_per_s is not None
    assert maps.dark_current_variance_e2_per_s2 is not None
    error = maps.dark_current_e_per_s - chip.dark_current_e_per_s
    assert np.mean(error**2 / maps.dark_current_variance_e2_per_s2) == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize(
    ("problem", "error", "words"),
    [
        ("single darks", TooFewFrames, r"dark_0.1s_0: the only one of the darks of 0.1 s"),
        ("copied dark", CopiedFrame, "copy and dark_1s_0: the same frame"),
        ("single flat", TooFewFrames, "flat_0_0: the only one"),
        ("no darks", NotIdentifiable, "no dark frames"),
        ("few pixels", TooFewFrames, "64 pixels"),
    ],
)
def test_unusable_frames_are_named(problem: str, error: type[CalibrationError], words: str) -> None:
    chip, rng = specimen(8, shape=(8, 8) if problem == "few pixels" else (64, 64))
    series = dark_series(chip, EXPOSURES_S, 1 if problem == "single darks" else 2, rng)
    if problem == "copied dark":
        frame = expose(chip, 1.0, rng)
        series[1] = measure_series([("dark_1s_0", frame), ("copy", frame.copy())], Conditions("dark", 1.0))
    if problem in ("single flat", "no darks"):
        flats = [flat_series(chip, 1000.0, 1 if problem == "single flat" else 4, rng)]
        series = flats if problem == "no darks" else [*series, *flats]
    with pytest.raises(error, match=words):
        calibrate(series)


def test_drifting_black_level_hides_the_dark_current() -> None:
    chip, rng = specimen(10, jitter_dn=0.05)
    series = dark_series(chip, EXPOSURES_S, 10, rng)
    series[1] = replace(series[1], levels_dn=series[1].levels_dn + 6.0)
    result = calibrate(series)
    assert result.estimates["dark_current_e_per_s"].value is None
    assert result.estimates["gain_dn_per_e"].value is None
    assert any("no straight line" in warning for warning in result.warnings)


def test_plain_sensor_raises_no_warnings() -> None:
    chip, rng = specimen(12, shape=(128, 128), jitter_dn=0.5, banding_dn=1.0, dcnu=0.1)
    result = calibrate(dark_series(chip, EXPOSURES_S, 10, rng), saturation_dn=4095.0)
    assert result.warnings == ()
    assert result.likelihood is NoiseLikelihood.GAUSSIAN
    for name, truth in [("frame_jitter_dn", 0.5), ("row_noise_dn", 1.0), ("dsnu_dn", 3.0), ("dcnu_e_per_s", 0.02)]:
        assert value(result, name) == pytest.approx(truth, rel=0.3), name
    # The variance of R rows in n frames has 2/(R (n − 1)) of relative variance; four series add their freedom
    variance_dn2 = 1.0 + (48 + 0.8 * np.mean(EXPOSURES_S)) / 128
    assert result.estimates["row_noise_dn"].se == pytest.approx(variance_dn2 * np.sqrt(2 / (128 * 9 * 4)) / 2, rel=0.1)
    model = result.noise_model()
    assert model.electrons(expose(chip, 0.1, rng, photons=8.0)).mean() == pytest.approx(4.02, abs=0.5)
    assert model.saturation_dn == 4095
    assert np.mean(model.read_variance_e2()) == pytest.approx(12, rel=0.1)


@pytest.mark.parametrize("changes", [{}, {"read_noise_e": 0.3}, {"offset_dn": 2.0}], ids=str)
def test_histograms_follow_the_mass_function(changes: dict[str, float]) -> None:
    chip, rng = specimen(15, **changes)
    for histogram in calibrate(dark_series(chip, EXPOSURES_S, 10, rng)).histograms:
        common = histogram.expected > 200
        assert np.abs(histogram.count[common] / histogram.expected[common] - 1).max() < 0.25
        assert histogram.count.sum() == pytest.approx(histogram.expected.sum(), rel=0.01)


def test_moving_black_level_is_no_offset_of_pixels() -> None:
    """The same frames with levels off the straight line: the map must keep the pixels' differences from its mean."""
    chip, rng = specimen(20, dsnu_e=0.5)
    series = dark_series(chip, EXPOSURES_S, 10, rng)
    moved = [replace(s, levels_dn=s.levels_dn + by_dn) for s, by_dn in zip(series, (12, 0, 14, 4), strict=True)]
    still, jittery = (
        result.maps.offset_dn - value(result, "offset_dn") for result in (calibrate(series), calibrate(moved))
    )
    np.testing.assert_allclose(jittery, still, atol=0.05)
    assert abs((jittery - (chip.offset_dn - chip.sensor.offset_dn)).mean()) < 0.1


def test_rounding_is_part_of_the_noise_of_flats() -> None:
    """At a tenth of a DN per electron rounding is a fifth of a dim flat's variance, and none of the gain."""
    chip, rng = specimen(21, shape=(128, 128), gain_dn_per_e=0.1, read_noise_e=5.0, dark_current_e_per_s=0.02)
    result = calibrate(with_flats(chip, rng, (20.0, 30.0, 40.0), (0.1, 1.0), 8))
    assert value(result, "gain_dn_per_e") == pytest.approx(0.1, rel=0.05)
    for point in result.points[2:]:
        assert point.variance_dn2 == pytest.approx(0.25 + 1 / 12 + 0.1 * (point.mean_dn - 100.0), rel=0.02)
        assert point.model_variance_dn2 == pytest.approx(point.variance_dn2, rel=0.02)


def test_absent_dark_current_has_an_exact_error() -> None:
    chip, rng = specimen(22, gain_dn_per_e=0.1, read_noise_e=4.5, dark_current_e_per_s=0.0)
    result = calibrate(with_flats(chip, rng, (20.0, 40.0), (0.1, 1.0), 8))
    assert result.likelihood is NoiseLikelihood.EXACT
    # The level of ten frames of 4096 pixels, of read noise and rounding, at two exposures 0.9 s apart
    expected_se = np.sqrt(2 * (4.5**2 + 100 / 12) / (10 * 64 * 64)) / 0.9
    assert result.estimates["dark_current_e_per_s"].se == pytest.approx(expected_se, rel=0.2)
    assert abs(value(result, "dark_current_e_per_s")) < 3 * expected_se


def test_dark_electrons_of_long_flats_are_no_light() -> None:
    """A third of the charge of 10 s is dark current, which differs by a fifth between pixels; all respond alike."""
    chip, rng = specimen(26, dark_current_e_per_s=100.0, dcnu=0.2)
    series = dark_series(chip, (0.1, 10.0), 10, rng)
    for level, photons in enumerate((4000.0, 8000.0)):
        series.append(flat_series(chip, photons, 8, rng, level=level, exposure_s=10.0))
    result = calibrate(series)
    assert value(result, "quantum_efficiency") == pytest.approx(0.5, rel=0.05)
    response = result.maps.relative_response
    assert response is not None
    assert response[~result.maps.unusable].std() < 0.02
