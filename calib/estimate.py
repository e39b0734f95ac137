"""Measured values with their errors, the goodness of fit of a series, and figures of a stage, as records have them."""

from typing import Literal

import numpy as np
from msgspec import Struct, field

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
        Measured value; none if the frames do not determine it.
    se, ci95 : float, tuple of float, optional
        Standard error; lower and upper end of the 95 % interval.
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
    kind : {"dark", "flat"}
        Lens covered, or evenly lit.
    exposure_s : float
        Exposure time.
    level : int
        Index of the light level; 0 for darks.
    frames : int
        Number of frames.
    left_out : str, optional
        Reason why the series was left out; absent if it was used.
    noise_excess, noise_se : float, optional
        Variance over that of the model, minus 1, absent for one frame; standard error of `noise_excess` under Gaussian
        noise.
    level_residual_dn : float, optional
        Level minus that of the model; none if the light of a flat is not known.
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


class StageFigure(Struct, frozen=True):
    """A figure of the stage with its standard error, or the reason why there is none.

    Attributes
    ----------
    value, sigma : float, optional
        The figure, in the unit that its name ends with; standard error of `value`.
    why : str, optional
        Why there is no value.
    """

    value: float | None
    sigma: float | None = None
    why: str | None = None


class StageReport(Struct, frozen=True):
    """Errors of the stage that its owner may want to correct.

    Attributes
    ----------
    pitch_x_mm, pitch_y_mm, scale_x, scale_y : StageFigure
        Distance between neighbouring nodes along a row and along a column, and its ratio to the commanded one.
    squareness_rad : StageFigure
        Angle between the axes minus a right angle.
    backlash_x_mm, backlash_y_mm : StageFigure
        Distance along the axis from the position of a node approached in the positive direction to its position when
        approached in the negative direction. The stage falls short by half of it in each direction.
    tilt_rad : StageFigure
        Angle between the reference camera's axis and the normal of the grid.
    node_residual_rms_mm, residuals_mm : StageFigure, list of (float, float, float)
        Rms distance of the nodes from the regular grid that fits best, in three dimensions; residual of each node along
        the grid's x, y and normal.
    warnings : list of str
        Problems: nodes far from their places, or scale errors that are too large for a stage.
    """

    pitch_x_mm: StageFigure
    pitch_y_mm: StageFigure
    scale_x: StageFigure
    scale_y: StageFigure
    squareness_rad: StageFigure
    backlash_x_mm: StageFigure
    backlash_y_mm: StageFigure
    tilt_rad: StageFigure
    node_residual_rms_mm: StageFigure
    residuals_mm: list[tuple[float, float, float]]
    warnings: list[str] = field(name="doubts")


class Repeatability(Struct, frozen=True):
    """Repeatability of the stage, from the same nodes in several sweeps.

    Attributes
    ----------
    sd_mm : float
        Standard deviation of the stage's position at a node between sweeps, per axis; zero if the noise of the corners
        explains all differences.
    se_mm : float
        Standard error of `sd_mm`.
    """

    sd_mm: float
    se_mm: float


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
