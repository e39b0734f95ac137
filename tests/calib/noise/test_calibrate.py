"""What a calibration says, and what it declines to say."""

from dataclasses import replace

import numpy as np
import pytest

from faintfield.calib.errors import CopiedFrame, NotIdentifiable, TooFewFrames
from faintfield.calib.noise import Conditions, NoiseCalibration, Series, calibrate, measure_series
from faintfield.calib.noise.fitting import NoiseLikelihood
from tests.calib.noise.darkroom import Chip, Frames, darks, expose, specimen

EXPOSURES_S = (0.1, 1.0, 10.0, 60.0)
IN_ELECTRONS = ("gain_dn_per_e", "read_noise_e", "dark_current_e_per_s", "dsnu_e", "dcnu_e_per_s")


def take(
    chip: Chip, rng: np.random.Generator, exposures_s: tuple[float, ...] = EXPOSURES_S, frames: int = 10
) -> list[Series]:
    taken = darks(chip, exposures_s, frames, rng)
    return [measure_series(series, Conditions("dark", t)) for t, series in taken.items()]


def light(chip: Chip, rng: np.random.Generator, photons: float, frames: int = 4, level: int = 0) -> Series:
    flats: Frames = [(f"flat_{level}_{k}", expose(chip, 0.1, rng, photons)) for k in range(frames)]
    return measure_series(flats, Conditions("flat", 0.1, level, photons))


def value(result: NoiseCalibration, name: str) -> float:
    found = result.estimates[name].value
    assert found is not None, result.estimates[name].why
    return found


def test_short_darks_alone_give_no_gain_in_electrons() -> None:
    chip, rng = specimen(0, shape=(128, 128))
    result = calibrate(take(chip, rng, (0.1, 0.3, 1.0)))
    for name in IN_ELECTRONS:
        estimate = result.estimates[name]
        assert (estimate.value, estimate.se, estimate.ci95) == (None, None, None)
        assert estimate.why
    assert "record" in str(result.estimates["gain_dn_per_e"].why)
    assert result.maps.read_noise_e is result.maps.dark_current_e_per_s is None
    assert value(result, "read_noise_dn") == pytest.approx(2 * 12**0.5, rel=0.01)
    with pytest.raises(NotIdentifiable, match="gain_dn_per_e: no value"):
        result.noise_model()


def test_one_exposure_tells_neither_gain_nor_dark_current_but_with_flats_the_gain() -> None:
    chip, rng = specimen(1)
    series = take(chip, rng, (0.1,))
    assert calibrate(series).estimates["gain_dn_per_e"].value is None
    result = calibrate([*series, light(chip, rng, 8000.0, 10)])
    assert value(result, "gain_dn_per_e") == pytest.approx(2, rel=0.02)
    assert "one exposure" in str(result.estimates["dark_current_e_per_s"].why)


def test_a_camera_without_dark_current_gets_an_interval_around_zero() -> None:
    chip, rng = specimen(2, dark_current_e_per_s=0.0)
    result = calibrate([*take(chip, rng), light(chip, rng, 8000.0, 10)])
    interval = result.estimates["dark_current_e_per_s"].ci95
    assert interval is not None
    assert interval[0] <= 0 <= interval[1] < 0.01
    assert calibrate(take(chip, rng)).estimates["gain_dn_per_e"].value is None


def test_a_falling_dark_level_is_no_dark_current_and_the_mass_function_falls_with_it() -> None:
    chip, rng = specimen(18, dark_current_e_per_s=0.0)
    taken = darks(chip, (1.0, 10.0, 20.0), 6, rng)
    series = [
        measure_series([(name, frame - np.uint16(0.5 * t)) for name, frame in frames], Conditions("dark", t))
        for t, frames in taken.items()
    ]
    result = calibrate([*series, light(chip, rng, 8000.0, 10)])
    assert "the dark level falls with exposure time" in str(result.estimates["dark_current_e_per_s"].why)
    longest = result.histograms[-1]
    assert longest.exposure_s == 20
    seen, fitted = (np.average(longest.value_dn, weights=w) for w in (longest.count, longest.expected))
    assert fitted == pytest.approx(seen, abs=0.3)
    assert fitted == pytest.approx(result.points[2].model_mean_dn, abs=0.3)


@pytest.mark.parametrize(("read_noise_e", "dsnu_e"), [(0.3, 1.5), (12**0.5, 0.0)])
def test_an_unseen_spread_is_not_certainly_zero(read_noise_e: float, dsnu_e: float) -> None:
    chip, rng = specimen(1, dsnu_e=dsnu_e, dark_current_e_per_s=0.5, read_noise_e=read_noise_e, shape=(32, 32))
    for name, estimate in calibrate(take(chip, rng)).estimates.items():
        assert estimate.se is None or estimate.se > 0, name
        assert estimate.ci95 is None or estimate.ci95[0] < estimate.ci95[1], name
        assert (estimate.value is None) == (estimate.why is not None), name


def test_pickup_that_hides_the_spread_leaves_it_unknown() -> None:
    chip, rng = specimen(19, dsnu_e=0.0)
    pickup = rng.integers(-5, 6, chip.sensor.shape)
    series = []
    for t, frames in darks(chip, EXPOSURES_S, 2, rng).items():
        turned = [(name, (frame + pickup * (-1) ** k).astype(np.uint16)) for k, (name, frame) in enumerate(frames)]
        series.append(measure_series(turned, Conditions("dark", t)))
    result = calibrate([*series, light(chip, rng, 8000.0, 10)])
    for name in ("dsnu_dn", "dsnu_e"):
        estimate = result.estimates[name]
        assert (estimate.value, estimate.se, estimate.ci95) == (None, None, None)
        assert "less scatter than the pixels' noise" in str(estimate.why)


def test_hot_pixels_are_found_and_kept_out() -> None:
    chip, rng = specimen(3, shape=(256, 256), hot_fraction=0.005, dcnu=0.1)
    result = calibrate(take(chip, rng))
    found = result.hot
    assert (found & chip.hot).sum() / chip.hot.sum() >= 0.99
    assert (found & chip.hot).sum() / found.sum() >= 0.95
    assert value(result, "dark_current_e_per_s") == pytest.approx(0.2, rel=0.02)
    np.testing.assert_array_equal(result.maps.unusable, result.hot | result.noisy | result.dead)


def test_a_pixel_that_flips_between_two_levels_is_noisy() -> None:
    chip, rng = specimen(4)
    taken = darks(chip, EXPOSURES_S, 10, rng)
    series = []
    for t, frames in taken.items():
        for k, (_, frame) in enumerate(frames):
            frame[20, 30] += 40 * (k % 2)
        series.append(measure_series(frames, Conditions("dark", t)))
    result = calibrate(series)
    assert result.noisy[20, 30]
    assert result.noisy.sum() <= 2


def test_quantities_from_flats() -> None:
    chip, rng = specimen(5, shape=(96, 96), prnu=0.02)
    chip.response[40, 50] = 0.1
    result = calibrate(
        [*take(chip, rng), *(light(chip, rng, p, 8, level) for level, p in enumerate((500.0, 5000.0, 20000.0)))]
    )
    assert result.dead[40, 50]
    assert result.dead.sum() == 1
    prnu, efficiency = result.estimates["prnu"], result.estimates["quantum_efficiency"]
    assert prnu.value == pytest.approx(0.02, rel=0.05)
    assert efficiency.ci95 is not None
    assert efficiency.ci95[0] < 0.5 < efficiency.ci95[1]
    bend = result.estimates["nonlinearity_per_dn"]
    assert bend.value is not None
    assert bend.se is not None
    assert abs(bend.value) < 3 * bend.se < 1e-6
    usable = ~result.maps.unusable
    response = result.maps.relative_response
    assert response is not None
    assert np.std((response - chip.response)[usable]) < 0.004


def test_a_bent_response_is_measured_and_spares_the_gain() -> None:
    bend_per_dn = 2e-6
    chip, rng = specimen(6, shape=(128, 128), bend_per_dn=bend_per_dn)
    flats = [light(chip, rng, p, 10, level) for level, p in enumerate((500.0, 4000.0, 10000.0, 20000.0, 28000.0))]
    result = calibrate([*take(chip, rng), *flats])
    assert value(result, "nonlinearity_per_dn") == pytest.approx(bend_per_dn, rel=0.15)
    assert value(result, "gain_dn_per_e") == pytest.approx(2, rel=0.01)


def test_maps_beat_raw_means_and_know_how_good_they_are() -> None:
    chip, rng = specimen(7, shape=(128, 128), dcnu=0.2)
    series = take(chip, rng)
    result = calibrate(series)
    raw_rms = np.sqrt(np.mean((series[0].mean_dn - chip.offset_dn) ** 2))
    error = result.maps.offset_dn - chip.offset_dn
    assert np.sqrt(np.mean(error**2)) < 0.75 * raw_rms
    assert np.mean(error**2 / result.maps.offset_variance_dn2) == pytest.approx(1, abs=0.1)
    dark, variance = result.maps.dark_current_e_per_s, result.maps.dark_current_variance_e2_per_s2
    assert dark is not None
    assert variance is not None
    assert np.mean((dark - chip.dark_current_e_per_s) ** 2 / variance) == pytest.approx(1, abs=0.15)


def test_frames_that_cannot_be_used_are_named() -> None:
    chip, rng = specimen(8)
    taken = darks(chip, EXPOSURES_S, 2, rng)
    singles = [measure_series(frames[:1], Conditions("dark", t)) for t, frames in taken.items()]
    with pytest.raises(TooFewFrames, match=r"dark_0.1s_0: the only one of the darks of 0.1 s"):
        calibrate(singles)
    twice = [("first", taken[1.0][0][1]), ("copy", taken[1.0][0][1].copy())]
    with pytest.raises(CopiedFrame, match="copy and first: the same frame"):
        calibrate([measure_series(twice, Conditions("dark", 1.0))])
    with pytest.raises(TooFewFrames, match="flat_0_0: the only one"):
        calibrate([*take(chip, rng), light(chip, rng, 1000.0, 1)])
    with pytest.raises(NotIdentifiable, match="no dark frames"):
        calibrate([light(chip, rng, 1000.0)])
    with pytest.raises(TooFewFrames, match="64 pixels"):
        calibrate(take(*specimen(8, shape=(8, 8))))


def test_a_drifting_black_level_takes_the_dark_current_away() -> None:
    chip, rng = specimen(10, jitter_dn=0.05)
    series = take(chip, rng)
    drifted = [replace(s, levels_dn=s.levels_dn + d) for s, d in zip(series, (0, 6.0, 0, 0), strict=True)]
    result = calibrate(drifted)
    assert result.estimates["dark_current_e_per_s"].value is None
    assert result.estimates["gain_dn_per_e"].value is None
    assert any("no straight line" in warning for warning in result.warnings)


def test_noise_that_changed_between_series_is_noticed() -> None:
    quiet, rng = specimen(11, shape=(128, 128))
    noisy = replace(quiet, sensor=replace(quiet.sensor, read_noise_e=4.2))
    series = [*take(quiet, rng, (0.1, 1.0, 60.0)), *take(noisy, rng, (10.0,))]
    result = calibrate(series)
    assert any("off the model's in variance" in warning for warning in result.warnings)
    assert result.estimates["gain_dn_per_e"].value is None


def test_a_plain_sensor_raises_no_warnings() -> None:
    result = calibrate(take(*specimen(12, shape=(128, 128), jitter_dn=0.5, banding_dn=1.0, dcnu=0.1)))
    assert result.warnings == ()
    assert result.likelihood is NoiseLikelihood.GAUSSIAN
    for name, truth in [("frame_jitter_dn", 0.5), ("row_noise_dn", 1.0), ("dsnu_dn", 3.0), ("dcnu_e_per_s", 0.02)]:
        assert value(result, name) == pytest.approx(truth, rel=0.3), name


def test_the_model_for_reconstruction_is_in_electrons() -> None:
    chip, rng = specimen(13)
    model = calibrate(take(chip, rng), saturation_dn=4095.0).noise_model()
    electrons = model.electrons(expose(chip, 0.1, rng, photons=8.0))
    assert electrons.mean() == pytest.approx(4.02, abs=0.5)
    assert model.saturation_dn == 4095
    assert np.shape(model.offset_dn) == chip.sensor.shape
    assert np.mean(model.read_variance_e2()) == pytest.approx(12, rel=0.1)


def test_the_solver_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    chip, rng = specimen(14)
    calibrate(take(chip, rng))
    calibrate(take(*specimen(14, read_noise_e=0.3, shape=(32, 32))))
    assert capfd.readouterr() == ("", "")


def test_histograms_follow_the_fitted_mass_function() -> None:
    for changes in ({}, {"read_noise_e": 0.3}, {"offset_dn": 2.0}):
        result = calibrate(take(*specimen(15, **changes)))
        for histogram in result.histograms:
            common = histogram.expected > 200
            share = histogram.count[common] / histogram.expected[common]
            assert np.abs(share - 1).max() < 0.25
            assert histogram.count.sum() == pytest.approx(histogram.expected.sum(), rel=0.01)


def test_a_black_level_that_moves_from_series_to_series_is_no_pixels_offset() -> None:
    """The same frames with levels off the straight line: the map must keep the pixels' differences from its mean."""
    chip, rng = specimen(20, dsnu_e=0.5)
    moved_dn = {0.1: 12, 1.0: 0, 10.0: 14, 60.0: 4}
    series = take(chip, rng)
    moved = [replace(s, levels_dn=s.levels_dn + moved_dn[s.conditions.exposure_s]) for s in series]
    still, jittery = calibrate(series), calibrate(moved)
    here, there = (one.maps.offset_dn - value(one, "offset_dn") for one in (jittery, still))
    np.testing.assert_allclose(here, there, atol=0.05)
    error_dn = jittery.maps.offset_dn - value(jittery, "offset_dn") - (chip.offset_dn - chip.sensor.offset_dn)
    assert abs(error_dn.mean()) < 0.1


def test_rounding_to_whole_numbers_is_part_of_the_noise_of_flats() -> None:
    """At a tenth of a DN per electron rounding is a fifth of a dim flat's variance, and none of the gain."""
    chip, rng = specimen(21, shape=(128, 128), gain_dn_per_e=0.1, read_noise_e=5.0, dark_current_e_per_s=0.02)
    flats = [light(chip, rng, photons, 8, level) for level, photons in enumerate((20.0, 30.0, 40.0))]
    result = calibrate([*take(chip, rng, (0.1, 1.0)), *flats])
    assert value(result, "gain_dn_per_e") == pytest.approx(0.1, rel=0.05)
    for point in result.points[2:]:
        assert point.variance_dn2 == pytest.approx(0.25 + 1 / 12 + 0.1 * (point.mean_dn - 100.0), rel=0.02)
        assert point.model_variance_dn2 == pytest.approx(point.variance_dn2, rel=0.02)


def test_a_dark_current_of_zero_has_an_error_also_where_single_values_are_fitted() -> None:
    chip, rng = specimen(22, gain_dn_per_e=0.1, read_noise_e=4.5, dark_current_e_per_s=0.0)
    flats = [light(chip, rng, photons, 8, level) for level, photons in enumerate((20.0, 40.0))]
    result = calibrate([*take(chip, rng, (0.1, 1.0)), *flats])
    assert result.likelihood is NoiseLikelihood.EXACT
    # The level of ten frames of 4096 pixels, of read noise and rounding, at two exposures 0.9 s apart
    expected_se = np.sqrt(2 * (4.5**2 + 100 / 12) / (10 * 64 * 64)) / 0.9
    current = result.estimates["dark_current_e_per_s"]
    assert current.se == pytest.approx(expected_se, rel=0.2)
    assert current.value is not None
    assert abs(current.value) < 3 * expected_se


def test_electrons_of_the_dark_are_no_electrons_of_the_light() -> None:
    """Flats of 10 s, in which a third of the charge is dark current, give the quantum efficiency of the sensor."""
    chip, rng = specimen(26, dark_current_e_per_s=100.0)
    series = take(chip, rng, (0.1, 10.0))
    for level, photons in enumerate((4000.0, 8000.0)):
        frames: Frames = [(f"flat_{level}_{k}", expose(chip, 10.0, rng, photons)) for k in range(8)]
        series.append(measure_series(frames, Conditions("flat", 10.0, level, photons)))
    assert value(calibrate(series), "quantum_efficiency") == pytest.approx(0.5, rel=0.05)


def test_the_error_of_row_noise_is_that_of_as_many_rows_as_there_are() -> None:
    """The variance of R rows in n frames has 2/(R (n − 1)) of relative variance, four series add their freedom."""
    banding_dn, rows, frames, exposures = 2.0, 64, 10, len(EXPOSURES_S)
    result = calibrate(take(*specimen(27, banding_dn=banding_dn), frames=frames))
    row_noise = result.estimates["row_noise_dn"]
    assert row_noise.value == pytest.approx(banding_dn, rel=0.15)
    expected_se = banding_dn * np.sqrt(2 / (rows * (frames - 1) * exposures)) / 2
    assert row_noise.se == pytest.approx(expected_se, rel=0.25)


def test_uneven_dark_current_in_long_flats_is_no_response_to_light() -> None:
    """A third of the charge is dark current, which differs by a fifth between pixels; all respond alike."""
    chip, rng = specimen(29, dark_current_e_per_s=100.0, dcnu=0.2)
    series = take(chip, rng, (0.1, 10.0))
    frames: Frames = [(f"flat_{k}", expose(chip, 10.0, rng, 4000.0)) for k in range(8)]
    result = calibrate([*series, measure_series(frames, Conditions("flat", 10.0))])
    response = result.maps.relative_response
    assert response is not None
    assert response[~result.maps.unusable].std() < 0.02
