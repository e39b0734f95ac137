"""The whole calibration of one plane: from series of darks and flats to numbers, maps and doubts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from calib.errors import CopiedFrame, NotIdentifiable, TooFewFrames
from calib.noise.estimates import estimate_all
from calib.noise.exact import fit_exact
from calib.noise.gaussian import Fit, dark_variances_dn2, fit_gaussian, flat_variances_dn2
from calib.noise.histogram import Histogram, compare_histogram
from calib.noise.maps import offset_and_dark_signal, shrunk_variance_ratio
from calib.noise.moments import Moments, gather_moments
from calib.noise.pixels import hot_pixels, noisy_pixels, variance_ratio
from calib.noise.response import Response, measure_response
from calib.noise.result import NoiseCalibration, NoiseMaps, TransferPoint
from calib.noise.selection import (
    MOST_VALUES_DN,
    Likelihood,
    censored_start,
    choose_likelihood,
    collect_counts,
    gaussian_start,
)
from calib.noise.statistics import Series

# Fewer pixels leave the spreads over pixels, and so everything, to chance.
_LEAST_PIXELS = 256

# A model that the series contradict this improbably is wrong; by less than this fraction it does not matter.
_CONTRADICTION, _CONTRADICTION_SIGMA, _NEGLIGIBLE = 1e-4, 6.0, 0.02


@dataclass(frozen=True)
class _Fitted:
    """A fit and what it rests on."""

    fit: Fit
    likelihood: Likelihood
    moments: Moments
    bend: Fit | None

    @property
    def dark_noise_dn2(self) -> list[float]:
        """Pixel noise v_j of the dark series."""
        return dark_variances_dn2(self.fit.values, self.moments.darks.exposure_s)

    @property
    def flat_noise_dn2(self) -> list[float]:
        """Pixel noise of the flat series."""
        flats = self.moments.flats
        return flat_variances_dn2(self.fit.values, flats.mean_dn) if flats.frames.size else []


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
    _check(darks, flats)
    hot = hot_pixels(darks)
    fitted = _fit(darks, flats, ~hot)
    noise = fitted.dark_noise_dn2
    ratio, freedom = variance_ratio(darks, noise)
    noisy = noisy_pixels(ratio, freedom) & ~hot & (fitted.likelihood != Likelihood.CENSORED)
    if noisy.any():
        fitted = _fit(darks, flats, ~hot & ~noisy)
        ratio, freedom = variance_ratio(darks, fitted.dark_noise_dn2)
    usable = ~hot & ~noisy
    offset, signal, variances = _offsets(darks, fitted, hot)
    response = _response(flats, fitted, offset, signal, usable)
    points = _points(darks, flats, fitted)
    bent_line, uneven_noise = _level_contradiction(fitted), _noise_contradiction(fitted, points)
    estimates, covariance = estimate_all(
        fitted.fit,
        fitted.moments,
        darks,
        flats,
        bend=fitted.bend,
        response=response,
        levels_hold=bent_line is None,
        noise_holds=uneven_noise is None,
    )
    gain = estimates["gain_dn_per_e"].value
    read_noise_dn = np.sqrt(np.exp(fitted.fit.values["log_read_dn2"]) * shrunk_variance_ratio(ratio, freedom, usable))
    dead = response.dead if response else np.zeros_like(hot)
    has_dark = estimates["dark_current_e_per_s"].value is not None and gain is not None
    maps = NoiseMaps(
        offset_dn=offset.astype(np.float32),
        offset_variance_dn2=variances[0].astype(np.float32),
        unusable=hot | noisy | dead,
        dark_current_e_per_s=np.maximum(signal / gain, 0).astype(np.float32) if has_dark and gain else None,
        dark_current_variance_e2_per_s2=(variances[1] / gain**2).astype(np.float32) if has_dark and gain else None,
        read_noise_e=(read_noise_dn / gain).astype(np.float32) if gain else None,
        relative_response=response.relative.astype(np.float32) if response else None,
        vignetting=response.vignetting.astype(np.float32) if response else None,
    )
    return NoiseCalibration(
        estimates=estimates,
        covariance=covariance,
        likelihood=fitted.likelihood,
        maps=maps,
        hot=hot,
        noisy=noisy,
        dead=dead,
        variance_ratio=ratio.astype(np.float32),
        points=points,
        histograms=_histograms(darks, fitted, usable),
        saturation_dn=saturation_dn,
        warnings=(*_warnings(darks, fitted), *filter(None, (bent_line, uneven_noise))),
    )


def _check(darks: Sequence[Series], flats: Sequence[Series]) -> None:
    """Refuse series from which nothing can be told."""
    if not darks:
        raise NotIdentifiable("no dark frames: the offset cannot be told from the light; record darks, lens covered")
    seen: dict[bytes, str] = {}
    for one in (*darks, *flats):
        for digest, name in zip(one.digests, one.names, strict=True):
            if digest in seen:
                raise CopiedFrame(
                    f"{name} and {seen[digest]}: the same frame twice, pixel for pixel; noise never repeats: record "
                    "it again, or leave one out"
                )
            seen[digest] = name
    if all(one.frames < 2 for one in darks):
        raise TooFewFrames(
            f"{darks[0].names[0]}: the only one of the {darks[0].conditions}, and no exposure has two dark frames, so "
            "that noise and pattern cannot be told apart; record at least 2 of one exposure, better 10 of each"
        )
    for one in flats:
        if one.frames < 2:
            raise TooFewFrames(
                f"{one.names[0]}: the only one of the {one.conditions}; photon transfer needs 2 frames at least of "
                "each light level: record another or leave it out"
            )
    pixels = darks[0].pattern_dn.size
    if pixels < _LEAST_PIXELS or min(darks[0].pattern_dn.shape) < 8:
        raise TooFewFrames(f"frames of {pixels} pixels: {_LEAST_PIXELS} and 8 rows and columns are the least")


def _fit(darks: Sequence[Series], flats: Sequence[Series], usable: NDArray[np.bool_]) -> _Fitted:
    """Fit with the simplest likelihood that holds."""
    suspect = np.any([one.suspect for one in darks], axis=0)
    moments = gather_moments(darks, flats, usable & ~suspect)
    fit, bend = _fit_gaussian(moments)
    # Among values cut off at the floor the highest look suspect, and leaving them out would bias the rest.
    counts = collect_counts(darks, usable)
    likelihood = choose_likelihood(counts, fit)
    if likelihood is not Likelihood.GAUSSIAN:
        exact = likelihood is Likelihood.EXACT
        if exact:
            counts = collect_counts(darks, usable & ~suspect)
        start = gaussian_start(fit) if exact else censored_start(counts)
        # The Gaussian fit tells whether pixels differ in dark current, unless values are cut off.
        spread = not exact or fit.values["dcnu_dn2_per_s2"] > 3 * fit.standard_error("dcnu_dn2_per_s2")
        fit = fit_exact(counts, start, moments.flats, moments.freedom, exact=exact, try_spread=spread)
        bend = None
    return _Fitted(fit, likelihood, moments, bend)


def _fit_gaussian(moments: Moments) -> tuple[Fit, Fit | None]:
    """Fit a straight response, and where three light levels allow it a bent one; the bent one where it is bent."""
    straight = fit_gaussian(moments)
    if np.unique(np.round(moments.flats.mean_dn, -1)).size < 3:
        return straight, None
    bent = fit_gaussian(moments, nonlinear=True)
    significant = abs(bent.values["nonlinearity_per_dn"]) > 3 * bent.standard_error("nonlinearity_per_dn")
    return (bent if significant else straight), bent


def _offsets(
    darks: Sequence[Series], fitted: _Fitted, hot: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return offset and dark signal of every pixel, with variances; those of the whole sensor where values are cut."""
    values = fitted.fit.values
    if fitted.likelihood is Likelihood.CENSORED:
        shape = hot.shape
        spreads = np.array([values["dsnu_dn2"], values["dcnu_dn2_per_s2"]])
        return (
            np.full(shape, values["offset_dn"]),
            np.full(shape, values["dark_signal_dn_per_s"]),
            np.broadcast_to(spreads[:, None, None], (2, *shape)),
        )
    return offset_and_dark_signal(darks, values, fitted.dark_noise_dn2, _profiles_dn2(darks[0]), hot)


def _profiles_dn2(series: Series) -> float:
    """Return the variance that the fixed patterns of rows and columns add to the pixels' own."""
    return float(series.row_dn.var() + series.column_dn.var())


def _histograms(darks: Sequence[Series], fitted: _Fitted, usable: NDArray[np.bool_]) -> tuple[Histogram, ...]:
    """Return the values of the shortest and the longest darks beside their prediction."""
    values = fitted.fit.values
    if "log_gain" not in values:
        return ()
    counts = collect_counts(darks, usable)
    ends = sorted({int(np.argmin(counts.exposure_s)), int(np.argmax(counts.exposure_s))})
    shared = values["dsnu_dn2"] + values.get("jitter_dn2", 0.0) + _profiles_dn2(darks[0])
    return tuple(
        compare_histogram(
            counts.values_dn[j],
            counts.exposure_s[j],
            values,
            shared + values.get("dcnu_dn2_per_s2", 0.0) * counts.exposure_s[j] ** 2,
            counts.floor_dn,
        )
        for j in ends
        if np.ptp(counts.values_dn[j]) < MOST_VALUES_DN
    )


def _response(
    flats: Sequence[Series],
    fitted: _Fitted,
    offset_dn: NDArray[np.float64],
    signal_dn_per_s: NDArray[np.float64],
    usable: NDArray[np.bool_],
) -> Response | None:
    """Return the photo response, None without flats."""
    if not flats:
        return None
    signals = [one.mean_dn - offset_dn - signal_dn_per_s * one.conditions.exposure_s for one in flats]
    noise = [v / one.frames for v, one in zip(fitted.flat_noise_dn2, flats, strict=True)]
    return measure_response(signals, noise, usable)


def _level_contradiction(fitted: _Fitted) -> str | None:
    """Return a warning where the dark levels do not lie on a straight line over exposure time."""
    moments, values = fitted.moments, fitted.fit.values
    darks = moments.darks
    within = float((darks.frames - 1).sum())
    free = np.unique(darks.exposure_s).size - 2
    if fitted.likelihood is Likelihood.CENSORED or free < 1 or within < 1:
        return None
    noise = np.array(fitted.dark_noise_dn2) / moments.pixels
    jitter = max(float(darks.level_scatter_dn2.sum()) / within - float(noise.mean()), 0.0)
    weight = darks.frames / (jitter + noise)
    slope, offset = np.polyfit(darks.exposure_s, darks.mean_dn, 1, w=np.sqrt(weight))
    residual = darks.mean_dn - offset - slope * darks.exposure_s
    chance = float(stats.f.sf(float(weight @ residual**2) / free, free, within))
    worst = int(np.abs(residual).argmax())
    span = abs(slope) * float(np.ptp(darks.exposure_s)) + np.sqrt(np.exp(values["log_read_dn2"]))
    if chance > _CONTRADICTION or abs(residual[worst]) < _NEGLIGIBLE * span:
        return None
    return (
        f"the dark level against exposure time is no straight line: that at {darks.exposure_s[worst]:g} s is "
        f"{residual[worst]:+.2f} DN off it (probability {chance:.1g}); the temperature or the black level drifted, or "
        "light leaked in: let the camera settle and record the exposures in turn"
    )


def _noise_contradiction(fitted: _Fitted, points: Sequence[TransferPoint]) -> str | None:
    """Return a warning where a series is noisier or quieter than eq. (1) allows."""
    if fitted.likelihood is Likelihood.CENSORED:
        return None
    measured = [point for point in points if point.frames > 1]
    excess = [point.variance_dn2 / point.model_variance_dn2 - 1 for point in measured]
    worst = int(np.abs(excess).argmax())
    point = measured[worst]
    sigmas = abs(point.variance_dn2 - point.model_variance_dn2) / point.variance_se_dn2
    if abs(excess[worst]) < _NEGLIGIBLE or sigmas < _CONTRADICTION_SIGMA:
        return None
    return (
        f"the noise of the {point.kind}s of {point.exposure_s:g} s is {100 * excess[worst]:+.1f} % off the model's in "
        f"variance ({sigmas:.0f} standard errors): the noise of the camera changed between series, or the light was "
        "not steady; record them again in one go"
    )


def _warnings(darks: Sequence[Series], fitted: _Fitted) -> list[str]:
    """Return what is doubtful about the darks."""
    warnings = [
        f"{one.names[0]}: the only one of the {one.conditions}; it tells the mean but no noise: record at least 2"
        for one in darks
        if one.frames < 2
    ]
    if fitted.likelihood is Likelihood.CENSORED:
        warnings.append(
            "values are cut off at the black level: offset and dark current are given for the sensor, not per pixel; "
            "raise the camera's black offset if it has one"
        )
    return warnings


def _points(darks: Sequence[Series], flats: Sequence[Series], fitted: _Fitted) -> tuple[TransferPoint, ...]:
    """Return the photon transfer and dark signal points."""
    values, moments = fitted.fit.values, fitted.moments
    slope = values.get("dark_signal_dn_per_s", 0.0)
    models = [values["offset_dn"] + slope * t for t in moments.darks.exposure_s]
    dark_points = zip(
        darks, moments.darks.mean_dn, moments.darks.within_dn2, models, fitted.dark_noise_dn2, strict=True
    )
    flat_means = moments.flats.mean_dn
    flat_points = zip(flats, flat_means, moments.flats.within_dn2, flat_means, fitted.flat_noise_dn2, strict=True)
    points = []
    for one, mean, within, model_mean, model_variance in (*dark_points, *flat_points):
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
