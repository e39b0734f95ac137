"""Goodness of fit: photon transfer, residuals and scatter of each, and warnings of what contradicts the model."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from faintfield.calib.estimate import SeriesGoodness
from faintfield.calib.noise.flats import Saturation
from faintfield.calib.noise.likelihood.gaussian_fit import NoiseFit, level_variances_dn2
from faintfield.calib.noise.likelihood.moments import Moments
from faintfield.calib.noise.likelihood.response import UNKNOWN_BEND_SE, charge_dn, charge_slope
from faintfield.calib.noise.scatter import flat_variances_of_nodes, light_signal
from faintfield.calib.noise.sensor_fit import NoiseLikelihood, SeriesFit
from faintfield.calib.noise.series import Series
from faintfield.calib.noise.strips import Array

# The series contradict the model if a departure has at most this probability, or exceeds this many standard errors, and
# is more than this fraction: less does not matter.
_MAX_PROBABILITY, _MIN_SIGMAS, _NEGLIGIBLE_FRACTION = 1e-4, 6.0, 0.02

# Scatter between series that is named in a warning: of noise and light as a fraction, of levels over the read noise. A
# good model makes as much with this probability at most; intervals grow earlier.
_NOTABLE_FRACTION, _NOTABLE_DRIFT, _MAX_SCATTER_CHANCE = 0.005, 0.1, 1e-3


@dataclass(frozen=True)
class TransferPoint:
    """One series as EMVA 1288 plots it.

    Attributes
    ----------
    kind, exposure_s, frames : str, float, int
        "dark" or "flat", exposure time, and number of frames.
    mean_dn : float
        Mean of the pixels.
    variance_dn2, variance_se_dn2 : float
        Temporal variance of a pixel and its standard error; NaN for a single frame.
    model_mean_dn, model_variance_dn2 : float
        The same by the model. The model has no mean of its own for flats: it is the measured one.
    """

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
    values, series, moments = fitted.fit.values, fitted.moments.series, fitted.moments
    dark_models = values["offset_dn"] + values.get("dark_signal_dn_per_s", 0.0) * moments.darks.exposure_s
    rows = zip(
        (*fitted.darks, *fitted.flats),
        series.mean_dn,
        series.within_dn2,
        (*dark_models, *moments.flats.mean_dn),
        (*fitted.dark_noise_dn2, *fitted.flat_noise_dn2),
        strict=True,
    )
    points = []
    for flat, mean, within, *model in rows:
        degrees = max((flat.frames - 1) * moments.freedom, 1.0)
        measured = within / degrees if flat.frames > 1 else np.nan
        numbers = map(float, (mean, measured, measured * np.sqrt(2 / degrees), *model))
        points.append(TransferPoint(flat.conditions.kind, flat.conditions.exposure_s, flat.frames, *numbers))
    return tuple(points)


def goodness_of(series: Series, **numbers: Any) -> SeriesGoodness:
    """Return a goodness of fit with the conditions of its series."""
    conditions = series.conditions
    return SeriesGoodness(conditions.kind, conditions.exposure_s, conditions.level, series.frames, **numbers)


def series_goodness(fitted: SeriesFit) -> tuple[SeriesGoodness, ...]:
    """Return the goodness of fit of each series, darks first."""
    fit, moments = fitted.fit, fitted.moments
    line = fit.values["offset_dn"] + fit.values.get("dark_signal_dn_per_s", 0.0) * moments.darks.exposure_s
    residuals = [*(moments.darks.mean_dn - line).tolist(), *_light_residuals(fit, moments)]
    noise = [*fitted.dark_noise_dn2, *fitted.flat_noise_dn2]
    freedom, within = moments.noise_freedom, moments.series.within_dn2
    goodness = []
    for j, item in enumerate((*fitted.darks, *fitted.flats)):
        if item.frames < 2:
            goodness.append(goodness_of(item, level_residual_dn=residuals[j]))
            continue
        excess = float(within[j] / ((item.frames - 1) * moments.freedom * noise[j])) - 1
        sums = moments.noise[j]
        expected = noise[j] if item.conditions.kind == "dark" else flat_variances_of_nodes(fit, sums)
        groups = {"blocks": sums.blocks, "rows": sums.rows, "columns": sums.columns}
        scatter = {name: _deviance(*sums.scatter(of_groups, expected)) for name, of_groups in groups.items()}
        # The variance of a frame over its pixels is that of noise and fixed pattern.
        noise_dn2 = float(noise[j])
        pattern_dn2 = max(float(item.spreads_dn2.mean()) - noise_dn2, 0.0)
        chance = (2 * noise_dn2**2 + 4 * noise_dn2 * pattern_dn2) / float((~item.suspect).sum())
        scatter["by_frame"] = float(item.spreads_dn2.var() * item.frames / chance) / (item.frames - 1)
        se = float(np.sqrt(2 / max(freedom[j], 1.0)))
        numbers = {"noise_excess": excess, "noise_se": se, "level_residual_dn": residuals[j]}
        goodness.append(goodness_of(item, **numbers, **scatter))
    return tuple(goodness)


def _light_residuals(fit: NoiseFit, moments: Moments) -> list[float | None]:
    """Return the level of each flat minus that of the response; None where the light is not known."""
    light, signal = moments.light, light_signal(fit, moments)
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


def _deviance(ratio: Array, freedom: Array) -> float | None:
    """Return the deviance of a series' noise over groups about its own mean, per degree of freedom if there is any."""
    mean = np.average(ratio, weights=freedom)
    deviance = float(np.sum(0.5 * freedom * (ratio / mean - 1) ** 2))
    return deviance / (ratio.size - 1) if ratio.size > 1 else None


def frame_warnings(fitted: SeriesFit, saturation: Saturation) -> list[str]:
    """Return warnings about lone frames, values that are cut off, and flats that are left out."""
    warnings = [
        f"{dark.names[0]}: the only one of the {dark.conditions}; it tells the mean but no noise: record at least 2"
        for dark in fitted.darks
        if dark.frames < 2
    ]
    if fitted.likelihood is NoiseLikelihood.CENSORED:
        warnings.append(
            "values are cut off at the black level: offset and dark current are given for the sensor, not per pixel; "
            "raise the camera's black offset if it has one"
        )
    if saturation.left_out:
        first, why = saturation.left_out[0]
        warnings.append(
            f"{len(saturation.left_out)} series of flats are left out, beginning with the {first.conditions}; "
            f"{first.names[0]}: {why}"
        )
    return warnings


def scatter_warnings(fitted: SeriesFit) -> list[str]:
    """Return warnings about scatter between series by which intervals have grown, and about light of flats.

    Each series of flats whose level does not match its light is named with the light that does.
    """
    excess, values, light, warnings = fitted.moments.excess, fitted.fit.values, fitted.moments.light, list[str]()
    signal = light_signal(fitted.fit, fitted.moments)
    for index, group in light.odd:
        members = (light.group == group) & (signal > 0)
        if not members.any():
            continue
        factor = float(np.median(charge_dn(values, signal[members]) / light.amount[members]))
        conditions = fitted.flats[index].conditions
        by_photons = conditions.photons == light.amount[index]
        kind, key = ("photons", "photons") if by_photons else ("s", "exposure_s")
        warnings.append(
            f"the {conditions}: {light.amount[index]:.5g} {kind} are stated, their level is that of "
            f"{float(charge_dn(values, signal[index])) / factor:.5g} {kind} by the other levels; they are left out of "
            f"the response: correct {key} of {fitted.flats[index].names[0]} and its like, or record the level again"
        )
    read_dn = float(np.exp(0.5 * values["log_read_dn2"]))
    noise, drift, flicker = (
        float(np.sqrt(getattr(excess, name))) if fitted.fit.chances.get(name, 1.0) <= _MAX_SCATTER_CHANCE else 0.0
        for name in ("variance2", "drift_dn2", "light2")
    )
    if noise > _NOTABLE_FRACTION:
        warnings.append(
            f"the noise of the series scatters by {noise:.1%} in variance about the model beyond chance; the intervals "
            "have grown by it: the noise of the camera changed, or the light was not steady"
        )
    if drift > _NOTABLE_DRIFT * read_dn:
        warnings.append(
            f"the dark level drifts by {drift:.2g} DN from series to series; the intervals have grown by it: let the "
            "camera settle and record the exposures in turn"
        )
    if flicker > _NOTABLE_FRACTION:
        warnings.append(
            f"the levels of the flats scatter by {flicker:.1%} about the response; the intervals have grown by it: let "
            "the lamp settle, or measure its light with each flat"
        )
    if fitted.flats and UNKNOWN_BEND_SE in fitted.moments.bend_se:
        warnings.append(
            f"the light of the flats is not known well enough to tell a bend of the response from the gain; the "
            f"intervals allow for {2 * UNKNOWN_BEND_SE:.1%} at the end of the range: state the photons of at least 3 "
            "light levels, or record 3 exposures under one light"
        )
    return warnings


def level_warning(fitted: SeriesFit) -> str | None:
    """Return a warning if the dark levels do not lie on a straight line over exposure time."""
    darks, values = fitted.moments.darks, fitted.fit.values
    within = float((darks.frames - 1).sum())
    free = np.unique(darks.exposure_s).size - 2
    if fitted.likelihood is NoiseLikelihood.CENSORED or free < 1 or within < 1:
        return None
    noise = np.array(fitted.dark_noise_dn2) / fitted.moments.pixels
    jitter = max(float(darks.level_scatter_dn2.sum()) / within - float(noise.mean()), 0.0)
    weight = darks.frames / (jitter + noise)
    slope, offset = np.polyfit(darks.exposure_s, darks.mean_dn, 1, w=np.sqrt(weight))
    residual = darks.mean_dn - offset - slope * darks.exposure_s
    chance = float(stats.f.sf(float(weight @ residual**2) / free, free, within))
    worst = int(np.abs(residual).argmax())
    span = abs(slope) * float(np.ptp(darks.exposure_s)) + np.sqrt(np.exp(values["log_read_dn2"]))
    if chance > _MAX_PROBABILITY or abs(residual[worst]) < _NEGLIGIBLE_FRACTION * span:
        return None
    return (
        f"the dark level against exposure time is no straight line: that of the {fitted.darks[worst].conditions} is "
        f"{residual[worst]:+.2f} DN off it (probability {chance:.1g}); the temperature or the black level drifted, or "
        "light leaked in: let the camera settle and record the exposures in turn"
    )


def noise_warning(fitted: SeriesFit, points: Sequence[TransferPoint]) -> str | None:
    """Return a warning if a series is noisier or quieter than eq. (1) allows."""
    if fitted.likelihood is NoiseLikelihood.CENSORED:
        return None
    rounding2 = fitted.moments.series.rounding2
    several = [(point, error2) for point, error2 in zip(points, rounding2, strict=True) if point.frames > 1]
    excess = [point.variance_dn2 / point.model_variance_dn2 - 1 for point, _ in several]
    # What rounding may make of the noise is no contradiction.
    left = [max(abs(share) - 2 * np.sqrt(error2), 0.0) for share, (_, error2) in zip(excess, several, strict=True)]
    worst = int(np.argmax(left))
    point = several[worst][0]
    sigmas = left[worst] * point.model_variance_dn2 / point.variance_se_dn2
    if left[worst] < _NEGLIGIBLE_FRACTION or sigmas < _MIN_SIGMAS:
        return None
    return (
        f"the noise of the {point.kind}s of {point.exposure_s:g} s is {100 * excess[worst]:+.1f} % off the model's in "
        f"variance ({sigmas:.0f} standard errors): the noise of the camera changed between series, or the light was "
        "not steady; record them again in one go"
    )
