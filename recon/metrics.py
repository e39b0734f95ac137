"""The paper's SNR formulas, and the errors of a reconstruction."""

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image


def snr_from_powers(object_e: NDArray[np.floating], reference_e: NDArray[np.floating]) -> float:
    """Return eq. (4), `( <g_o²> − <n²> ) / <n²>`, a ratio of powers.

    The pixels are those of a dark view in the object region, and of the noise-reference image, offset removed.
    """
    noise_power = np.mean(np.square(reference_e, dtype=np.float64))
    return float((np.mean(np.square(object_e, dtype=np.float64)) - noise_power) / noise_power)


def expected_snr_from_powers(signal_e: NDArray[np.floating], dark_e: float, read_noise_e: float) -> float:
    """Return the expectation of eq. (4) for expected signal electrons `signal_e` in the object region.

    A Poisson count of mean μ has the power μ² + μ, so `<g_o²> = <(μ+d)² + (μ+d)> + σ²` and `<n²> = d² + d + σ²`, with
    d the dark electrons and σ the read noise.
    """
    total_e = np.asarray(signal_e, np.float64) + dark_e
    noise_power = dark_e**2 + dark_e + read_noise_e**2
    return float((np.mean(total_e**2 + total_e) + read_noise_e**2 - noise_power) / noise_power)


def signal_scale_for_snr(
    relative_signal: NDArray[np.floating], snr: float, dark_e: float, read_noise_e: float
) -> float:
    """Return the factor from a relative signal to electrons for which eq. (4) gives `snr`.

    With μ = a m, `expected_snr_from_powers` is quadratic in a: `a² <m²> + a <m> (1 + 2 d) = SNR (d² + d + σ²)`.

    Raises
    ------
    ValueError
        The mean signal is not positive, or there is no noise.
    """
    m = np.asarray(relative_signal, np.float64)
    square, linear = np.mean(m**2), np.mean(m) * (1 + 2 * dark_e)
    power = snr * (dark_e**2 + dark_e + read_noise_e**2)
    if not (linear > 0 and power > 0):
        raise ValueError(f"mean signal {np.mean(m)} and noise power times SNR {power} must both be positive")
    return float(2 * power / (linear + np.sqrt(linear**2 + 4 * square * power)))


def noise_variance_e2(
    photons_per_s: float,
    exposure_s: float,
    *,
    quantum_efficiency: float,
    dark_current_e_per_s: float,
    read_noise_e: float,
    background_photons_per_s: float = 0.0,
) -> float:
    """Return eq. (6), `η (Φ_o + Φ_b) t + D t + σ²`, the variance of a pixel in (e⁻)²."""
    light_e = quantum_efficiency * (photons_per_s + background_photons_per_s) * exposure_s
    return light_e + dark_current_e_per_s * exposure_s + read_noise_e**2


def photons_from_linear_snr(snr: float, *, quantum_efficiency: float, read_noise_e: float) -> float:
    """Return the photons per pixel and exposure, Φ_o t, by eq. (7), `SNR = η Φ_o t / σ²`: 3.84 at SNR 0.16."""
    return snr * read_noise_e**2 / quantum_efficiency


def photons_from_moments(snr: float, *, quantum_efficiency: float, read_noise_e: float, dark_e: float = 0.0) -> float:
    """Return the photons per pixel of a uniform object for which eq. (4) gives `snr` (1.9 at SNR 0.16).

    Eq. (4) is a ratio of powers while eq. (7) is linear in the signal; only this function returns the true number.
    """
    return signal_scale_for_snr(np.ones(1), snr, dark_e, read_noise_e) / quantum_efficiency


def mean_square_error(plane: Image, truth: Image, region: NDArray[np.bool_] | None = None) -> float:
    """Return the mean square difference of two planes over a region, both divided by the truth's maximum there.

    Samples of the plane that are NaN, as they are not known, do not count.
    """
    where = np.ones(truth.shape, bool) if region is None else region
    peak = float(np.max(truth[where]))
    where = where & ~(np.isnan(plane) if plane.ndim == where.ndim else np.isnan(plane).any(axis=2))
    return float(np.mean(np.square((plane[where] - truth[where]) / peak, dtype=np.float64)))


def peak_snr_db(error: float) -> float:
    """Return `-10 log10(MSE)`, the peak signal-to-noise ratio of an error on a 0…1 scale, in dB."""
    return float(-10 * np.log10(error)) if error > 0 else float("inf")
