"""Convert fitted parameters to EMVA 1288 quantities with intervals, or with the reason why there is no value.

A fit always returns numbers. A quantity has a value only if the frames determine it: gain and read noise if the gain is
known to 10 %, the dark current if its error does not matter in comparison with the noise.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

from faintfield.calib.estimate import NORMAL_QUANTILE, Estimate, SeriesGoodness, interval, root
from faintfield.calib.noise.emva.nonuniformity import nonuniformity, temporal_noise
from faintfield.calib.noise.flats import Saturation
from faintfield.calib.noise.likelihood.gaussian_fit import (
    NoiseFit,
    flat_variances_dn2,
    level_variances_dn2,
    main_quantities,
)
from faintfield.calib.noise.likelihood.moments import Moments
from faintfield.calib.noise.likelihood.response import charge_dn, fitted_linearity, quantum_efficiency
from faintfield.calib.noise.maps.photo_response import Response
from faintfield.calib.noise.sensor_fit import NoiseLikelihood, SeriesFit
from faintfield.calib.noise.strips import Array, map_of

# Largest relative standard error of the gain, without which no quantity in electrons has a value.
MAX_RELATIVE_SE = 0.1

# Read noise in DN below which the Gaussian cannot tell the noise from the rounding, unless the phases of the
# pixels average out; and the largest error that rounding may make of the noise of a series of darks with so little.
_MIN_ROUNDED_READ_DN, _MAX_ROUNDING_ERROR = 0.35, 0.05

# Largest scatter of the noise of series about the model, and largest departure of one, as fractions of the variance.
_MAX_NOISE_ERROR, _MAX_DEPARTURE, _MIN_SIGMAS = 0.05, 0.1, 6.0

# Draws of the response from its covariance for the error of the linearity error, and largest share of draws that no
# response can have.
_DRAWS, _MAX_IMPOSSIBLE = 200, 0.05

_FLATS_REMEDY = "record at least 2 flats at half of saturation, or darks long enough for tens of dark electrons"
_ONE_EXPOSURE = "all darks have one exposure; record darks of at least 2 exposures, better 4 up to 60 s"
_ONE_REPEATED = (
    "only one exposure has more than one dark, so that the growth of the noise cannot be seen; record at least 2 darks "
    "each of 2 exposures, better 10 each of 4 up to 60 s"
)
_NO_PHOTONS = "no flat states its photons per pixel (`photons` in noise.toml, or `photons_per_s` in rig.toml)"
_NO_FLATS = "there are no flats; record at least 2, evenly lit, at half of saturation"
_POOR_RESPONSE = (
    "the levels of the flats leave the response open, so that it might even fall; record more frames of each level, "
    "and the levels in one go"
)
_NO_LIGHT = (
    "the light of the flats is not known: state the photons of at least 3 light levels over a factor of 2, or record 3 "
    "exposures under one light"
)


def estimate_all(
    fitted: SeriesFit,
    response: Response | None,
    saturation: Saturation,
    goodness: Sequence[SeriesGoodness],
    *,
    levels_hold: bool,
    noise_holds: bool,
) -> tuple[dict[str, Estimate], tuple[tuple[str, ...], Array]]:
    """Return all quantities, and the covariance of offset, gain, read noise and dark current.

    There is no response to light without flats. `goodness` is that of each series; `levels_hold` if the dark levels lie
    on a straight line over exposure time, and `noise_holds` if the noise of all series follows eq. (1).
    """
    fit, moments = fitted.fit, fitted.moments
    levels_quantile = _levels_quantile(fit, moments)
    why_rounded = _why_rounded(fitted)
    holds = levels_hold and noise_holds
    why_no_gain = (
        why_rounded
        or _why_noise_denies(fitted, goodness)
        or _why_no_gain(fit, moments, from_darks=not fitted.flats, holds=holds)
    )
    whys = {"offset_dn": None, "gain_dn_per_e": why_no_gain, "read_noise_e": why_no_gain}
    whys["dark_current_e_per_s"] = _why_no_current(fit, moments, why_no_gain, levels_quantile, levels_hold=levels_hold)
    gain_quantile = NORMAL_QUANTILE if fitted.flats else levels_quantile
    estimates, covariance = _in_electrons(fit, whys, gain_quantile, levels_quantile)
    gain = estimates["gain_dn_per_e"]
    read_dn = float(np.exp(0.5 * fit.values["log_read_dn2"]))
    half, se = max(NORMAL_QUANTILE, fit.quantile_of("log_read_dn2")), 0.5 * read_dn * fit.standard_error("log_read_dn2")
    estimates["read_noise_dn"] = interval(read_dn, se, half, positive=True)
    estimates["dark_signal_dn_per_s"] = _parameter(fit, "dark_signal_dn_per_s", levels_quantile)
    estimates |= _spreads(fitted, gain)
    if why_rounded is not None:
        estimates |= dict.fromkeys(("read_noise_dn", "dsnu_dn"), Estimate(None, why=why_rounded))
    # The fixed patterns of rows and columns: EMVA 1288's DSNU.row and DSNU.col.
    dark, used = max(fitted.darks, key=lambda dark: dark.frames), fitted.used
    spreads = nonuniformity(map_of(dark.mean_of, used.shape, np.float64), used, temporal_noise(dark, used))
    estimates |= {"dsnu_row_dn": spreads.row, "dsnu_column_dn": spreads.column} | _shared_noise(fitted)
    estimates |= _from_flats(fitted, gain, response)
    excess, knows_light = moments.excess, fitted.bend is not None and bool(moments.light.groups.size)
    estimates |= {
        "linearity_error": _linearity(fitted.bend, moments, saturation)
        if fitted.bend is not None and knows_light
        else Estimate(None, why=_NO_LIGHT if fitted.flats else "there are no flats"),
        "saturation_e": _capacity(fitted, saturation, gain, estimates["quantum_efficiency"]),
        "noise_error": Estimate(float(np.sqrt(excess.variance2))),
        "drift_dn": Estimate(float(np.sqrt(excess.drift_dn2))),
        "light_error": Estimate(float(np.sqrt(excess.light2))) if knows_light else Estimate(None, why=_NO_LIGHT),
        "lamp_flicker": _lamp_flicker(fit, moments),
    }
    return estimates, covariance


def _in_electrons(
    fit: NoiseFit, whys: dict[str, str | None], gain_quantile: float, levels_quantile: float
) -> tuple[dict[str, Estimate], tuple[tuple[str, ...], Array]]:
    """Return the four main quantities, and the covariance of those without a reason against them."""
    quantities = main_quantities(fit.values)
    known = tuple(name for name, why in whys.items() if why is None)
    jacobian = np.array([[quantities[name][1].get(parameter, 0.0) for parameter in fit.values] for name in known])
    covariance = jacobian @ fit.covariance @ jacobian.T
    estimates = {name: Estimate(None, why=why) for name, why in whys.items()}
    for index, name in enumerate(known):
        se, positive = float(np.sqrt(covariance[index, index])), name in ("gain_dn_per_e", "read_noise_e")
        quantile = max(gain_quantile if positive else levels_quantile, fit.quantile(jacobian[index]))
        estimates[name] = interval(quantities[name][0], se, quantile, positive=positive)
    return estimates, (known, covariance)


def _levels_quantile(fit: NoiseFit, moments: Moments) -> float:
    """Return the quantile of Student's t if jitter between frames dominates, because few frames determine it."""
    pixel_part = float(np.exp(fit.values["log_read_dn2"])) / moments.pixels
    freedom = float((moments.darks.frames - 1).sum())
    if freedom >= 1 and fit.values.get("jitter_dn2", 0.0) > 0.5 * pixel_part:
        return float(stats.t.ppf(0.975, freedom))
    return NORMAL_QUANTILE


def _why_rounded(fitted: SeriesFit) -> str | None:
    read_dn, rounding2 = float(np.exp(0.5 * fitted.fit.values["log_read_dn2"])), fitted.moments.darks.rounding2
    shown = read_dn >= _MIN_ROUNDED_READ_DN or float(rounding2.max()) <= _MAX_ROUNDING_ERROR**2
    if shown or fitted.likelihood is not NoiseLikelihood.GAUSSIAN:
        return None
    return (
        f"the read noise is about {read_dn:.2g} DN (limit {_MIN_ROUNDED_READ_DN:g} DN), so little that rounding to "
        "whole DN hides it, and the level of the darks moves too much for the likelihood of whole values; record at a "
        "higher gain or with more bits, the camera settled"
    )


def _why_noise_denies(fitted: SeriesFit, goodness: Sequence[SeriesGoodness]) -> str | None:
    """Return why the noise of the series denies the model; only flats can, since pickup may move noise of darks."""
    if not fitted.flats:
        return None
    for flat, item in zip(fitted.flats, goodness[len(fitted.darks) :], strict=True):
        excess, se = item.noise_excess or 0.0, item.noise_se or np.inf
        if abs(excess) > max(_MAX_DEPARTURE, _MIN_SIGMAS * se):
            return (
                f"the noise of the {flat.conditions} is {excess:+.1%} off the model's in variance "
                f"({abs(excess) / se:.0f} standard errors); record it again or leave it out"
            )
    scatter = float(np.sqrt(fitted.moments.excess.variance2))
    if scatter > _MAX_NOISE_ERROR:
        return (
            f"the noise of the series scatters by {scatter:.1%} in variance about the model (limit "
            f"{_MAX_NOISE_ERROR:.0%}): the noise of the camera changed, or the response is not that of one sensor; "
            "record all series in one go"
        )
    return None


def _why_no_gain(fit: NoiseFit, moments: Moments, *, from_darks: bool, holds: bool) -> str | None:
    if "log_gain" not in fit.values:
        return f"{_why_no_growth(moments)}, or flats"
    relative = fit.standard_error("log_gain")
    if from_darks and not holds:
        return f"without flats it rests on the darks, which contradict the model (see the warnings); {_FLATS_REMEDY}"
    if not relative <= MAX_RELATIVE_SE:
        error = f"{relative:.0%}" if relative < 10 else "larger than itself"
        return (
            f"its standard error would be {error} (limit {MAX_RELATIVE_SE:.0%}): the darks hold too few dark "
            f"electrons to tell the gain from the read noise; {_FLATS_REMEDY}"
        )
    return None


def _why_no_growth(moments: Moments) -> str:
    return _ONE_EXPOSURE if np.unique(moments.darks.exposure_s).size < 2 else _ONE_REPEATED


def _why_no_current(
    fit: NoiseFit, moments: Moments, why_no_gain: str | None, quantile: float, *, levels_hold: bool
) -> str | None:
    if "dark_signal_dn_per_s" not in fit.values:
        return _ONE_EXPOSURE
    if why_no_gain is not None:
        return f"dark current in electrons needs the gain: {why_no_gain}"
    if not levels_hold:
        return "the dark levels are no straight line over exposure time; let the camera settle and record them again"
    signal, half_width = fit.values["dark_signal_dn_per_s"], quantile * fit.standard_error("dark_signal_dn_per_s")
    # Standard error of a normal distribution with the same interval: with few frames the formal one is too small.
    se = half_width / NORMAL_QUANTILE
    gain = float(np.exp(fit.values["log_gain"]))
    noise_e2 = float(np.exp(fit.values["log_read_dn2"])) / gain**2
    longest = float(moments.darks.exposure_s.max())
    if signal + half_width < 0:
        return (
            f"the dark level falls with exposure time ({signal:.2g} DN/s), which dark current cannot do: the black "
            "level drifted; record the exposures in turn, the camera settled"
        )
    if se > MAX_RELATIVE_SE * abs(signal) and se * longest / gain > MAX_RELATIVE_SE * noise_e2:
        rise = "" if signal > 0 else f"the dark level does not rise with exposure time ({signal:.2g} DN/s); "
        return (
            f"{rise}its standard error would be {se / gain:.2g} e-/s, which over {longest:g} s is more than a tenth of "
            "the read noise variance; record more darks of more and longer exposures, the camera settled"
        )
    return None


def _parameter(fit: NoiseFit, name: str, quantile: float) -> Estimate:
    if name not in fit.values:
        return Estimate(None, why=_ONE_EXPOSURE)
    return interval(fit.values[name], fit.standard_error(name), max(quantile, fit.quantile_of(name)))


def _spreads(fitted: SeriesFit, gain: Estimate) -> dict[str, Estimate]:
    fit = fitted.fit
    dsnu2, se, dcnu2 = fit.values["dsnu_dn2"], fit.standard_error("dsnu_dn2"), fit.values.get("dcnu_dn2_per_s2")
    if gain.value is None:
        return {"dsnu_dn": root(dsnu2, se)} | dict.fromkeys(("dsnu_e", "dcnu_e_per_s"), Estimate(None, why=gain.why))
    dcnu = Estimate(None, why=_why_no_growth(fitted.moments))
    if dcnu2 is not None:
        dcnu = root(dcnu2, fit.standard_error("dcnu_dn2_per_s2"), 1 / gain.value)
    return {"dsnu_dn": root(dsnu2, se), "dsnu_e": root(dsnu2, se, 1 / gain.value), "dcnu_e_per_s": dcnu}


def _shared_noise(fitted: SeriesFit) -> dict[str, Estimate]:
    fit, darks = fitted.fit, fitted.darks
    if "jitter_dn2" not in fit.values:
        unknown = Estimate(None, why="the likelihood of single values has no part for it; it needs Gaussian darks")
        return dict.fromkeys(("frame_jitter_dn", "row_noise_dn", "column_noise_dn"), unknown)
    rows, columns = darks[0].pattern_dn.shape
    noise, freedom = np.array(fitted.dark_noise_dn2), fitted.moments.darks.frames - 1

    def shared(variances: Sequence[float], along: int, across: int) -> Estimate:
        # The level of a frame is subtracted from its lines, and takes one degree of freedom of them
        variance = np.array(variances) * across / (across - 1)
        excess = float(np.average(variance - noise / along, weights=freedom))
        se = float(np.average(variance, weights=freedom) * np.sqrt(2 / (freedom.sum() * (across - 1))))
        return root(excess, se)

    # A jitter fitted as zero has no standard error: use the scatter of the levels that is expected without jitter.
    chance = float(np.average(noise, weights=freedom) / fitted.moments.pixels * np.sqrt(2 / freedom.sum()))
    return {
        "frame_jitter_dn": root(fit.values["jitter_dn2"], fit.standard_error("jitter_dn2") or chance),
        "row_noise_dn": shared([dark.row_noise_dn2 for dark in darks], columns, rows),
        "column_noise_dn": shared([dark.column_noise_dn2 for dark in darks], rows, columns),
    }


def _from_flats(fitted: SeriesFit, gain: Estimate, response: Response | None) -> dict[str, Estimate]:
    nonlinearity = Estimate(None, why="flats of at least 3 light levels are needed")
    if fitted.bend is not None:
        nonlinearity = _parameter(fitted.bend, "nonlinearity_per_dn", NORMAL_QUANTILE)
    efficiency = Estimate(None, why=gain.why if fitted.flats and gain.value is None else _NO_PHOTONS)
    photons = [flat.conditions.photons for flat in fitted.flats]
    odd = {index for index, _ in fitted.moments.light.odd}
    usable = [index for index, number in enumerate(photons) if number and index not in odd]
    if gain.value is not None and usable:
        values, means = fitted.fit.values, fitted.moments.flats.mean_dn
        dark_dn = values.get("dark_signal_dn_per_s", 0.0) * fitted.moments.flats.exposure_s
        charges_e = (charge_dn(values, means - values["offset_dn"]) - dark_dn) / np.exp(values["log_gain"])
        pairs = np.stack([np.array(photons, float), charges_e], axis=1)[usable]
        slope = quantum_efficiency(pairs[:, 0], pairs[:, 1], fitted.fit.standard_error("log_gain"))
        efficiency = interval(*slope, positive=True)
    prnu = Estimate(None, why=_NO_FLATS) if response is None else response.prnu_estimate()
    return {"prnu": prnu, "nonlinearity_per_dn": nonlinearity, "quantum_efficiency": efficiency}


def _lamp_flicker(fit: NoiseFit, moments: Moments) -> Estimate:
    """Return the relative scatter of the light from frame to frame.

    It is what the levels of the frames of a series scatter beyond pixel noise and jitter of the black level. Neither
    enters the pixel noise, since levels are taken out of every frame.
    """
    flats = moments.flats
    noise = np.array(flat_variances_dn2(fit.values, flats.mean_dn), float) / moments.pixels
    still = fit.values.get("jitter_dn2", 0.0) + noise
    freedom, signal2 = flats.frames - 1, (flats.mean_dn - fit.values["offset_dn"]) ** 2
    total = float(freedom @ signal2)
    if not total > 0:
        return Estimate(None, why="there are no flats")
    variance = float(np.sum(flats.level_scatter_dn2 - freedom * still)) / total
    spread = np.sqrt(2 * float(freedom @ (still + max(variance, 0.0) * signal2) ** 2))
    return root(variance, float(spread) / total)


def _linearity(fit: NoiseFit, moments: Moments, saturation: Saturation) -> Estimate:
    """Return EMVA 1288's linearity error of the fitted response, over the levels that were used."""
    offset = fit.values["offset_dn"]
    dark = fit.values.get("dark_signal_dn_per_s", 0.0) * moments.flats.exposure_s
    signal = moments.flats.mean_dn - offset - dark
    full = float(signal.max()) if saturation.level_dn is None else saturation.level_dn - offset
    variance = np.array(level_variances_dn2(fit.values, moments), float)

    def error_of(values: Mapping[str, float]) -> float | None:
        return fitted_linearity(values, moments.light, signal, variance, full)

    value = error_of(fit.values)
    if value is None and error_of({}) is not None:
        return Estimate(None, why=_POOR_RESPONSE)
    if value is None:
        end = "the brightest level, saturation not being reached" if saturation.level_dn is None else "saturation"
        return Estimate(None, why=f"fewer than 3 levels are within 5 to 95 % of {end}; record more light levels")
    names, covariance = list(fit.bend.values), fit.bend.covariance
    bends = np.array([*fit.bend.values.values()])
    draws = np.random.default_rng(1288).multivariate_normal(bends, covariance, _DRAWS, method="svd")
    drawn = (error_of(dict(zip(names, draw.tolist(), strict=True))) for draw in draws)
    errors = np.array([error for error in drawn if error is not None])
    if errors.size < (1 - _MAX_IMPOSSIBLE) * _DRAWS:
        return Estimate(None, why=_POOR_RESPONSE)
    se = float(np.sqrt(np.mean((errors - value) ** 2)))
    gradient = dict.fromkeys(fit.values, 0.0)
    for name, step in zip(names, (0.1 * np.sqrt(np.diag(covariance))).tolist(), strict=True):
        ends = (fit.bend.values | {name: fit.values[name] + sign * step} for sign in (-1, 1))
        low, high = (error_of(end) or 0.0 for end in ends)
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
        relative = 1.96 * gain.se / gain.value
    else:
        unused = (flat for flat, _ in saturation.left_out)
        flats = sorted((*saturation.kept, *unused), key=lambda flat: flat.levels_dn.mean())
        means = [float(flat.levels_dn.mean()) for flat in flats]
        at = int(np.argmin(np.abs(np.array(means) - saturation.level_dn)))
        photons = [flats[k].conditions.photons for k in (at, max(at - 1, 0), min(at + 1, len(flats) - 1))]
        if efficiency.value is None or efficiency.se is None or not all(photons):
            return Estimate(None, why="the charge of a full well follows from its photons, which are not stated")
        charges = [efficiency.value * float(number or 0.0) for number in photons]
        relative = 1.96 * efficiency.se / efficiency.value
    low, high = charges[1] * (1 - relative), charges[2] * (1 + relative)
    return Estimate(charges[0], (high - low) / 3.92, (low, high))
