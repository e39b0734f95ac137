"""Saturated pixels do not count: which samples are unknown then, and by how much the others are too dark."""

import numpy as np

from faintfield.recon.likelihood.saturation import bias_of_selection, unknown_samples


def test_samples_of_mostly_saturated_pixels_are_unknown() -> None:
    counted = np.array([0.0, 3.0, 8.0, 0.3, 0.0], np.float32)
    whole = np.array([9.0, 9.0, 9.0, 0.3, 0.0], np.float32)
    assert unknown_samples(counted, whole).tolist() == [True, True, False, False, False]


def test_bias_is_that_of_counts_cut_off_at_saturation() -> None:
    generator = np.random.default_rng(5)
    light_e, saturation_e = 900.0, 910.0
    counts = generator.poisson(light_e, 200_000)
    kept = counts[counts < saturation_e]
    share = np.array([kept.size / counts.size], np.float32)
    bias_e = bias_of_selection(share, np.ones(1, np.float32))[0] * np.sqrt(light_e)
    assert abs((light_e - kept.mean()) - bias_e) < 0.05 * bias_e
    assert bias_of_selection(np.ones(1, np.float32), np.ones(1, np.float32))[0] == 0
