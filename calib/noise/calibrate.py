"""The whole calibration of one plane: from series of darks and flats to numbers, maps and doubts."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise.diagnostics import check_series, frame_warnings, level_warning, noise_warning
from faintfield.calib.noise.estimates import estimate_all
from faintfield.calib.noise.fitting import SeriesFit, fit_series
from faintfield.calib.noise.histogram import Histogram, compare_histogram
from faintfield.calib.noise.maps import offset_and_dark_signal, shrunk_variance_ratio
from faintfield.calib.noise.pixels import hot_pixels, noisy_pixels, variance_ratio
from faintfield.calib.noise.response import Response, measure_response
from faintfield.calib.noise.result import Estimate, NoiseCalibration, NoiseMaps, TransferPoint
from faintfield.calib.noise.selection import MAX_TABLE_WIDTH_DN, NoiseLikelihood, collect_counts
from faintfield.calib.noise.statistics import Series


def calibrate(series: Sequence[Series], saturation_dn: float = np.inf) -> NoiseCalibration:
    """Measure a sensor, or one colour phase of it.

    Parameters
    ----------
    series : sequence of Series
        Darks of at least one exposure, flats or none; all of one size.
    saturation_dn : float
        Value from which a pixel is saturated, passed on to the result.

    Raises
    ------
    NotIdentifiable
        There is no dark.
    TooFewFrames
        No exposure has two frames, a light level has one, or the frames are too small.
    CopiedFrame
        Two frames are the same.
    PoorFit
        The likelihood has no maximum.
    """
    darks = [one for one in series if one.conditions.kind == "dark"]
    flats = [one for one in series if one.conditions.kind == "flat"]
    check_series(darks, flats)
    hot = hot_pixels(darks)
    fitted = fit_series(darks, flats, ~hot)
    noisy = _noisy(fitted) & ~hot
    if noisy.any():
        fitted = fit_series(darks, flats, ~hot & ~noisy)
    points = _points(fitted)
    level, noise = level_warning(fitted), noise_warning(fitted, points)
    offsets = _offsets(fitted, hot)
    response = _response(fitted, offsets[0], offsets[1], ~hot & ~noisy)
    estimates, covariance = estimate_all(fitted, response, levels_hold=level is None, noise_holds=noise is None)
    dead = response.dead if response else np.zeros_like(hot)
    return NoiseCalibration(
        estimates=estimates,
        covariance=covariance,
        likelihood=fitted.likelihood,
        maps=_maps(fitted, estimates, offsets, response, hot | noisy | dead),
        hot=hot,
        noisy=noisy,
        dead=dead,
        variance_ratio=variance_ratio(darks, fitted.dark_noise_dn2)[0].astype(np.float32),
        points=points,
        histograms=_histograms(fitted, ~hot & ~noisy),
        saturation_dn=saturation_dn,
        warnings=(*frame_warnings(fitted), *filter(None, (level, noise))),
    )


def _noisy(fitted: SeriesFit) -> NDArray[np.bool_]:
    """Return the noisy pixels; where values are cut off their variances tell nothing."""
    if fitted.likelihood is NoiseLikelihood.CENSORED:
        return np.zeros(fitted.darks[0].pattern_dn.shape, bool)
    return noisy_pixels(*variance_ratio(fitted.darks, fitted.dark_noise_dn2))


def _offsets(
    fitted: SeriesFit, hot: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return offset and dark signal of every pixel, with variances; those of the whole sensor where values are cut."""
    values = fitted.fit.values
    if fitted.likelihood is NoiseLikelihood.CENSORED:
        shape = hot.shape
        spreads = np.array([values["dsnu_dn2"], values["dcnu_dn2_per_s2"]])
        return (
            np.full(shape, values["offset_dn"]),
            np.full(shape, values["dark_signal_dn_per_s"]),
            np.broadcast_to(spreads[:, None, None], (2, *shape)),
        )
    return offset_and_dark_signal(fitted.darks, values, fitted.dark_noise_dn2, fitted.profiles_dn2, hot)


def _maps(
    fitted: SeriesFit,
    estimates: dict[str, Estimate],
    offsets: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    response: Response | None,
    unusable: NDArray[np.bool_],
) -> NoiseMaps:
    """Return the maps: in electrons what can be, nothing for what cannot."""
    offset, signal, variances = offsets
    gain = estimates["gain_dn_per_e"].value
    read_noise = dark_current = dark_variance = None
    if gain is not None:
        ratio = shrunk_variance_ratio(*variance_ratio(fitted.darks, fitted.dark_noise_dn2), ~unusable)
        read_noise = (np.sqrt(np.exp(fitted.fit.values["log_read_dn2"]) * ratio) / gain).astype(np.float32)
    if gain is not None and estimates["dark_current_e_per_s"].value is not None:
        dark_current = np.maximum(signal / gain, 0).astype(np.float32)
        dark_variance = (variances[1] / gain**2).astype(np.float32)
    return NoiseMaps(
        offset_dn=offset.astype(np.float32),
        offset_variance_dn2=variances[0].astype(np.float32),
        unusable=unusable,
        dark_current_e_per_s=dark_current,
        dark_current_variance_e2_per_s2=dark_variance,
        read_noise_e=read_noise,
        relative_response=response.relative.astype(np.float32) if response else None,
        vignetting=response.vignetting.astype(np.float32) if response else None,
    )


def _response(
    fitted: SeriesFit,
    offset_dn: NDArray[np.float64],
    signal_dn_per_s: NDArray[np.float64],
    usable: NDArray[np.bool_],
) -> Response | None:
    """Return the photo response, None without flats."""
    if not fitted.flats:
        return None
    signals = [one.mean_dn - offset_dn - signal_dn_per_s * one.conditions.exposure_s for one in fitted.flats]
    noise = [v / one.frames for v, one in zip(fitted.flat_noise_dn2, fitted.flats, strict=True)]
    return measure_response(signals, noise, usable)


def _histograms(fitted: SeriesFit, usable: NDArray[np.bool_]) -> tuple[Histogram, ...]:
    """Return the values of the shortest and the longest darks beside their prediction."""
    values = fitted.fit.values
    if "log_gain" not in values:
        return ()
    counts = collect_counts(fitted.darks, usable)
    ends = sorted({int(np.argmin(counts.exposure_s)), int(np.argmax(counts.exposure_s))})
    shared = values["dsnu_dn2"] + values.get("jitter_dn2", 0.0) + fitted.profiles_dn2
    return tuple(
        compare_histogram(
            counts.values_dn[j],
            counts.exposure_s[j],
            values,
            shared + values.get("dcnu_dn2_per_s2", 0.0) * counts.exposure_s[j] ** 2,
            counts.floor_dn,
        )
        for j in ends
        if np.ptp(counts.values_dn[j]) < MAX_TABLE_WIDTH_DN
    )


def _points(fitted: SeriesFit) -> tuple[TransferPoint, ...]:
    """Return the photon transfer and dark signal points."""
    values, moments = fitted.fit.values, fitted.moments
    slope = values.get("dark_signal_dn_per_s", 0.0)
    dark_models = values["offset_dn"] + slope * moments.darks.exposure_s
    means = np.concatenate([moments.darks.mean_dn, moments.flats.mean_dn])
    withins = np.concatenate([moments.darks.within_dn2, moments.flats.within_dn2])
    models = np.concatenate([dark_models, moments.flats.mean_dn])
    variances = [*fitted.dark_noise_dn2, *fitted.flat_noise_dn2]
    series = (*fitted.darks, *fitted.flats)
    points = []
    for one, mean, within, model_mean, model_variance in zip(series, means, withins, models, variances, strict=True):
        degrees = max((one.frames - 1) * moments.freedom, 1.0)
        measured = float(within) / degrees if one.frames > 1 else float("nan")
        points.append(
            TransferPoint(
                kind=one.conditions.kind,
                exposure_s=one.conditions.exposure_s,
                frames=one.frames,
                mean_dn=float(mean),
                variance_dn2=measured,
                variance_se_dn2=measured * float(np.sqrt(2 / degrees)),
                model_mean_dn=float(model_mean),
                model_variance_dn2=float(model_variance),
            )
        )
    return tuple(points)
