"""Convert fitted parameters to EMVA 1288 quantities with intervals, or with the reason why there is no value.

A fit always returns numbers. A quantity has a value only if the frames determine it: gain and read noise if the gain is
known to 10 %, the dark current if its error does not matter in comparison with the noise.
"""

from collections.abc import Sequence

import numpy as np
from scipy import stats

from faintfield.calib.estimate import Estimate, interval, root
from faintfield.calib.noise.emva.light_estimates import light_estimates, quantum_efficiency, why_noise_denies
from faintfield.calib.noise.emva.nonuniformity import nonuniformity, temporal_noise
from faintfield.calib.noise.fit.series_fit import NoiseLikelihood, SeriesFit
from faintfield.calib.noise.likelihood.gaussian import dark_variances_dn2, main_quantities
from faintfield.calib.noise.likelihood.maximum import NoiseFit
from faintfield.calib.noise.likelihood.moments import Moments
from faintfield.calib.noise.likelihood.response import charge_dn
from faintfield.calib.noise.maps.photo_response import Response
from faintfield.calib.noise.series.flats import Saturation
from faintfield.calib.noise.strips import Array, map_of

# Largest relative standard error of the gain, without which no quantity in electrons has a value.
MAX_RELATIVE_SE = 0.1

# Read noise in DN below which the Gaussian cannot tell the noise from the rounding, unless the phases of the
# pixels average out.
_MIN_ROUNDED_READ_DN = 0.35

# Largest error that rounding may make of the noise of a series of darks with so little read noise.
_MAX_ROUNDING_ERROR = 0.05

_FLATS_REMEDY = "record at least 2 flats at half of saturation, or darks long enough for tens of dark electrons"
_ONE_EXPOSURE = "all darks have one exposure; record darks of at least 2 exposures, better 4 up to 60 s"
_ONE_REPEATED = (
    "only one exposure has more than one dark, so that the growth of the noise cannot be seen; record at least 2 darks "
    "each of 2 exposures, better 10 each of 4 up to 60 s"
)
_NO_PHOTONS = "no flat states its photons per pixel (`photons` in noise.toml, or `photons_per_s` in rig.toml)"
_NO_FLATS = "there are no flats; record at least 2, evenly lit, at half of saturation"


def estimate_all(
    fitted: SeriesFit, response: Response | None, saturation: Saturation, *, levels_hold: bool, noise_holds: bool
) -> tuple[dict[str, Estimate], tuple[tuple[str, ...], Array]]:
    """Return all quantities, and the covariance of offset, gain, read noise and dark current.

    Parameters
    ----------
    fitted : SeriesFit
        Fit and series.
    response : Response, optional
        Photo response; None without flats.
    saturation : Saturation
        Saturation of the sensor.
    levels_hold, noise_holds : bool
        The dark levels lie on a straight line over exposure time; the noise of all series follows eq. (1).
    """
    fit, moments = fitted.fit, fitted.moments
    quantile, levels_quantile = float(stats.norm.ppf(0.975)), _levels_quantile(fit, moments)
    why_rounded = _why_rounded(fitted)
    holds = levels_hold and noise_holds
    why_no_gain = (
        why_rounded or why_noise_denies(fitted) or _why_no_gain(fit, moments, from_darks=not fitted.flats, holds=holds)
    )
    whys = {"offset_dn": None, "gain_dn_per_e": why_no_gain, "read_noise_e": why_no_gain}
    whys["dark_current_e_per_s"] = _why_no_current(fit, moments, why_no_gain, levels_quantile, levels_hold=levels_hold)
    estimates, covariance = _in_electrons(fit, whys, quantile if fitted.flats else levels_quantile, levels_quantile)
    gain = estimates["gain_dn_per_e"]
    estimates |= _in_dn(fit, quantile, levels_quantile) | _spreads(fitted, gain, quantile)
    if why_rounded is not None:
        estimates |= dict.fromkeys(("read_noise_dn", "dsnu_dn"), Estimate(None, why=why_rounded))
    # The fixed patterns of rows and columns: EMVA 1288's DSNU.row and DSNU.col.
    dark, used = max(fitted.darks, key=lambda dark: dark.frames), fitted.used
    spreads = nonuniformity(map_of(dark.mean_of, used.shape, np.float64), used, temporal_noise(dark, used))
    estimates |= {"dsnu_row_dn": spreads.row, "dsnu_column_dn": spreads.column}
    estimates |= _shared_noise(fitted, quantile) | _from_flats(fitted, gain, response, quantile)
    return estimates | light_estimates(fitted, saturation, gain, estimates["quantum_efficiency"]), covariance


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
    """Return the half width of a 95 % interval, in standard errors, of a quantity that follows from the dark levels.

    The quantile is that of Student's t if jitter between frames dominates, because few frames determine it.
    """
    pixel_part = float(np.exp(fit.values["log_read_dn2"])) / moments.pixels
    freedom = float((moments.darks.frames - 1).sum())
    if freedom >= 1 and fit.values.get("jitter_dn2", 0.0) > 0.5 * pixel_part:
        return float(stats.t.ppf(0.975, freedom))
    return float(stats.norm.ppf(0.975))


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
    se = half_width / float(stats.norm.ppf(0.975))
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


def _in_dn(fit: NoiseFit, quantile: float, levels_quantile: float) -> dict[str, Estimate]:
    read_dn = float(np.exp(0.5 * fit.values["log_read_dn2"]))
    half, se = max(quantile, fit.quantile_of("log_read_dn2")), 0.5 * read_dn * fit.standard_error("log_read_dn2")
    signal = Estimate(None, why=_ONE_EXPOSURE)
    if "dark_signal_dn_per_s" in fit.values:
        signal = _parameter(fit, "dark_signal_dn_per_s", levels_quantile)
    return {"read_noise_dn": interval(read_dn, se, half, positive=True), "dark_signal_dn_per_s": signal}


def _parameter(fit: NoiseFit, name: str, quantile: float) -> Estimate:
    return interval(fit.values[name], fit.standard_error(name), max(quantile, fit.quantile_of(name)))


def _spreads(fitted: SeriesFit, gain: Estimate, quantile: float) -> dict[str, Estimate]:
    fit = fitted.fit
    dsnu2, se = fit.values["dsnu_dn2"], fit.standard_error("dsnu_dn2")
    spreads = {"dsnu_dn": root(dsnu2, se, quantile)}
    if gain.value is None:
        return spreads | dict.fromkeys(("dsnu_e", "dcnu_e_per_s"), Estimate(None, why=gain.why))
    spreads["dsnu_e"] = root(dsnu2, se, quantile, 1 / gain.value)
    spreads["dcnu_e_per_s"] = Estimate(None, why=_why_no_growth(fitted.moments))
    if (dcnu2 := fit.values.get("dcnu_dn2_per_s2")) is not None:
        spreads["dcnu_e_per_s"] = root(dcnu2, fit.standard_error("dcnu_dn2_per_s2"), quantile, 1 / gain.value)
    return spreads


def _shared_noise(fitted: SeriesFit, quantile: float) -> dict[str, Estimate]:
    fit, darks, pixels = fitted.fit, fitted.darks, fitted.moments.pixels
    if "jitter_dn2" not in fit.values:
        unknown = Estimate(None, why="the likelihood of single values has no part for it; it needs Gaussian darks")
        return dict.fromkeys(("frame_jitter_dn", "row_noise_dn", "column_noise_dn"), unknown)
    rows, columns = darks[0].pattern_dn.shape
    noise = np.array(dark_variances_dn2(fit.values, np.array([dark.conditions.dark_time_s for dark in darks])))
    freedom = np.array([dark.frames - 1.0 for dark in darks])

    def shared(variances: Sequence[float], along: int, across: int) -> Estimate:
        excess = float(np.average(np.array(variances) - noise / along, weights=freedom))
        se = float(np.average(variances, weights=freedom) * np.sqrt(2 / (freedom.sum() * across)))
        return root(excess, se, quantile)

    # A jitter fitted as zero has no standard error: use the scatter of the levels that is expected without jitter.
    chance = float(np.average(noise, weights=freedom) / pixels * np.sqrt(2 / freedom.sum()))
    jitter_se = fit.standard_error("jitter_dn2") or chance
    return {
        "frame_jitter_dn": root(fit.values["jitter_dn2"], jitter_se, quantile),
        "row_noise_dn": shared([dark.row_noise_dn2 for dark in darks], columns, rows),
        "column_noise_dn": shared([dark.column_noise_dn2 for dark in darks], rows, columns),
    }


def _from_flats(fitted: SeriesFit, gain: Estimate, response: Response | None, quantile: float) -> dict[str, Estimate]:
    prnu = Estimate(None, why=_NO_FLATS) if response is None else response.prnu_estimate(quantile)
    nonlinearity = Estimate(None, why="flats of at least 3 light levels are needed")
    if fitted.bend is not None:
        nonlinearity = _parameter(fitted.bend, "nonlinearity_per_dn", quantile)
    efficiency = Estimate(None, why=_NO_PHOTONS)
    if gain.value is not None:
        values, light = fitted.fit.values, fitted.moments.flats.light
        pairs = []
        for index, flat in enumerate(fitted.flats):
            charge = charge_dn(values, fitted.moments.flats.mean_dn[index] - values["offset_dn"])
            dark_dn = values.get("dark_signal_dn_per_s", 0.0) * flat.conditions.dark_time_s
            if flat.conditions.photons and index not in {odd for odd, _ in light.odd}:
                pairs.append((flat.conditions.photons, float((charge - dark_dn) / np.exp(values["log_gain"]))))
        if pairs:
            photons, charges_e = np.array(pairs).T
            slope = quantum_efficiency(photons, charges_e, fitted.fit.standard_error("log_gain"))
            efficiency = interval(*slope, quantile, positive=True)
    elif fitted.flats:
        efficiency = Estimate(None, why=gain.why)
    return {"prnu": prnu, "nonlinearity_per_dn": nonlinearity, "quantum_efficiency": efficiency}
