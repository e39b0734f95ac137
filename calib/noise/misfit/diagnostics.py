"""Check the series before the fit, and warn of what contradicts the model after it."""

from collections.abc import Sequence

import numpy as np
from scipy import stats

from faintfield.calib.errors import CopiedFrame, NotIdentifiable, TooFewFrames
from faintfield.calib.noise.fit.scatter import light_signal
from faintfield.calib.noise.fit.series_fit import NoiseLikelihood, SeriesFit
from faintfield.calib.noise.likelihood.response import UNKNOWN_BEND_SE, charge_dn
from faintfield.calib.noise.misfit.goodness import TransferPoint
from faintfield.calib.noise.series.flats import Saturation
from faintfield.calib.noise.series.statistics import Series

# Smallest frames, in pixels and in rows or columns; fewer leave the spreads over pixels to chance.
_MIN_PIXELS, _MIN_SIDE_PX = 256, 8

# The series contradict the model if a departure has at most this probability, or exceeds this many standard errors, and
# is more than this fraction: less does not matter.
_MAX_PROBABILITY, _MIN_SIGMAS, _NEGLIGIBLE_FRACTION = 1e-4, 6.0, 0.02

# Scatter between series that is named in a warning: of noise and light as a fraction, of levels over the read noise.
_NOTABLE_FRACTION, _NOTABLE_DRIFT = 0.005, 0.1


def check_series(darks: Sequence[Series], flats: Sequence[Series]) -> None:
    """Check that the series are enough for a calibration.

    Raises
    ------
    NotIdentifiable
        There is no dark.
    TooFewFrames
        No exposure has two frames, a light level has one, or the frames are too small.
    CopiedFrame
        Two frames are identical.
    """
    if not darks:
        raise NotIdentifiable("no dark frames: the offset cannot be told from the light; record darks, lens covered")
    seen: dict[bytes, str] = {}
    for item in (*darks, *flats):
        for digest, name in zip(item.digests, item.names, strict=True):
            if digest in seen:
                raise CopiedFrame(
                    f"{name} and {seen[digest]}: the same frame twice, pixel for pixel; noise never repeats: record "
                    "it again, or leave one out"
                )
            seen[digest] = name
    if all(dark.frames < 2 for dark in darks):
        raise TooFewFrames(
            f"{darks[0].names[0]}: the only one of the {darks[0].conditions}, and no exposure has two dark frames, so "
            "that noise and pattern cannot be told apart; record at least 2 of one exposure, better 10 of each"
        )
    for flat in flats:
        if flat.frames < 2:
            raise TooFewFrames(
                f"{flat.names[0]}: the only one of the {flat.conditions}; photon transfer needs 2 frames at least of "
                "each light level: record another or leave it out"
            )
    pixels = darks[0].pattern_dn.size
    if pixels < _MIN_PIXELS or min(darks[0].pattern_dn.shape) < _MIN_SIDE_PX:
        raise TooFewFrames(
            f"frames of {pixels} pixels, limits {_MIN_PIXELS} pixels and {_MIN_SIDE_PX} rows and columns; "
            "record larger frames, or widen the region"
        )


def frame_warnings(fitted: SeriesFit) -> list[str]:
    """Return warnings about lone frames and values that are cut off."""
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
    return warnings


def saturation_warnings(saturation: Saturation) -> list[str]:
    """Return a warning that names the flats that are left out."""
    if not saturation.left_out:
        return []
    first, why = saturation.left_out[0]
    return [
        f"{len(saturation.left_out)} series of flats are left out, beginning with the {first.conditions}; "
        f"{first.names[0]}: {why}"
    ]


def scatter_warnings(fitted: SeriesFit) -> list[str]:
    """Return warnings about scatter between series by which intervals have grown, and about light that is not known."""
    excess, warnings = fitted.moments.excess, []
    read_dn = float(np.exp(0.5 * fitted.fit.values["log_read_dn2"]))
    noise, drift, light = (float(np.sqrt(variance)) for variance in (excess.variance2, excess.drift_dn2, excess.light2))
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
    if light > _NOTABLE_FRACTION:
        warnings.append(
            f"the levels of the flats scatter by {light:.1%} about the response; the intervals have grown by it: let "
            "the lamp settle, or measure its light with each flat"
        )
    if fitted.flats and fitted.moments.flats.bend_se == UNKNOWN_BEND_SE:
        warnings.append(
            f"the light of the flats is not known well enough to tell a bend of the response from the gain; the "
            f"intervals allow for {2 * UNKNOWN_BEND_SE:.1%} at the end of the range: state the photons of at least 3 "
            "light levels, or record 3 exposures under one light"
        )
    return warnings


def odd_light_warnings(fitted: SeriesFit) -> list[str]:
    """Return a warning for each series of flats whose level does not match its light, with the light that does."""
    values, flats, warnings = fitted.fit.values, fitted.moments.flats, []
    signal = light_signal(fitted.fit, fitted.moments)
    for index, group in flats.light.odd:
        members = (flats.light.group == group) & (signal > 0)
        if not members.any():
            continue
        factor = float(np.median(charge_dn(values, signal[members]) / flats.light.amount[members]))
        conditions = fitted.flats[index].conditions
        kind = "photons" if conditions.photons == flats.light.amount[index] else "s"
        key = "photons" if kind == "photons" else "exposure_s"
        warnings.append(
            f"the {conditions}: {flats.light.amount[index]:.5g} {kind} are stated, their level is that of "
            f"{float(charge_dn(values, signal[index])) / factor:.5g} {kind} by the other levels; they are left out of "
            f"the response: correct {key} of {fitted.flats[index].names[0]} and its like, or record the level again"
        )
    return warnings


def level_warning(fitted: SeriesFit) -> str | None:
    """Return a warning if the dark levels do not lie on a straight line over exposure time."""
    moments, values = fitted.moments, fitted.fit.values
    darks = moments.darks
    within = float((darks.frames - 1).sum())
    free = np.unique(darks.exposure_s).size - 2
    if fitted.likelihood is NoiseLikelihood.CENSORED or free < 1 or within < 1:
        return None
    noise = np.array(fitted.dark_noise_dn2) / moments.pixels
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
    rounding2 = np.concatenate([fitted.moments.darks.rounding2, fitted.moments.flats.rounding2])
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
