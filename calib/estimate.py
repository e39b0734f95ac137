"""A measured value with its standard error and interval, and the goodness of fit of a series, as records have them."""

from typing import Literal

import numpy as np
from msgspec import Struct

_NO_SPREAD = "the values are not much likelier with a spread, so that none was fitted; record more darks"

# Standard errors by which a variance is negative beyond chance: once in a thousand sound measurements, or less.
_HIDDEN_SIGMA = 3.2

# Half width of a 95 % interval of a normal law, in standard deviations: `scipy.stats.norm.ppf(0.975)`.
NORMAL_QUANTILE = 1.959963984540054

# Largest exponent of an interval's end over its value; nothing beyond is of use.
_MAX_EXPONENT = 50.0


class Estimate(Struct, frozen=True, omit_defaults=True):
    """A measured value with its standard error and 95 % confidence interval, or the reason why there is none.

    Attributes
    ----------
    value : float, optional
        None if the frames do not determine it.
    se, ci95 : float, tuple of float, optional
        Standard error and interval.
    why : str, optional
        Why there is no value, and what to record to get one.
    """

    value: float | None
    se: float | None = None
    ci95: tuple[float, float] | None = None
    why: str | None = None


class SeriesGoodness(Struct, frozen=True, omit_defaults=True):
    """Goodness of fit of one series, or the reason why it was left out.

    Attributes
    ----------
    noise_excess, noise_se : float, optional
        Variance over that of the model, minus 1, with its standard error under Gaussian noise; None for one frame.
    level_residual_dn : float, optional
        Level minus that of the model; None where the light of a flat is not known.
    blocks, rows, columns, by_frame : float, optional
        Deviance of the noise over blocks of pixels, rows, columns and frames, per degree of freedom: 1 where the noise
        is Gaussian.
    """

    kind: Literal["dark", "flat"]
    exposure_s: float
    level: int
    frames: int
    left_out: str | None = None
    noise_excess: float | None = None
    noise_se: float | None = None
    level_residual_dn: float | None = None
    blocks: float | None = None
    rows: float | None = None
    columns: float | None = None
    by_frame: float | None = None


def interval(value: float, se: float, quantile: float = NORMAL_QUANTILE, *, positive: bool = False) -> Estimate:
    """Return an estimate with its interval, which is symmetric on a logarithmic scale for positive quantities."""
    if positive:
        factor = float(np.exp(min(quantile * se / value, _MAX_EXPONENT)))
        return Estimate(value, se, (value / factor, value * factor))
    return Estimate(value, se, (value - quantile * se, value + quantile * se))


def root(variance: float, se: float, scale: float = 1.0) -> Estimate:
    """Return the root of a variance, times a scale; no value if the variance is significantly negative.

    Where it is negative by chance, the interval is from 0 to the root of one standard error at least.
    """
    if not se:
        return Estimate(None, why=_NO_SPREAD)
    if variance < -_HIDDEN_SIGMA * se:
        return Estimate(
            None,
            why=f"there is less scatter than the pixels' noise alone makes, by {-variance / se:.2g} standard errors "
            f"(limit {_HIDDEN_SIGMA:g}), so that a spread would be hidden; the noise of the frames is not independent, "
            "as when pickup changes its phase from frame to frame, which means of 10 frames or more show less",
        )
    low = float(np.sqrt(max(variance - NORMAL_QUANTILE * se, 0.0))) * scale
    high = float(np.sqrt(max(variance + NORMAL_QUANTILE * se, se))) * scale
    return Estimate(float(np.sqrt(max(variance, 0.0))) * scale, (high - low) / (2 * NORMAL_QUANTILE), (low, high))
