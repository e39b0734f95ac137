"""The scatter of series about the model, by which intervals must grow, and levels that are no part of it.

Three kinds of scatter are measured from what the fit leaves, each as the variance with which the squares of the
residuals are as large as their degrees of freedom (Mandel and Paule, Analytical Chemistry 42, 1194, 1970): that of a
series' noise about the model, of the darks' levels about their straight line, and of the flats' levels about the
response. A fourth is that of the noise over blocks of pixels, which is wider than χ² where noise has long tails.
"""

from collections.abc import Iterable, Sequence
from dataclasses import astuple, replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from faintfield.calib.noise.likelihood.gaussian_fit import (
    GaussianProblem,
    NoiseFit,
    dark_variances_dn2,
    flat_variances_dn2,
    level_variances_dn2,
)
from faintfield.calib.noise.likelihood.moments import NO_EXCESS, Excess, Moments, SeriesNoise
from faintfield.calib.noise.likelihood.response import (
    Light,
    charge_dn,
    charge_slope,
    grown_variance,
    level_design,
    scatter_of_levels,
    scatter_of_line,
)
from faintfield.calib.noise.likelihood.rounding import ROUNDING_DN2
from faintfield.calib.noise.series import Series
from faintfield.calib.noise.strips import Array

# The levels of all dark series have a trend in common below this probability.
_MAX_TREND_CHANCE = 0.01

# Blocks scatter more than chance allows below this probability.
_MAX_CHANCE = 0.05

# A level is odd if chance alone makes one of all levels stand out as far with this probability, if it is off by this
# fraction, and by so many standard errors of its noise.
_MAX_ODD_CHANCE, _MIN_FRACTION, _MIN_SIGMAS = 1e-4, 0.02, 6.0

# Largest share of odd levels; with more it is not known which are odd. The others must have residuals to judge by.
_MAX_SHARE, _MIN_FREEDOM = 0.1, 4

# Rounds of fits in which the scatter is measured, and its relative change at which they end.
_MAX_ROUNDS, _SETTLED = 5, 0.02


class Known(NamedTuple):
    """Degrees of freedom of an excess variance, its share in the variance that it is part of, and the chance of it.

    The chance is the probability with which a good model leaves residuals as large.
    """

    freedom: int
    share: float
    chance: float = 1.0


def _dispersion(noise: Sequence[SeriesNoise], variances_dn2: Iterable[Array | float]) -> float:
    """Return how much wider than χ² the noise of blocks scatters, at least 1.

    What the blocks of all series have in common is a difference between pixels, not chance, and is taken out.
    """
    pairs = zip(noise, variances_dn2, strict=True)
    several = [item.scatter(item.blocks, variance) for item, variance in pairs if item.frames > 1]
    if len(several) < 2:
        return 1.0
    ratios, freedoms = zip(*several, strict=True)
    ratio, weight = np.array(ratios), np.array(freedoms) / 2
    ratio = ratio / np.average(ratio, axis=1, weights=weight[0])[:, None]
    rest = ratio - np.average(ratio, axis=0, weights=weight[:, 0])
    freedom = (ratio.shape[0] - 1) * (ratio.shape[1] - 1)
    deviance = float(np.sum(weight * rest**2))
    return deviance / freedom if stats.chi2.sf(deviance, freedom) < _MAX_CHANCE else 1.0


def flat_variances_of_nodes(fit: NoiseFit, noise: SeriesNoise) -> Array:
    """Return the noise that the model expects of pixels of a flat with the means `noise.nodes_dn`, as many."""
    return np.array(flat_variances_dn2(fit.values, np.maximum(noise.nodes_dn, fit.values["offset_dn"])))


def measure_excess(fit: NoiseFit, moments: Moments, darks: Sequence[Series]) -> tuple[Excess, dict[str, Known]]:
    """Return the scatter beyond the model, and for `variance2`, `drift_dn2` and `light2` what is known of each."""
    dark_noise = dark_variances_dn2(fit.values, moments.darks.exposure_s)
    of_darks, of_flats = moments.noise[: len(darks)], moments.noise[len(darks) :]
    excess = Excess(
        darks=_dispersion(of_darks, dark_noise),
        flats=_dispersion(of_flats, (flat_variances_of_nodes(fit, group) for group in of_flats)),
    )
    variance2, noise_known = _noise_scatter(fit, moments, excess)
    drift_dn2, drift_known = _drift(fit, moments, trend(darks))
    light = moments.light
    bends = sum(name.startswith("nonlinearity") for name in fit.values)
    light2, light_known = 0.0, Known(0, 1.0)
    if light.groups.size:
        signal = light_signal(fit, moments)
        slope = charge_slope(fit.values, signal)
        still = replace(moments, excess=replace(excess, drift_dn2=drift_dn2))
        variance = np.array(level_variances_dn2(fit.values, still), float) * slope**2
        light2, deviance = scatter_of_levels(light, signal, variance, bends)
        freedom = light.freedom - bends
        light_known = Known(freedom, _share(variance / signal**2, light2), _chance(deviance, freedom))
    excess = replace(excess, variance2=variance2, drift_dn2=drift_dn2, light2=light2)
    return excess, {"variance2": noise_known, "drift_dn2": drift_known, "light2": light_known}


def _chance(deviance: float, freedom: float) -> float:
    return float(stats.chi2.sf(deviance, freedom)) if freedom >= 1 else 1.0


def _share(chance: Array, excess: float) -> float:
    """Return the share of an excess variance in what it makes of the variances that chance has."""
    return excess / (excess + 1 / float(np.mean(1 / chance))) if excess else 1.0


def light_signal(fit: NoiseFit, moments: Moments) -> Array:
    """Return the signal of each flat series that is due to light."""
    dark = fit.values["offset_dn"] + fit.values.get("dark_signal_dn_per_s", 0.0) * moments.flats.exposure_s
    return np.asarray(moments.flats.mean_dn - dark)


def _noise_scatter(fit: NoiseFit, moments: Moments, excess: Excess) -> tuple[float, Known]:
    """Return the relative variance of the series' noise about the model, and what is known of it.

    Read noise and gain are fitted to the noise of the series alone: the scatter of the pixels' means may contradict it,
    as pickup does whose phase turns, which is no scatter between series.
    """
    values, darks, flats = fit.values, moments.darks, moments.flats
    noise = np.array([*dark_variances_dn2(values, darks.exposure_s), *flat_variances_dn2(values, flats.mean_dn)], float)
    signal = flats.mean_dn - values["offset_dn"]
    slope = np.broadcast_to(charge_slope(values, signal), signal.shape)
    dark = max(values.get("dark_signal_dn_per_s", 0.0), 0.0) * darks.exposure_s
    design = np.concatenate([
        np.stack([np.ones_like(dark), dark], axis=1),
        np.stack([1 / slope**2, charge_dn(values, signal) / slope**2], axis=1),
    ])  # fmt: skip
    series, freedom = moments.series, moments.noise_freedom
    measured = series.within_dn2 / np.maximum(series.frames - 1, 1) / moments.freedom
    wider = np.concatenate([np.full(darks.frames.size, excess.darks), np.full(flats.frames.size, excess.flats)])
    use = freedom > 0
    chance = 2 * wider[use] / freedom[use] + series.rounding2[use]
    target, columns = (measured - ROUNDING_DN2)[use] / noise[use], design[use] / noise[use][:, None]
    left = target.size - int(np.linalg.matrix_rank(columns / np.maximum(np.abs(columns).max(0), 1e-300)))
    variance2, deviance = scatter_of_line(columns, target, chance, np.ones_like(chance), left)
    return variance2, Known(left, _share(chance, variance2), _chance(deviance, left))


def trend(darks: Sequence[Series]) -> tuple[float, float]:
    """Return the square of the drift of the black level during a series, and its probability by chance.

    It is zero unless all darks drift alike. It goes on from series to series, where it may pass for dark current.
    """
    several = [dark for dark in darks if dark.frames > 1]
    if len(several) < 3:
        return 0.0, 1.0
    rises = np.array([np.polyfit(np.arange(item.frames), item.levels_dn, 1)[0] for item in several])
    error = float(rises.std(ddof=1)) / np.sqrt(rises.size)
    chance = 2 * float(stats.t.sf(abs(float(rises.mean())) / max(error, 1e-300), rises.size - 1))
    if chance > _MAX_TREND_CHANCE:
        return 0.0, chance
    return float(rises.mean() * np.mean([item.frames for item in several])) ** 2, chance


def _drift(fit: NoiseFit, moments: Moments, of_series: tuple[float, float]) -> tuple[float, Known]:
    """Return the variance of the dark levels about their straight line, and what is known of it.

    It is at least the square of the trend within the series.
    """
    trend2, trend_chance = of_series
    darks, t = moments.darks, moments.darks.exposure_s
    noise = np.array(dark_variances_dn2(fit.values, t), float) / moments.pixels
    chance = (fit.values.get("jitter_dn2", 0.0) + noise) / darks.frames
    left = t.size - min(np.unique(t).size, 2)

    def deviance(more: float) -> float:
        weight = 1 / np.sqrt(chance + more)
        design = np.stack([np.ones_like(t), t], axis=1)[:, : min(np.unique(t).size, 2)]
        line = design @ np.linalg.lstsq(design * weight[:, None], darks.mean_dn * weight)[0]
        return float(np.sum(((darks.mean_dn - line) * weight) ** 2))

    drift2 = grown_variance(deviance, left)
    if drift2 < trend2:
        return trend2, Known(0, 1.0, trend_chance)
    return drift2, Known(left, _share(chance, drift2), _chance(deviance(0.0), left))


def fit_with_excess(moments: Moments, darks: Sequence[Series], bends: int) -> tuple[NoiseFit, Moments]:
    """Fit, measure the scatter that the fit leaves, and fit again with it until it settles.

    The fit has the degrees of freedom of each kind of scatter, and the covariance without any; the moments have the
    scatter.
    """
    problem = GaussianProblem(moments, bends)
    fit, known = problem.fit(replace(NO_EXCESS, light2=_first_light2(moments, bends))), dict[str, Known]()
    for _ in range(_MAX_ROUNDS):
        excess, known = measure_excess(fit, moments, darks)
        pairs = zip(astuple(excess), astuple(moments.excess), strict=True)
        settled = all(abs(new - old) <= _SETTLED * max(new, old) for new, old in pairs)
        moments = replace(moments, excess=excess)
        if settled:
            break
        fit = problem.fit(excess, fit.values)
    sources = []
    for name, (freedom, share, _) in known.items():
        if (value := getattr(moments.excess, name)) > 0 and freedom > 0:
            grown = problem.covariance(fit.values, replace(moments.excess, **{name: 1.1 * value}))
            # Residuals tell the whole of these variances, not only the excess.
            sources.append(((grown - fit.covariance) / (0.1 * share), freedom))
    plain = problem.covariance(fit.values, NO_EXCESS)
    chances = {name: item.chance for name, item in known.items()}
    return replace(fit, sources=tuple(sources), plain_covariance=plain, chances=chances), moments


def _first_light2(moments: Moments, bends: int) -> float:
    """Return the scatter of the flats' levels beyond noise and the jitter that the darks show.

    A fit without it would take unsteady light for jitter.
    """
    darks, flats = moments.darks, moments.flats
    if not bends or not moments.light.groups.size:
        return 0.0
    freedom = float(np.maximum(darks.frames - 1, 0).sum())
    noise = flats.within_dn2 / np.maximum(flats.frames - 1, 1) / moments.freedom
    dark_noise = float(darks.within_dn2.sum()) / max(freedom * moments.freedom, 1.0)
    jitter = max(float(darks.level_scatter_dn2.sum()) / max(freedom, 1.0) - dark_noise / moments.pixels, 0.0)
    variance = (jitter + noise / moments.pixels) / flats.frames
    return scatter_of_levels(moments.light, flats.mean_dn - float(darks.mean_dn.min()), variance, bends)[0]


def without_odd(light: Light, signal_dn: Array, variance_dn2: Array, bends: int) -> Light:
    """Return the light without the levels that do not match it.

    Up to a tenth of the levels, at least one, are taken out one after the other, each time the one that stands out
    most from a fit of the others; those are odd up to the last one that stands out significantly, so that two of them
    cannot hide each other (Rosner, Technometrics 25, 165, 1983).

    Parameters
    ----------
    light, signal_dn, variance_dn2 : Light, array (series,)
        Light and mean signal of all flats, and the variance that noise alone makes of it.
    bends : int
        Number of coefficients of the response, eq. (5).
    """
    rest = even = light
    for _ in range(max(1, int(_MAX_SHARE * (light.group >= 0).sum()))):
        if rest.freedom - bends <= _MIN_FREEDOM:
            break
        index, certain = _outstanding_level(rest, signal_dn, variance_dn2, bends)
        group = rest.group.copy()
        group[index] = -1
        rest = replace(rest, group=group, odd=(*rest.odd, (index, int(light.group[index]))))
        even = rest if certain else even
    return even


def _outstanding_level(light: Light, signal_dn: Array, variance_dn2: Array, bends: int) -> tuple[int, bool]:
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
        2 * use.size * stats.t.sf(outstanding[worst], freedom) < _MAX_ODD_CHANCE
        and off_dn > _MIN_FRACTION * signal_dn[use[worst]]
        and off_dn > _MIN_SIGMAS * np.sqrt(variance_dn2[use[worst]])
    )
    return int(use[worst]), bool(certain)
