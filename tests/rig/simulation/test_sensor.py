"""The simulated sensor's moments by Monte Carlo, its rounding and its range."""

import numpy as np
import pytest

from faintfield.rig.simulation.sensor import SimulatedSensor

PIXELS = (400, 400)


@pytest.mark.parametrize("photons", [0.0, 3.84, 5000.0])
@pytest.mark.parametrize("exposure_s", [0.1, 100.0])
def test_a_frame_has_the_mean_and_the_variance_of_eq_6(photons: float, exposure_s: float) -> None:
    sensor = SimulatedSensor()
    frame_dn = sensor.expose(np.full(PIXELS, photons), exposure_s, np.random.default_rng(20110919))
    electrons = (frame_dn.astype(float) - 100.0) / 2.0
    mean_e = 0.5 * photons + 0.2 * exposure_s
    variance_e2 = mean_e + 12.0 + 1 / (12 * 2.0**2)  # the last: rounding to whole DN
    assert electrons.mean() == pytest.approx(mean_e, abs=4 * np.sqrt(variance_e2 / electrons.size))
    assert electrons.var() == pytest.approx(variance_e2, rel=4 * np.sqrt(2.2 / electrons.size))


def test_without_read_noise_frames_are_poisson_counts() -> None:
    sensor = SimulatedSensor(read_noise_e=0.0, dark_current_e_per_s=0.0, gain_dn_per_e=3.0, offset_dn=7.0)
    frame_dn = sensor.expose(np.full(PIXELS, 4.0), 1.0, np.random.default_rng(20110919))
    counts, remainder = np.divmod(frame_dn.astype(int) - 7, 3)
    assert not remainder.any()
    assert np.mean(counts == 0) == pytest.approx(np.exp(-2.0), abs=4 * np.sqrt(0.135 * 0.865 / counts.size))


def test_frames_of_one_seed_are_one_frame_and_of_another_another() -> None:
    photons = np.full((5, 7), 10.0)
    frames = [SimulatedSensor().expose(photons, 0.1, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(frames[0], frames[1])
    assert (frames[0] != frames[2]).any()


def test_electrons_are_rounded_to_the_nearest_dn_and_kept_within_the_converters_range() -> None:
    sensor = SimulatedSensor(offset_dn=10.0, gain_dn_per_e=2.0, saturation_dn=4095)
    frame_dn = sensor.digitise(np.array([[0.0, 0.2, 0.3, -0.3, -5.2, -80.0, 2042.4, 2042.6, 1e9]]))
    assert frame_dn.dtype == np.uint16
    np.testing.assert_array_equal(frame_dn, [[10, 10, 11, 9, 0, 0, 4095, 4095, 4095]])
