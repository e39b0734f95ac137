"""Saturation and response from the flats, and the scatter of the series about the model."""

import numpy as np
from scipy import stats

from faintfield.calib.estimate import Estimate, root
from faintfield.calib.noise.fit.series_fit import SeriesFit
from faintfield.calib.noise.likelihood.gaussian import flat_variances_dn2, level_variances_dn2
from faintfield.calib.noise.likelihood.maximum import NoiseFit
from faintfield.calib.noise.likelihood.moments import Moments
from faintfield.calib.noise.likelihood.response import FittedLevels, charge_dn
from faintfield.calib.noise.misfit import series_goodness
from faintfield.calib.noise.series.flats import Saturation
from faintfield.calib.noise.strips import Array

# Largest scatter of the noise of series about the model, and largest departure of one, as fractions of the variance.
MAX_NOISE_ERROR, _MAX_DEPARTURE, _MIN_SIGMAS = 0.05, 0.1, 6.0

# Draws of the response from its covariance, for the error of the linearity error.
_DRAWS = 200

# Largest share of draws that no response can have; with more the linearity error has no value.
_MAX_IMPOSSIBLE = 0.05

_POOR_RESPONSE = (
    "the levels of the flats leave the response open, so that it might even fall; record more frames of each level, "
    "and the levels in one go"
)
_NO_LIGHT = (
    "the light of the flats is not known: state the photons of at least 3 light levels over a factor of 2, or record 3 "
    "exposures under one light"
)


def why_noise_denies(fitted: SeriesFit) -> str | None:
    """Return why the noise of the series denies the model, None if it does not; only with flats."""
    if not fitted.flats:
        return None
    # Darks have the scatter of their pixels' means beside them, which pickup may set against their noise.
    for item in series_goodness(fitted)[len(fitted.darks) :]:
        excess, se = item.noise_excess or 0.0, item.noise_se or np.inf
        if abs(excess) > max(_MAX_DEPARTURE, _MIN_SIGMAS * se):
            return (
                f"the noise of the {item.series.conditions} is {excess:+.1%} off the model's in variance "
                f"({abs(excess) / se:.0f} standard errors); record it again or leave it out"
            )
    scatter = float(np.sqrt(fitted.moments.excess.variance2))
    if scatter > MAX_NOISE_ERROR:
        return (
            f"the noise of the series scatters by {scatter:.1%} in variance about the model (limit "
            f"{MAX_NOISE_ERROR:.0%}): the noise of the camera changed, or the response is not that of one sensor; "
            "record all series in one go"
        )
    return None


def light_estimates(
    fitted: SeriesFit, saturation: Saturation, gain: Estimate, efficiency: Estimate
) -> dict[str, Estimate]:
    """Return linearity error, saturation capacity and the scatter between series."""
    excess, quantile = fitted.moments.excess, float(stats.norm.ppf(0.975))
    flicker, light_error = lamp_flicker2(fitted.fit, fitted.moments), Estimate(float(np.sqrt(excess.light2)))
    return {
        "linearity_error": _linearity(fitted, saturation),
        "saturation_e": _capacity(fitted, saturation, gain, efficiency),
        "noise_error": Estimate(float(np.sqrt(excess.variance2))),
        "drift_dn": Estimate(float(np.sqrt(excess.drift_dn2))),
        "light_error": light_error if _knows_light(fitted) else Estimate(None, why=_NO_LIGHT),
        "lamp_flicker": root(*flicker, quantile) if flicker else Estimate(None, why="there are no flats"),
    }


def lamp_flicker2(fit: NoiseFit, moments: Moments) -> tuple[float, float] | None:
    """Return the relative variance of the light from frame to frame with its standard error; None without flats.

    It is what the levels of the frames of a series scatter beyond pixel noise and jitter of the black level. Neither
    enters the pixel noise, since levels are taken out of every frame.
    """
    flats = moments.flats
    if not flats.frames.size:
        return None
    noise = np.array(flat_variances_dn2(fit.values, flats.mean_dn), float) / moments.pixels
    still = fit.values.get("jitter_dn2", 0.0) + noise
    freedom, signal2 = flats.frames - 1, (flats.mean_dn - fit.values["offset_dn"]) ** 2
    total = float(freedom @ signal2)
    if not total > 0:
        return None
    variance = float(np.sum(flats.level_scatter_dn2 - freedom * still)) / total
    spread = np.sqrt(2 * float(freedom @ (still + max(variance, 0.0) * signal2) ** 2))
    return variance, float(spread) / total


def _knows_light(fitted: SeriesFit) -> bool:
    return bool(fitted.bend is not None and fitted.moments.flats.light.groups.size)


def _linearity(fitted: SeriesFit, saturation: Saturation) -> Estimate:
    """Return EMVA 1288's linearity error of the fitted response, over the levels that were used."""
    fit = fitted.bend
    if fit is None or not _knows_light(fitted):
        return Estimate(None, why=_NO_LIGHT if fitted.flats else "there are no flats")
    offset = fit.values["offset_dn"]
    dark = fit.values.get("dark_signal_dn_per_s", 0.0) * fitted.moments.flats.exposure_s
    signal = fitted.moments.flats.mean_dn - offset - dark
    full = float(signal.max()) if saturation.level_dn is None else saturation.level_dn - offset
    variance = np.array(level_variances_dn2(fit.values, fitted.moments), float)
    levels = FittedLevels(fitted.moments.flats.light, signal, variance, full)
    value = levels.linearity(fit.values)
    if value is None and levels.linearity({}) is not None:
        return Estimate(None, why=_POOR_RESPONSE)
    if value is None:
        return Estimate(None, why="fewer than 3 levels are within 5 to 95 % of saturation; record more light levels")
    names, covariance = list(fit.bend.values), fit.bend.covariance
    bends = np.array([*fit.bend.values.values()])

    def error_of(draw: Array) -> float | None:
        return levels.linearity(dict(zip(names, draw.tolist(), strict=True)))

    draws = np.random.default_rng(1288).multivariate_normal(bends, covariance, _DRAWS, method="svd")
    errors = np.array([error for error in map(error_of, draws) if error is not None])
    if errors.size < (1 - _MAX_IMPOSSIBLE) * _DRAWS:
        return Estimate(None, why=_POOR_RESPONSE)
    se = float(np.sqrt(np.mean((errors - value) ** 2)))
    gradient = dict.fromkeys(fit.values, 0.0)
    for name, direction, step in zip(names, np.eye(len(names)), 0.1 * np.sqrt(np.diag(covariance)), strict=True):
        low, high = (error_of(bends + sign * step * direction) or 0.0 for sign in (-1, 1))
        gradient[name] = (high - low) / max(2 * step, 1e-300)
    half = fit.quantile(np.array([*gradient.values()])) * se
    straight = stats.chi2.sf(float(bends @ np.linalg.pinv(covariance) @ bends), len(names)) > 0.05
    return Estimate(value, se, (0.0 if straight else max(value - half, 0.0), value + half))


def _capacity(fitted: SeriesFit, saturation: Saturation, gain: Estimate, efficiency: Estimate) -> Estimate:
    """Return the saturation capacity μ_e.sat in electrons.

    A full well takes its charge from the light of the series where it begins, as EMVA 1288 does; the response is not
    known as far as that.
    """
    if saturation.level_dn is None or saturation.interval_dn is None:
        return Estimate(None, why="no series of flats reaches saturation; record light levels up to it")
    if gain.value is None or gain.se is None:
        return Estimate(None, why=gain.why)
    if saturation.limit == "ADC":
        values, ends = fitted.fit.values, (saturation.level_dn, *saturation.interval_dn)
        charges = [float(charge_dn(values, level - values["offset_dn"])) / gain.value for level in ends]
        return _capacity_estimate(charges, 1.96 * gain.se / gain.value)
    flats = sorted(
        (*saturation.kept, *(flat for flat, _ in saturation.left_out)), key=lambda flat: flat.levels_dn.mean()
    )
    means = [float(flat.levels_dn.mean()) for flat in flats]
    at = int(np.argmin(np.abs(np.array(means) - saturation.level_dn)))
    photons = [flats[k].conditions.photons for k in (at, max(at - 1, 0), min(at + 1, len(flats) - 1))]
    if efficiency.value is None or efficiency.se is None or not all(photons):
        return Estimate(None, why="the charge of a full well follows from its photons, which are not stated")
    charges = [efficiency.value * float(number or 0.0) for number in photons]
    return _capacity_estimate(charges, 1.96 * efficiency.se / efficiency.value)


def _capacity_estimate(charges_e: list[float], relative: float) -> Estimate:
    """Return the first charge, with an interval from the second to the third, widened by a relative half width."""
    low, high = charges_e[1] * (1 - relative), charges_e[2] * (1 + relative)
    return Estimate(charges_e[0], (high - low) / 3.92, (low, high))


def quantum_efficiency(photons: Array, charge_e: Array, gain_relative_se: float) -> tuple[float, float]:
    """Return electrons per photon with the standard error, from the charges of flats (series,) and their photons.

    EMVA 1288's η = R/K is the slope of charge over photons through the origin. Its error is that of the gain and of the
    light's steadiness.
    """
    slope = float(charge_e @ photons / (photons @ photons))
    scatter = float(np.sum((charge_e - slope * photons) ** 2)) / max(photons.size - 1, 1) / float(photons @ photons)
    return slope, float(np.hypot(slope * gain_relative_se, np.sqrt(scatter)))
