"""Goodness of fit of each series."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from faintfield.calib.noise.fit.scatter import flat_variances_of_nodes, light_signal, noise_freedom
from faintfield.calib.noise.fit.series_fit import SeriesFit
from faintfield.calib.noise.likelihood.gaussian import dark_variances_dn2, flat_variances_dn2, level_variances_dn2
from faintfield.calib.noise.likelihood.maximum import NoiseFit
from faintfield.calib.noise.likelihood.moments import Moments
from faintfield.calib.noise.likelihood.response import charge_dn, charge_slope
from faintfield.calib.noise.series.statistics import Series
from faintfield.calib.noise.strips import Array


@dataclass(frozen=True)
class Scatter:
    """Deviance of one grouping of a series' noise, and its degrees of freedom."""

    deviance: float
    freedom: int


@dataclass(frozen=True)
class SeriesGoodness:
    """Goodness of fit of one series.

    Attributes
    ----------
    series : Series
        The series.
    noise_excess, noise_se : float, optional
        Variance over that of the model, minus 1, with its standard error under Gaussian noise; None for one frame.
    level_residual_dn : float, optional
        Level minus that of the model; None where the light of a flat is not known.
    blocks, rows, columns, frames : Scatter, optional
        Scatter of the noise over blocks of pixels, rows, columns and frames.
    """

    series: Series
    noise_excess: float | None
    noise_se: float | None
    level_residual_dn: float | None
    blocks: Scatter | None = None
    rows: Scatter | None = None
    columns: Scatter | None = None
    frames: Scatter | None = None


@dataclass(frozen=True)
class TransferPoint:
    """One series as EMVA 1288 plots it: measured and modelled mean and variance, in DN and DN²."""

    kind: str
    exposure_s: float
    frames: int
    mean_dn: float
    variance_dn2: float
    variance_se_dn2: float
    model_mean_dn: float
    model_variance_dn2: float


def transfer_points(fitted: SeriesFit) -> tuple[TransferPoint, ...]:
    """Return the photon transfer and dark signal points."""
    values, darks, flats = fitted.fit.values, fitted.moments.darks, fitted.moments.flats
    dark_models = values["offset_dn"] + values.get("dark_signal_dn_per_s", 0.0) * darks.exposure_s
    rows = zip(
        (*fitted.darks, *fitted.flats),
        (*darks.mean_dn, *flats.mean_dn),
        (*darks.within_dn2, *flats.within_dn2),
        (*dark_models, *flats.mean_dn),
        (*fitted.dark_noise_dn2, *fitted.flat_noise_dn2),
        strict=True,
    )
    points = []
    for flat, mean, within, *model in rows:
        degrees = max((flat.frames - 1) * fitted.moments.freedom, 1.0)
        measured = within / degrees if flat.frames > 1 else np.nan
        numbers = map(float, (mean, measured, measured * np.sqrt(2 / degrees), *model))
        points.append(TransferPoint(flat.conditions.kind, flat.conditions.exposure_s, flat.frames, *numbers))
    return tuple(points)


def series_goodness(
    fit: NoiseFit, moments: Moments, darks: Sequence[Series], flats: Sequence[Series]
) -> tuple[SeriesGoodness, ...]:
    """Return the goodness of fit of each series, darks first."""
    t = moments.darks.exposure_s
    line = fit.values["offset_dn"] + fit.values.get("dark_signal_dn_per_s", 0.0) * t
    residuals: list[float | None] = [float(x) for x in moments.darks.mean_dn - line]
    residuals += _light_residuals(fit, moments)
    noise = [*dark_variances_dn2(fit.values, t), *flat_variances_dn2(fit.values, moments.flats.mean_dn)]
    freedom = np.concatenate(noise_freedom(moments))
    within = np.concatenate([moments.darks.within_dn2, moments.flats.within_dn2])
    goodness = []
    for j, item in enumerate((*darks, *flats)):
        if item.frames < 2:
            goodness.append(SeriesGoodness(item, None, None, residuals[j]))
            continue
        excess = float(within[j] / ((item.frames - 1) * moments.freedom * noise[j])) - 1
        sums = moments.noise[j]
        expected = noise[j] if item.conditions.kind == "dark" else flat_variances_of_nodes(fit, sums)
        scatter = [_scatter(*sums.scatter(groups, expected)) for groups in (sums.blocks, sums.rows, sums.columns)]
        # The variance of a frame over its pixels is that of noise and fixed pattern.
        pattern_dn2 = max(float(item.spreads_dn2.mean()) - float(noise[j]), 0.0)
        chance = (2 * float(noise[j]) ** 2 + 4 * float(noise[j]) * pattern_dn2) / float((~item.suspect).sum())
        scatter.append(Scatter(float(item.spreads_dn2.var() * item.frames / chance), item.frames - 1))
        se = float(np.sqrt(2 / max(freedom[j], 1.0)))
        goodness.append(SeriesGoodness(item, excess, se, residuals[j], *scatter))
    return tuple(goodness)


def _light_residuals(fit: NoiseFit, moments: Moments) -> list[float | None]:
    """Return the level of each flat minus that of the response; None where the light is not known."""
    light, signal = moments.flats.light, light_signal(fit, moments)
    residuals: list[float | None] = [None] * signal.size
    slope = charge_slope(fit.values, signal)
    for group in light.groups:
        members = np.flatnonzero(light.group == group)
        charge, amount = charge_dn(fit.values, signal[members]), light.amount[members]
        weight = 1 / np.array(level_variances_dn2(fit.values, moments), float)[members]
        factor = float(weight * amount @ charge / (weight * amount @ amount))
        for j, rest in zip(members.tolist(), charge - factor * amount, strict=True):
            residuals[j] = float(rest / np.broadcast_to(slope, signal.shape)[j])
    return residuals


def _scatter(ratio: Array, freedom: Array) -> Scatter:
    """Return the scatter of a series' noise over groups of pixels about its own mean."""
    mean = np.average(ratio, weights=freedom)
    return Scatter(float(np.sum(0.5 * freedom * (ratio / mean - 1) ** 2)), ratio.size - 1)
