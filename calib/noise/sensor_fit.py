"""Fit the series of a sensor with the simplest likelihood that the frames allow.

It is Gaussian unless that fails: with values cut off at the black level it is biased (gain nearly doubled, read noise
a third), and with read noise below an electron it ignores the information in single electrons.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from faintfield.calib.noise.likelihood.exact import censored_start, fit_exact, gaussian_start
from faintfield.calib.noise.likelihood.gaussian_fit import NoiseFit, dark_variances_dn2, flat_variances_dn2
from faintfield.calib.noise.likelihood.marginal import Counts
from faintfield.calib.noise.likelihood.moments import Moments, gather_moments
from faintfield.calib.noise.likelihood.response import (
    MEASURED_BEND_SE,
    SECOND_BEND_SE,
    UNKNOWN_BEND_SE,
    choose_bends,
)
from faintfield.calib.noise.scatter import fit_with_excess, without_odd
from faintfield.calib.noise.series import Series, any_suspect, sample_index
from faintfield.calib.noise.strips import Mask

# Read noise, in electrons and in DN, below which single electrons or the rounding shape the distribution of values.
_MIN_GAUSSIAN_READ_E, _MIN_GAUSSIAN_READ_DN = 1.0, 0.5

# Largest noise that pixels share, as a fraction of the read noise variance, for the exact likelihood; more blurs single
# electrons.
_MAX_SHARED_FRACTION = 0.03

# Largest fraction of values on the lowest one, unless more are on the next; beyond, values are cut off there.
_MAX_FRACTION_AT_FLOOR = 2e-3

# Largest range of the values of a series, in DN; for wider tables of masses the Gaussian is good enough.
MAX_TABLE_WIDTH_DN = 2000

# Largest range that counts, over the brightest flat, since 16 bits may hold 12; no converter has fewer than 8.
_RANGE_OVER_BRIGHTEST, _MIN_RANGE_DN = 2.0, 255.0

# Largest scatter of the levels of flats about the response, as a fraction; a worse light tells nothing about it.
MAX_LIGHT_ERROR = 0.05


class NoiseLikelihood(StrEnum):
    """Names of the likelihoods in results."""

    GAUSSIAN = "marginal Gaussian"
    CENSORED = "censored Gaussian (Tobit), marginal over offsets"
    EXACT = "rounded Poisson-Gauss, marginal over offsets"


@dataclass(frozen=True)
class SeriesFit:
    """The maximum of a likelihood, with the series, the pixels in use (row, column) and their sums behind it.

    `bend` is the fit that tells the bend of the response; None unless there are flats of three levels.
    """

    darks: Sequence[Series]
    flats: Sequence[Series]
    moments: Moments
    likelihood: NoiseLikelihood
    fit: NoiseFit
    bend: NoiseFit | None
    used: Mask

    @property
    def dark_noise_dn2(self) -> list[float]:
        """Pixel noise v_j of the dark series."""
        return dark_variances_dn2(self.fit.values, self.moments.darks.exposure_s)

    @property
    def flat_noise_dn2(self) -> list[float]:
        """Pixel noise of the flat series."""
        return flat_variances_dn2(self.fit.values, self.moments.flats.mean_dn)


def fit_series(
    darks: Sequence[Series], flats: Sequence[Series], usable: Mask, saturation_dn: float = np.inf
) -> SeriesFit:
    """Fit with the simplest likelihood that the frames allow.

    Parameters
    ----------
    darks, flats : sequence of Series
        At least one dark series.
    usable : array (row, column), bool
        Pixels in use.
    saturation_dn : float
        End of the range, to which the size of a bend refers.

    Raises
    ------
    PoorFit, NotIdentifiable
        The likelihood has no maximum, or too many values are cut off at the black level to start.
    """
    used = usable & ~any_suspect(darks)
    fit, bend, moments = _fit_gaussian(gather_moments(darks, flats, used), darks, flats, saturation_dn)
    # Among values cut off at the floor the highest look suspect; leaving them out would bias the fit.
    counts = collect_counts(darks, usable)
    # The likelihood of single values has no part for what pixels share, be it of a frame or of a series.
    likelihood = choose_likelihood(counts, fit, _shared_noise_dn2(darks, fit) + moments.excess.drift_dn2)
    gaussian = fit
    if likelihood is not NoiseLikelihood.GAUSSIAN:
        exact = likelihood is NoiseLikelihood.EXACT
        if exact:
            counts = collect_counts(darks, used)
        start = gaussian_start(fit) if exact else censored_start(counts)
        # The Gaussian fit tells whether pixels differ in dark current, unless values are cut off.
        spread = not exact or fit.values.get("dcnu_dn2_per_s2", 0.0) > 3 * fit.standard_error("dcnu_dn2_per_s2")
        fit = fit_exact(counts, start, moments, gaussian.bend, exact=exact, try_spread=spread)
        fit = replace(fit, chances=gaussian.chances)
        if exact:
            # The scatter between series grows these errors by the same factors.
            pairs = zip(gaussian.values, np.diag(gaussian.plain_covariance), np.diag(gaussian.covariance), strict=True)
            factor = {name: max(after / before, 1.0) if before > 0 else 1.0 for name, before, after in pairs}
            grow = np.sqrt([factor.get(name, 1.0) for name in fit.values])
            fit = replace(fit, covariance=fit.covariance * np.outer(grow, grow))
    if flats or likelihood is NoiseLikelihood.GAUSSIAN:
        # What rounding may make of the noise of all darks, it makes of the gain, too.
        at = list(fit.values).index("log_read_dn2")
        concerns = np.array([name in ("log_read_dn2", "log_gain") for name in fit.values])
        follows = np.where(concerns, fit.covariance[at] / fit.covariance[at, at], 0.0)
        error = float(np.sqrt(moments.darks.rounding2.max()))
        fit = replace(fit, covariance=fit.covariance + error**2 * np.outer(follows, follows))
    return SeriesFit(darks, flats, moments, likelihood, fit, bend, used)


def _fit_gaussian(
    moments: Moments, darks: Sequence[Series], flats: Sequence[Series], saturation_dn: float
) -> tuple[NoiseFit, NoiseFit | None, Moments]:
    """Return the fit, a fit that tells the bend of the response if there is one, and the scatter beyond both.

    With known light both are the same. Otherwise three levels tell a bend by their noise alone; it is taken if it is
    significant. If not, a bend of the usual size may be there and widens the interval of the gain.
    """
    if not flats:
        fit, moments = fit_with_excess(moments, darks, 0)
        return fit, None, moments
    offset_dn = float(moments.darks.mean_dn.min())
    signal = moments.flats.mean_dn - offset_dn
    # The end of the range, near the brightest flat at most.
    range_dn = min(saturation_dn - offset_dn, max(_RANGE_OVER_BRIGHTEST * float(signal.max()), _MIN_RANGE_DN))
    light = moments.light
    chance = moments.flats.within_dn2 / np.maximum(moments.flats.frames - 1, 1) / moments.freedom
    level_dn2 = (chance / moments.pixels + moments.darks.level_scatter_dn2.mean()) / moments.flats.frames
    light = without_odd(light, signal, level_dn2, choose_bends(light, signal, level_dn2))
    moments = replace(moments, light=light)
    bends = choose_bends(light, signal, level_dn2)
    measured = replace(moments, range_dn=range_dn, bend_se=(MEASURED_BEND_SE,))
    if bends:
        fit, grown = fit_with_excess(measured, darks, bends)
        if grown.excess.light2 < MAX_LIGHT_ERROR**2:
            return fit, fit, grown
    unknown = replace(
        measured,
        light=replace(light, group=np.full(light.group.shape, -1), odd=()),
        bend_se=(MEASURED_BEND_SE, SECOND_BEND_SE),
    )
    free = None
    if np.unique(np.round(moments.flats.mean_dn, -1)).size >= 3:
        free, grown = fit_with_excess(unknown, darks, 2)
        if abs(free.values["nonlinearity_per_dn"]) > 3 * free.standard_error("nonlinearity_per_dn"):
            return free, free, grown
    fit, grown = fit_with_excess(replace(unknown, bend_se=(UNKNOWN_BEND_SE, SECOND_BEND_SE)), darks, 2)
    return fit, free, grown


def collect_counts(darks: Sequence[Series], used: Mask) -> Counts:
    """Return the sampled values of the pixels in use, with their floor if they are cut off."""
    keep = used.ravel()[sample_index(used.shape)]
    values = tuple(series.sample_dn[:, keep] for series in darks)
    floor = min(series.floor_dn for series in darks)
    pooled = np.concatenate([v.ravel() for v in values])
    at_floor, above = (pooled == floor).mean(), (pooled == floor + 1).mean()
    cut_off = at_floor > max(_MAX_FRACTION_AT_FLOOR, above)
    return Counts(tuple(s.conditions.dark_time_s for s in darks), values, floor if cut_off else None)


def _shared_noise_dn2(darks: Sequence[Series], gaussian: NoiseFit) -> float:
    """Return the variance of the noise that pixels of a frame, row or column share, in the quietest series."""
    noise = dark_variances_dn2(gaussian.values, np.array([dark.conditions.dark_time_s for dark in darks]))
    variance, quietest = min(
        (float(v), j) for j, (v, dark) in enumerate(zip(noise, darks, strict=True)) if dark.frames > 1
    )
    dark = darks[quietest]
    rows, columns = dark.pattern_dn.shape
    banding = dark.row_noise_dn2 + dark.column_noise_dn2 - variance * (1 / columns + 1 / rows)
    return gaussian.values["jitter_dn2"] + max(float(banding), 0.0)


def choose_likelihood(counts: Counts, gaussian: NoiseFit, shared_dn2: float) -> NoiseLikelihood:
    """Return the simplest likelihood that the frames allow.

    `shared_dn2` is the variance of the noise that pixels share. It blurs single electrons, which the exact likelihood
    does not model: with more than a little of it the Gaussian is better.
    """
    widest = max(int(np.ptp(values)) for values in counts.values_dn)
    if widest > MAX_TABLE_WIDTH_DN or not {"log_gain", "dark_signal_dn_per_s"} <= gaussian.values.keys():
        return NoiseLikelihood.GAUSSIAN
    read_dn = np.exp(0.5 * gaussian.values["log_read_dn2"])
    read_e = read_dn / np.exp(gaussian.values["log_gain"])
    telling = gaussian.standard_error("log_gain") < 0.5 and gaussian.values["dark_signal_dn_per_s"] > 0
    if counts.floor_dn is not None:
        return NoiseLikelihood.CENSORED
    if shared_dn2 > _MAX_SHARED_FRACTION * read_dn**2:
        return NoiseLikelihood.GAUSSIAN
    if read_dn < _MIN_GAUSSIAN_READ_DN or (telling and read_e < _MIN_GAUSSIAN_READ_E):
        return NoiseLikelihood.EXACT
    return NoiseLikelihood.GAUSSIAN
