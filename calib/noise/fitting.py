"""Fit the series of a sensor: choose pixels and likelihood, then find the parameters."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise.exact import fit_exact
from faintfield.calib.noise.gaussian import NoiseFit, dark_variances_dn2, fit_gaussian, flat_variances_dn2
from faintfield.calib.noise.moments import Moments, gather_moments
from faintfield.calib.noise.selection import (
    NoiseLikelihood,
    censored_start,
    choose_likelihood,
    collect_counts,
    gaussian_start,
    shared_noise_dn2,
)
from faintfield.calib.noise.statistics import Series


@dataclass(frozen=True)
class SeriesFit:
    """A fit and the series behind it.

    Attributes
    ----------
    darks, flats : sequence of Series
        Statistics of the frames.
    moments : Moments
        Sums of the statistics over the pixels in use.
    likelihood : NoiseLikelihood
        Likelihood that was maximized.
    fit : NoiseFit
        Its maximum.
    bend : NoiseFit, optional
        Fit with a nonlinear response; None unless there are flats of three levels.
    """

    darks: Sequence[Series]
    flats: Sequence[Series]
    moments: Moments
    likelihood: NoiseLikelihood
    fit: NoiseFit
    bend: NoiseFit | None

    @property
    def dark_noise_dn2(self) -> list[float]:
        """Pixel noise v_j of the dark series."""
        return dark_variances_dn2(self.fit.values, self.moments.darks.exposure_s)

    @property
    def flat_noise_dn2(self) -> list[float]:
        """Pixel noise of the flat series."""
        return flat_variances_dn2(self.fit.values, self.moments.flats.mean_dn)

    @property
    def profiles_dn2(self) -> float:
        """Variance that the fixed patterns of rows and columns add to the offsets of the pixels."""
        return float(self.darks[0].row_dn.var() + self.darks[0].column_dn.var())


def fit_series(darks: Sequence[Series], flats: Sequence[Series], usable: NDArray[np.bool_]) -> SeriesFit:
    """Fit with the simplest likelihood that the frames allow.

    Parameters
    ----------
    darks, flats : sequence of Series
        At least one dark series.
    usable : array (row, column), bool
        Pixels in use.

    Raises
    ------
    PoorFit, NotIdentifiable
        The likelihood has no maximum, or too many values are cut off at the black level to start.
    """
    suspect = np.any([one.suspect for one in darks], axis=0)
    moments = gather_moments(darks, flats, usable & ~suspect)
    fit, bend = _fit_gaussian(moments)
    # Among values cut off at the floor the highest look suspect; leaving them out would bias the fit.
    counts = collect_counts(darks, usable)
    likelihood = choose_likelihood(counts, fit, shared_noise_dn2(darks, fit))
    if likelihood is not NoiseLikelihood.GAUSSIAN:
        exact = likelihood is NoiseLikelihood.EXACT
        if exact:
            counts = collect_counts(darks, usable & ~suspect)
        start = gaussian_start(fit) if exact else censored_start(counts)
        # The Gaussian fit tells whether pixels differ in dark current, unless values are cut off.
        spread = not exact or fit.values.get("dcnu_dn2_per_s2", 0.0) > 3 * fit.standard_error("dcnu_dn2_per_s2")
        fit = fit_exact(counts, start, moments.flats, moments.freedom, exact=exact, try_spread=spread)
        bend = None
    return SeriesFit(darks, flats, moments, likelihood, fit, bend)


def _fit_gaussian(moments: Moments) -> tuple[NoiseFit, NoiseFit | None]:
    """Return the fit, and the fit with a nonlinear response if flats have three levels.

    The first is the second if the nonlinearity is significant.
    """
    straight = fit_gaussian(moments)
    if np.unique(np.round(moments.flats.mean_dn, -1)).size < 3:
        return straight, None
    bent = fit_gaussian(moments, nonlinear=True)
    significant = abs(bent.values["nonlinearity_per_dn"]) > 3 * bent.standard_error("nonlinearity_per_dn")
    return (bent if significant else straight), bent
