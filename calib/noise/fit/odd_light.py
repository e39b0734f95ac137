"""Flats whose level does not match the light that is stated: found among the others, and named."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.noise.likelihood.response import Light, level_design, scatter_of_levels

type Array = NDArray[np.float64]

# A level is odd if chance alone makes one of all levels stand out as far with this probability, if it is off by this
# fraction, and by so many standard errors of its noise.
_MAX_CHANCE, _MIN_FRACTION, _MIN_SIGMAS = 1e-4, 0.02, 6.0

# Largest share of odd levels; with more it is not known which are odd. The others must have residuals to judge by.
_MAX_SHARE, _MIN_FREEDOM = 0.1, 4


def without_odd(light: Light, signal_dn: Array, variance_dn2: Array, bends: int) -> Light:
    """Return the light without the levels that do not match it.

    Up to a tenth of the levels, at least one, are taken out one after the other, each time the one that stands out
    most from a fit of the others; those are odd up to the last one that stands out significantly, so that two of them
    cannot hide each other (Rosner, Technometrics 25, 165, 1983).

    Parameters
    ----------
    light : Light
        Of all flat series.
    signal_dn, variance_dn2 : array (series,)
        Mean signal, and the variance that noise alone makes of it.
    bends : int
        Number of coefficients of the response, eq. (5).
    """
    left, odd, taken = light, 0, list[tuple[int, int]]()
    for _ in range(max(1, int(_MAX_SHARE * (light.group >= 0).sum()))):
        if left.freedom - bends <= _MIN_FREEDOM:
            break
        index, certain = _most_outstanding(left, signal_dn, variance_dn2, bends)
        taken.append((index, int(light.group[index])))
        odd = len(taken) if certain else odd
        left = _without(light, taken)
    return _without(light, taken[:odd])


def _without(light: Light, odd: list[tuple[int, int]]) -> Light:
    """Return the light without some series."""
    group = light.group.copy()
    group[[index for index, _ in odd]] = -1
    return replace(light, group=group, odd=tuple(odd))


def _most_outstanding(light: Light, signal_dn: Array, variance_dn2: Array, bends: int) -> tuple[int, bool]:
    """Return the series whose level stands out most from a fit of the others, and whether it does so certainly."""
    use = np.flatnonzero(light.group >= 0)
    excess, _ = scatter_of_levels(light, signal_dn, variance_dn2, bends)
    root = np.sqrt(variance_dn2 + excess * signal_dn**2)[use]
    design, target = level_design(light, signal_dn, bends) / root[:, None], signal_dn[use] / root
    basis = np.linalg.svd(design, full_matrices=False)[0]
    residual = target - basis @ (basis.T @ target)
    kept = np.maximum(1 - np.sum(basis**2, axis=1), 1e-9)
    freedom = use.size - design.shape[1] - 1
    rest = np.maximum(float(residual @ residual) - residual**2 / kept, 1e-300)
    outstanding = np.abs(residual) / np.sqrt(rest / freedom * kept)
    worst = int(outstanding.argmax())
    off_dn = abs(residual[worst]) / kept[worst] * root[worst]
    certain = (
        2 * use.size * stats.t.sf(outstanding[worst], freedom) < _MAX_CHANCE
        and off_dn > _MIN_FRACTION * signal_dn[use[worst]]
        and off_dn > _MIN_SIGMAS * np.sqrt(variance_dn2[use[worst]])
    )
    return int(use[worst]), bool(certain)
