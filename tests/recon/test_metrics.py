"""The paper's numbers from eqs. (4), (6) and (7), and Monte Carlo checks of expectations."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.recon.metrics import (
    expected_snr_from_powers,
    mean_square_error,
    noise_variance_e2,
    peak_snr_db,
    photons_from_linear_snr,
    photons_from_moments,
    signal_scale_for_snr,
    snr_from_powers,
)

READ_NOISE_E = 12**0.5  # the paper's camera: n_r² = 12, η = 0.5, D = 0.2
DARK_E = 0.2 * 0.1


def test_linear_formula_gives_the_papers_photons() -> None:
    photons = photons_from_linear_snr(0.16, quantum_efficiency=0.5, read_noise_e=READ_NOISE_E)
    assert photons == pytest.approx(3.84, rel=1e-12)
    assert 0.5 * photons / READ_NOISE_E**2 == pytest.approx(0.16, rel=1e-12)


def test_moments_give_half_as_many_photons() -> None:
    photons = photons_from_moments(0.16, quantum_efficiency=0.5, read_noise_e=READ_NOISE_E)
    mean_e = 0.5 * photons
    assert mean_e**2 + mean_e == pytest.approx(0.16 * 12, rel=1e-12)
    assert photons == pytest.approx(1.9, abs=0.05)


def test_variance_adds_light_dark_and_read_noise() -> None:
    camera = {"quantum_efficiency": 0.5, "dark_current_e_per_s": 0.2, "read_noise_e": READ_NOISE_E}
    assert noise_variance_e2(38.4, 0.1, **camera) == pytest.approx(1.92 + 0.02 + 12)
    lit = noise_variance_e2(38.4, 0.1, background_photons_per_s=10.0, **camera)
    assert lit == pytest.approx(1.92 + 0.5 + 0.02 + 12)


def test_snr_of_drawn_frames_is_as_expected() -> None:
    dark_e = 1.5
    generator = np.random.default_rng(20110919)
    relative = np.linspace(0.2, 1.0, 1000)
    signal_e = signal_scale_for_snr(relative, 0.16, dark_e, READ_NOISE_E) * relative

    def frame(expected_e: NDArray[np.float64] | float) -> NDArray[np.float64]:
        read_noise_e = generator.normal(0, READ_NOISE_E, (500, 1000))
        return generator.poisson(expected_e, (500, 1000)) + read_noise_e

    # A squared normal number has √2 times its mean as standard deviation; two means of 500 000 enter a ratio near one
    deviation = 1.16 * np.sqrt(2) * np.sqrt(2 / 5e5)
    assert snr_from_powers(frame(signal_e + dark_e), frame(dark_e)) == pytest.approx(0.16, abs=4 * deviation)
    assert expected_snr_from_powers(signal_e, dark_e, READ_NOISE_E) == pytest.approx(0.16, rel=1e-12)


def test_snr_is_excess_of_power_over_noise() -> None:
    assert snr_from_powers(np.array([3.0, -3.0, 1.0]), np.array([[2.0, -1.0]])) == pytest.approx((19 / 3 - 2.5) / 2.5)
    assert snr_from_powers(np.full(9, 40000, np.uint16), np.full(4, 20000, np.uint16)) == pytest.approx(3.0)


@pytest.mark.parametrize(("relative", "snr", "read_noise_e"), [(np.zeros(3), 0.16, 1.0), (np.ones(3), 0.16, 0.0)])
def test_no_signal_or_no_noise_has_no_scale(relative: NDArray[np.float64], snr: float, read_noise_e: float) -> None:
    with pytest.raises(ValueError, match="must both be positive"):
        signal_scale_for_snr(relative, snr, 0.0, read_noise_e)


def test_mean_square_error_counts_its_region_only() -> None:
    truth, plane = np.array([[4.0, 2.0, 100.0]]), np.array([[5.0, 2.0, 0.0]])
    region = np.array([[True, True, False]])
    assert mean_square_error(plane, truth, region) == pytest.approx((0.25**2 + 0) / 2)
    assert mean_square_error(plane, truth) == pytest.approx((0.01**2 + 1) / 3)
    assert mean_square_error(3 * plane, 3 * truth, region) == pytest.approx(0.25**2 / 2)


def test_peak_snr_is_the_error_in_decibels() -> None:
    assert peak_snr_db(0.01) == pytest.approx(20.0)
    assert peak_snr_db(1.0) == 0.0
    assert peak_snr_db(0.0) == float("inf")
