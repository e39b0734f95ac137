"""Measure offset and dark signal of every pixel.

Offset and dark signal are posterior means. The mean of ten frames of a pixel is off by 1.1 e⁻ rms at 12 e⁻² of read
noise: as much as the signal to be reconstructed. So offset and dark signal of pixel i get the priors N(μ, s²) and
N(d, q²), whose spreads the fit has measured; the means m_ij of the series measure `o_i + d_i t_j` with variance
v_ij/n_j, v_ij the noise of the pixel itself. Since both are Gaussian, the posterior mean is linear in the means, with a
2 × 2 matrix (Gelman et al., Bayesian Data Analysis, 3rd ed., §5.4). What rows and columns share is part of μ.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from faintfield.calib.noise.series.statistics import Series
from faintfield.calib.noise.strips import Array, Map, Mask, maps_of, mean_over


@dataclass(frozen=True)
class PixelLevels:
    """Offset and dark signal of every pixel, arrays (row, column), with the variances of their errors."""

    offset_dn: Map
    dark_signal_dn_per_s: Map
    offset_variance_dn2: Map
    dark_signal_variance_dn2_per_s2: Map


@dataclass(frozen=True)
class LinePattern:
    """Pattern of rows (row,) and of columns (column,) in the offsets, and the variance of the error of their sum."""

    row_dn: Array
    column_dn: Array
    variance_dn2: float


def line_pattern(darks: Sequence[Series], dsnu_dn2: float) -> LinePattern:
    """Return what rows and columns share in the offsets, by the dark series of most frames, shrunk by chance.

    Parameters
    ----------
    darks : sequence of Series
        Dark series, at least one.
    dsnu_dn2 : float
        Variance of the offsets of the pixels, which scatters the means of rows and columns, too.
    """
    most = max(darks, key=lambda dark: dark.frames)
    rows, columns = most.pattern_dn.shape
    patterns, error = [], 0.0
    lines = (most.row_dn, most.row_noise_dn2, columns), (most.column_dn, most.column_noise_dn2, rows)
    for profile_dn, noise_dn2, averaged in lines:
        # A lone frame does not tell the noise of its lines
        chance = max(dsnu_dn2, 0.0) / averaged + noise_dn2 / most.frames
        total = float(profile_dn.var())
        kept = max(1 - chance / total, 0.0) if total > 0 and most.frames > 1 else 0.0
        patterns.append(kept * profile_dn)
        error += kept * chance if most.frames > 1 else total
    return LinePattern(patterns[0], patterns[1], error)


def pixel_levels(
    darks: Sequence[Series],
    values: Mapping[str, float],
    noise_dn2: Sequence[Callable[[slice], Array | float]],
    pattern: LinePattern,
    hot: Mask,
) -> PixelLevels:
    """Return the posterior means of every pixel's offset and dark signal.

    Parameters
    ----------
    darks : sequence of Series
        Dark series, at least one.
    values : mapping
        `offset_dn`, `dark_signal_dn_per_s`, `dsnu_dn2`, `dcnu_dn2_per_s2` of the fit.
    noise_dn2 : sequence of callables
        Return the noise of some rows of pixels (row, column) in each series, or one number for all.
    pattern : LinePattern
        Pattern of rows and columns in the offsets.
    hot : array (row, column), bool
        Pixels whose dark signal the prior does not describe; only their own values determine it.
    """
    exposures = [series.conditions.dark_time_s for series in darks]
    # The floors stand for spreads that are zero or were not fitted.
    offset_prior = 1 / max(values["dsnu_dn2"] + pattern.variance_dn2, 1e-6)
    signal_priors = 1e-12 if np.ptp(exposures) else 1e12, 1 / max(values.get("dcnu_dn2_per_s2", 0.0), 1e-12)
    # Jitter moves the mean of a whole series off the straight line; that is no pixel's offset.
    levels = [mean_over(series.mean_of, ~hot) for series in darks]

    def work(rows: slice) -> tuple[Array, ...]:
        of_lines = np.add.outer(pattern.row_dn[rows], pattern.column_dn)
        # Precision of offset, of both, and of dark signal; and the deviations that they weigh
        offset, signal = np.full(of_lines.shape, offset_prior), np.where(hot[rows], *signal_priors)
        both, of_offset, of_signal = np.zeros((3, *of_lines.shape))
        for series, variance, level in zip(darks, noise_dn2, levels, strict=True):
            t, weight = series.conditions.dark_time_s, series.frames / np.asarray(variance(rows))
            deviation = series.mean_of(rows)
            deviation -= level
            deviation -= of_lines
            deviation *= weight
            offset += weight
            of_offset += deviation
            if t:
                both += weight * t
                signal += weight * t**2
                deviation *= t
                of_signal += deviation
        determinant = offset * signal - both**2
        offset_dn = (signal * of_offset - both * of_signal) / determinant + values["offset_dn"] + of_lines
        signal_dn = (offset * of_signal - both * of_offset) / determinant + values.get("dark_signal_dn_per_s", 0.0)
        return offset_dn, signal_dn, signal / determinant, offset / determinant

    return PixelLevels(*maps_of(work, hot.shape, (np.float32,) * 4))
