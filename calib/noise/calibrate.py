"""Calibrate one plane: from series of darks and flats to numbers, maps and warnings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.signal import fftconvolve

from faintfield.calib.errors import CopiedFrame, NotIdentifiable, TooFewFrames
from faintfield.calib.estimate import Estimate, SeriesGoodness
from faintfield.calib.noise.emva.conversion import estimate_all
from faintfield.calib.noise.flats import Saturation, check_flat_levels, find_saturation
from faintfield.calib.noise.likelihood.marginal import Counts, mass_function
from faintfield.calib.noise.maps.defects import hot_pixels, outlying_pixels, variance_ratio
from faintfield.calib.noise.maps.measure import NoiseMaps, Pixels, measure_pixels, noise_maps
from faintfield.calib.noise.misfit import (
    TransferPoint,
    frame_warnings,
    goodness_of,
    level_warning,
    noise_warning,
    scatter_warnings,
    series_goodness,
    transfer_points,
)
from faintfield.calib.noise.sensor_fit import MAX_TABLE_WIDTH_DN, NoiseLikelihood, SeriesFit, collect_counts, fit_series
from faintfield.calib.noise.series import Series
from faintfield.calib.noise.strips import Array, Mask
from faintfield.calib.noise.temperature import settle_temperature, with_doubling_error
from faintfield.calib.noise_model import BentResponse, Map, NoiseModel

# Quantities without which there is no noise model.
_REQUIRED = ("offset_dn", "gain_dn_per_e", "read_noise_e")

# Smallest frames, in pixels and in rows or columns; fewer leave the spreads over pixels to chance.
_MIN_PIXELS, _MIN_SIDE_PX = 256, 8

# Mean charge in electrons above which the normal law replaces the Poisson sum: as good there, and smaller in memory.
_MAX_POISSON_CHARGE_E = 200.0

# A response counts as straight if a bend as large as the fitted one comes about by chance with this probability.
_MAX_STRAIGHT = 1e-3


@dataclass(frozen=True)
class Histogram:
    """Values of the dark series of one exposure, from the lowest to the highest.

    Attributes
    ----------
    exposure_s : float
        Exposure time.
    value_dn : int array (value,)
        The values.
    count, expected : int array (value,), float array (value,)
        How often each value occurs among the sampled pixels and frames, and how often the fit expects it.
    """

    exposure_s: float
    value_dn: NDArray[np.int64]
    count: NDArray[np.int64]
    expected: Array


@dataclass(frozen=True)
class NoiseCalibration:
    """Result of `calib.noise.calibrate`.

    Attributes
    ----------
    estimates : dict of Estimate
        `offset_dn, gain_dn_per_e, read_noise_e, read_noise_dn, dark_current_e_per_s, dark_signal_dn_per_s, dsnu_e,
        dsnu_dn, dsnu_row_dn, dsnu_column_dn, dcnu_e_per_s, frame_jitter_dn, row_noise_dn, column_noise_dn, prnu,
        quantum_efficiency, nonlinearity_per_dn, linearity_error, saturation_e, noise_error, drift_dn, light_error,
        lamp_flicker`.
    covariance : tuple (names, array)
        Covariance of those of offset, gain, read noise and dark current that have values.
    likelihood : str
        Name of the likelihood that was used.
    maps : NoiseMaps
        Maps per pixel.
    pixels : Pixels
        Measurements of the pixels, with the masks of unusable ones.
    points, goodness : tuple of TransferPoint, tuple of SeriesGoodness
        Photon transfer and dark signal of each series that was used; goodness of fit of all.
    histograms : tuple of Histogram
        Values of the shortest and the longest darks with their prediction; empty if the gain is unknown.
    saturation_dn : float
        Value from which a pixel is saturated, as stated or found.
    saturation : Saturation
        Saturation of the flats, and those that are left out.
    response : BentResponse, optional
        Bend of the response where the flats show one.
    warnings : tuple of str
        Problems of the frames.
    """

    estimates: dict[str, Estimate]
    covariance: tuple[tuple[str, ...], Array]
    likelihood: str
    maps: NoiseMaps
    pixels: Pixels
    points: tuple[TransferPoint, ...]
    histograms: tuple[Histogram, ...]
    saturation_dn: float
    saturation: Saturation
    response: BentResponse | None
    goodness: tuple[SeriesGoodness, ...]
    warnings: tuple[str, ...]

    def noise_model(self, *, per_pixel: bool = True) -> NoiseModel:
        """Return the noise model for a reconstruction, per pixel or as single numbers.

        The gain does not include the photo response, which belongs to the light: see `maps.relative_response`.

        Raises
        ------
        NotIdentifiable
            Offset, gain or read noise has no value.
        """
        values = {name: self.estimates[name].value for name in (*_REQUIRED, "dark_current_e_per_s")}
        for name in _REQUIRED:
            if values[name] is None:
                raise NotIdentifiable(f"{name}: no value: {self.estimates[name].why}")
        efficiency = self.estimates["quantum_efficiency"].value
        fields: dict[str, Map] = {name: value or 0.0 for name, value in values.items()}
        fields["dark_current_e_per_s"] = max(values["dark_current_e_per_s"] or 0.0, 0.0)
        if per_pixel:
            maps = {name: getattr(self.maps, name) for name in fields}
            fields |= {name: values for name, values in maps.items() if values is not None}
        return NoiseModel(
            **fields,
            quantum_efficiency=None if efficiency is None else min(efficiency, 1.0),
            saturation_dn=self.saturation_dn,
            response=self.response,
        )


def calibrate(series: Sequence[Series], saturation_dn: float = np.inf) -> NoiseCalibration:
    """Measure the noise of a sensor, or of one of its colour phases, from dark and flat frames.

    The model is `dn = offset + gain · ( Poisson(light + dark current · t) + N(0, read noise²) )`
    (docs/explanation/noise.md).

    Parameters
    ----------
    series : sequence of Series
        Darks of at least one exposure, and possibly flats, all of one size.
    saturation_dn : float
        Value from which a pixel is saturated; part of the result.

    Returns
    -------
    NoiseCalibration
        `estimates` by name, each with its standard error or the reason why it has no value; `maps` per pixel;
        `warnings`. Its `noise_model()` is what a reconstruction needs.

    Raises
    ------
    NotIdentifiable
        There is no dark.
    TooFewFrames
        No exposure has two frames, a light level has one, or the frames are too small.
    BadFrame
        The frames of one series of flats are of different light.
    CopiedFrame
        Two frames are identical.
    SaturatedFlat
        There are flats, and all of them are saturated.
    PoorFit
        The likelihood has no maximum.

    Examples
    --------
    A sensor with a gain of 2 DN/e, read noise of 3.5 e and a dark current of 5 e/s, from darks alone:

    >>> import numpy as np
    >>> from faintfield import Conditions, calibrate_noise, measure_series
    >>> rng, series = np.random.default_rng(1), []
    >>> for exposure_s in (0.1, 10.0, 60.0):
    ...     electrons = rng.poisson(5.0 * exposure_s, (12, 64, 64)) + rng.normal(0.0, 3.5, (12, 64, 64))
    ...     pixels_dn = np.round(100.0 + 2.0 * electrons).astype(np.uint16)
    ...     frames = ((f"dark {number}", frame) for number, frame in enumerate(pixels_dn))
    ...     series.append(measure_series(frames, Conditions("dark", exposure_s)))
    >>> estimates = calibrate_noise(series).estimates
    >>> [round(estimates[name].value, 1) for name in ("gain_dn_per_e", "read_noise_e", "dark_current_e_per_s")]
    [2.0, 3.5, 5.0]
    """
    series, warmth = settle_temperature(series)
    darks = [item for item in series if item.conditions.kind == "dark"]
    flats = [item for item in series if item.conditions.kind == "flat"]
    _check_series(darks, [])
    check_flat_levels(darks, flats)
    saturation = find_saturation(darks, flats, saturation_dn)
    # Frames that are saturated all over are identical, which is no fault of theirs.
    _check_series(darks, saturation.kept)
    hot = hot_pixels(darks)
    end_dn = saturation_dn if saturation.level_dn is None else saturation.level_dn
    fitted, outlying = fit_series(darks, saturation.kept, ~hot, end_dn), np.zeros_like(hot)
    if fitted.likelihood is not NoiseLikelihood.CENSORED:  # variances of values that are cut off tell nothing
        outlying = outlying_pixels(*variance_ratio(darks, fitted.dark_noise_dn2)) & ~hot
    if outlying.any():
        fitted = fit_series(darks, saturation.kept, ~hot & ~outlying, end_dn)
    fitted = replace(fitted, fit=with_doubling_error(fitted.fit, fitted.moments, darks, warmth))
    pixels, points = measure_pixels(fitted, hot, outlying), transfer_points(fitted)
    level, noise = level_warning(fitted), noise_warning(fitted, points)
    goodness = series_goodness(fitted)
    estimates, covariance = estimate_all(
        fitted, pixels.response, saturation, goodness, levels_hold=level is None, noise_holds=noise is None
    )
    return NoiseCalibration(
        estimates=estimates,
        covariance=covariance,
        likelihood=fitted.likelihood,
        maps=noise_maps(fitted, estimates, pixels),
        pixels=pixels,
        points=points,
        histograms=_histograms(fitted, ~hot & ~outlying),
        saturation_dn=end_dn,
        saturation=saturation,
        response=_bent_response(fitted),
        goodness=(
            *goodness,
            *(goodness_of(flat, left_out=why) for flat, why in saturation.left_out),
        ),
        warnings=(
            *warmth.warnings,
            *frame_warnings(fitted, saturation),
            *filter(None, (level, noise)),
            *scatter_warnings(fitted),
            *pixels.warnings(),
        ),
    )


def _check_series(darks: Sequence[Series], flats: Sequence[Series]) -> None:
    if not darks:
        raise NotIdentifiable("no dark frames: the offset cannot be told from the light; record darks, lens covered")
    frames: dict[bytes, str] = {}
    for item in (*darks, *flats):
        for digest, name in zip(item.digests, item.names, strict=True):
            if digest in frames:
                raise CopiedFrame(
                    f"{name} and {frames[digest]}: the same frame twice, pixel for pixel; noise never repeats: record "
                    "it again, or leave one out"
                )
            frames[digest] = name
    if all(dark.frames < 2 for dark in darks):
        raise TooFewFrames(
            f"{darks[0].names[0]}: the only one of the {darks[0].conditions}, and no exposure has two dark frames, so "
            "that noise and pattern cannot be told apart; record at least 2 of one exposure, better 10 of each"
        )
    if lone := next((flat for flat in flats if flat.frames < 2), None):
        raise TooFewFrames(
            f"{lone.names[0]}: the only one of the {lone.conditions}; photon transfer needs 2 frames at least of each "
            "light level: record another or leave it out"
        )
    pixels = darks[0].pattern_dn.size
    if pixels < _MIN_PIXELS or min(darks[0].pattern_dn.shape) < _MIN_SIDE_PX:
        raise TooFewFrames(
            f"frames of {pixels} pixels, limits {_MIN_PIXELS} pixels and {_MIN_SIDE_PX} rows and columns; "
            "record larger frames, or widen the region"
        )


def _bent_response(fitted: SeriesFit) -> BentResponse | None:
    """Return the bend of the response if the flats show it significantly, None otherwise."""
    bend = fitted.fit.bend
    if fitted.bend is None or fitted.bend.values.keys() != fitted.fit.values.keys() or not bend.values:
        return None
    bends = np.array([*bend.values.values()])
    brightest = float(fitted.moments.flats.mean_dn.max() - fitted.fit.values["offset_dn"])
    scale = brightest ** np.arange(1, bends.size + 1)
    covariance = bend.covariance * np.outer(scale, scale)
    deviance = float(bends * scale @ np.linalg.solve(covariance, bends * scale))
    if stats.chi2.sf(deviance, bends.size) > _MAX_STRAIGHT:
        return None
    return BentResponse(tuple(bends.tolist()), brightest)


def _histograms(fitted: SeriesFit, usable: Mask) -> tuple[Histogram, ...]:
    if "log_gain" not in fitted.fit.values:
        return ()
    counts = collect_counts(fitted.darks, usable)
    ends = sorted({int(np.argmin(counts.exposure_s)), int(np.argmax(counts.exposure_s))})
    places = [j for j in ends if np.ptp(counts.values_dn[j]) < MAX_TABLE_WIDTH_DN]
    return tuple(_histogram(counts, j, fitted) for j in places)


def _histogram(counts: Counts, index: int, fitted: SeriesFit) -> Histogram:
    """Return the values of one dark series, and those that the fit predicts."""
    fit, values_dn, exposure_s = fitted.fit.values, counts.values_dn[index], counts.exposure_s[index]
    log_gain, signal = fit["log_gain"], fit.get("dark_signal_dn_per_s", 0.0)
    # The level about which values scatter differs between pixels, rows, columns and frames.
    pattern_dn2 = (
        fit["dsnu_dn2"]
        + fit.get("jitter_dn2", 0.0)
        + float(fitted.darks[0].row_dn.var() + fitted.darks[0].column_dn.var())
    )
    pattern_dn2 += fit.get("dcnu_dn2_per_s2", 0.0) * exposure_s**2
    spread_dn = float(np.sqrt(max(pattern_dn2, 1e-4)))
    per_dn = max(2, int(np.ceil(2 / spread_dn)))
    reach = int(np.ceil(5 * spread_dn))
    offset = np.arange(-reach * per_dn, reach * per_dn + 1) / per_dn
    prior = np.exp(-0.5 * (offset / spread_dn) ** 2)
    prior /= prior.sum()
    stated_s, lowest, highest = fitted.darks[index].conditions.exposure_s, int(values_dn.min()), int(values_dn.max())
    # A black level that drifts down moves the values but makes no charge; see `dark_variances_dn2`.
    level_dn = fit["offset_dn"] + min(signal, 0.0) * exposure_s
    u = lowest - reach + np.arange((highest - lowest + 2 * reach) * per_dn + 1) / per_dn - level_dn
    slope = max(signal, 1e-9)
    charge = float(slope / np.exp(log_gain)) * exposure_s
    masses = mass_function(u, exposure_s, charge, exact=charge < _MAX_POISSON_CHARGE_E, spread=False)
    logs, _ = masses(np.array([log_gain, 0.5 * fit["log_read_dn2"] - log_gain, np.log(slope) - log_gain, 0.0]))
    mass, tail = (fftconvolve(np.exp(log), prior, "valid")[::per_dn] for log in logs[:, :, 0])
    if counts.floor_dn == lowest:
        mass[0] = tail[0]
    count = np.bincount((values_dn - lowest).ravel())
    return Histogram(stated_s, np.arange(lowest, highest + 1), count, np.maximum(mass, 0) * values_dn.size)
