"""Maps of the pixels in the order in which they are measured: noise, offset and dark signal, response to light, gain.

Offset and dark signal are posterior means. The mean of ten frames of a pixel is off by 1.1 e⁻ rms at 12 (e⁻)² of read
noise: as much as the signal to be reconstructed. So offset and dark signal of pixel i get the priors N(μ, s²) and
N(d, q²), whose spreads the fit has measured; the means m_ij of the series measure `o_i + d_i t_j` with variance
v_ij/n_j, v_ij the noise of the pixel itself. Since both are Gaussian, the posterior mean is linear in the means, with a
2 × 2 matrix (Gelman et al., Bayesian Data Analysis, 3rd ed., §5.4). What rows and columns share is part of μ.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.estimate import Estimate
from faintfield.calib.noise.likelihood.response import charge_dn, charge_slope
from faintfield.calib.noise.likelihood.rounding import ROUNDING_DN2
from faintfield.calib.noise.maps.defects import noisy_pixels, telegraph_pixels, variance_ratio
from faintfield.calib.noise.maps.gain import PixelGain, gain_of_regions, measure_gain, photon_transfer
from faintfield.calib.noise.maps.photo_response import Response, SignalNoise, measure_response
from faintfield.calib.noise.maps.read_noise_map import PixelReadNoise, measure_read_noise
from faintfield.calib.noise.maps.seams import Seam, find_seams
from faintfield.calib.noise.sensor_fit import NoiseLikelihood, SeriesFit
from faintfield.calib.noise.series import Series
from faintfield.calib.noise.strips import Array, Map, Mask, map_of, maps_of, mean_over, new_map, total_of

# A step of the offsets is named from this fraction of the read noise, telegraph pixels from this share of all.
_NOTABLE_STEP, _NOTABLE_SHARE = 0.1, 1e-4

# Least variance of offset and dark signal, which stands for spreads that are zero or were not fitted.
_MIN_SPREAD_DN2 = 1e-6, 1e-12

_CENSORED = NoiseLikelihood.CENSORED


@dataclass(frozen=True)
class NoiseMaps:
    """Maps per pixel, arrays (row, column) of float32; None if the frames do not determine them.

    Attributes
    ----------
    offset_dn, offset_variance_dn2 : array
        Posterior mean of the offset, and the variance of its error.
    dark_current_e_per_s, dark_current_variance_e2_per_s2 : array, optional
        Posterior mean of the dark current, and the variance of its error.
    read_noise_e, read_noise_se_e : array, optional
        Posterior mean of the read noise, and its standard error.
    gain_dn_per_e, gain_se_dn_per_e : array, optional
        Gain, and the standard error of its difference from the mean gain. Maps in electrons are in those of this gain.
    relative_response, relative_response_se : array, optional
        Photo response in electrons over its mean, vignetting and PRNU, and its standard error.
    vignetting : array, optional
        Smooth part of the photo response.
    unusable : array, bool
        Pixels that are hot, noisy or dead.
    absent : dict of str
        Why there is no map of the gain or of the read noise, by the name of the map.
    """

    offset_dn: NDArray[np.float32]
    offset_variance_dn2: NDArray[np.float32]
    unusable: Mask
    dark_current_e_per_s: NDArray[np.float32] | None = None
    dark_current_variance_e2_per_s2: NDArray[np.float32] | None = None
    read_noise_e: NDArray[np.float32] | None = None
    read_noise_se_e: NDArray[np.float32] | None = None
    gain_dn_per_e: NDArray[np.float32] | None = None
    gain_se_dn_per_e: NDArray[np.float32] | None = None
    relative_response: NDArray[np.float32] | None = None
    relative_response_se: NDArray[np.float32] | None = None
    vignetting: NDArray[np.float32] | None = None
    absent: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class PixelLevels:
    """Offset and dark signal of every pixel, arrays (row, column), with the variances of their errors."""

    offset_dn: Map
    dark_signal_dn_per_s: Map
    offset_variance_dn2: Map
    dark_signal_variance_dn2_per_s2: Map


@dataclass(frozen=True)
class LinePattern:
    """Pattern of rows (row,) and of columns (column,) in the offsets, and the variance of the error of their sum."""

    row_dn: Array
    column_dn: Array
    variance_dn2: float


@dataclass(frozen=True)
class Pixels:
    """Measurements of the pixels.

    Attributes
    ----------
    variance_ratio : array (row, column)
        Variance of each pixel over the frames, divided by that of the model.
    hot, noisy, dead : array (row, column), bool
        The kinds of unusable pixels: of large dark signal, too noisy to be of use, and without response to light.
    telegraph : array (row, column), bool
        Pixels that jump between two levels; those that are not among the noisy ones are used.
    response, response_e : Response, optional
        Response to light in DN, and in electrons of the pixels' own gain; None without flats.
    gain, gain_why : PixelGain, str
        Gain over the mean; None if the frames do not determine it, and the reason.
    """

    read: PixelReadNoise
    variance_ratio: NDArray[np.float32]
    telegraph: Mask
    hot: Mask
    noisy: Mask
    dead: Mask
    levels: PixelLevels
    response: Response | None
    response_e: Response | None
    gain: PixelGain | None
    gain_why: str
    offset_seams: tuple[Seam, ...]

    def warnings(self) -> list[str]:
        """Return warnings about seams, uneven light and telegraph pixels."""
        why = self.response.why_no_prnu if self.response else ""
        warnings = [f"PRNU is not measured: {why}"] if why else []
        warnings += [
            f"the gain differs by {seam.difference:.2%} ± {seam.se:.2%} between {seam}; each region has its own gain "
            "in the maps: reconstruct with the maps, not with single numbers"
            for seam in (self.gain.seams if self.gain else ())
        ]
        warnings += [
            f"the offset differs by {seam.difference:.2g} DN between {seam}; the map of the offset has it"
            for seam in self.offset_seams
        ]
        count = int(self.telegraph.sum())
        if count > _NOTABLE_SHARE * self.telegraph.size:
            warnings.append(
                f"{count} pixels ({count / self.telegraph.size:.2%}) jump between two levels (random telegraph noise); "
                f"{int((self.telegraph & self.noisy).sum())} of them are left out, the others have a read noise of "
                "their own"
            )
        return warnings


def measure_pixels(fitted: SeriesFit, hot: Mask, outlying: Mask) -> Pixels:
    """Measure the pixels, of which some are hot and some have more noise than chance allows (row, column)."""
    read, telegraph = _read_noise(fitted, hot)
    ratio = variance_ratio(fitted.darks, fitted.dark_noise_dn2)[0]
    noisy = noisy_pixels(outlying & ~hot, ratio, telegraph)
    usable = ~(hot | noisy)
    levels = _levels(fitted, read, hot)
    response = gain = response_e = None
    dead = np.zeros_like(hot)
    why = "no flats: record 10 flats each of 3 light levels"
    if fitted.flats:
        response = response_e = _response(fitted, levels, usable, None)
        freedom = sum(dark.frames - 1.0 for dark in fitted.darks)
        transfer = photon_transfer(fitted.flats, levels.offset_dn, read.read_noise_dn, fitted.fit.values, freedom)
        dead = response.dead
        gain, why = measure_gain(
            transfer, usable & ~dead, response, lambda relative: _response(fitted, levels, usable, relative)
        )
        if gain is not None:
            response_e = _response(fitted, levels, usable, gain.relative)
        if gain is not None and gain.seams:
            # A step of the gain is no spread of the pixels, and no smooth part of the response takes it out
            even = _response(fitted, levels, usable, gain_of_regions(gain.seams, usable.shape))
            response = replace(response, spread2=even.spread2, spread2_se=even.spread2_se, why_no_prnu=even.why_no_prnu)
    seams = []
    if fitted.likelihood is not _CENSORED:
        read_dn = float(np.median(read.read_noise_dn))
        spread_dn2 = max(fitted.fit.values["dsnu_dn2"], 0.0) + read_dn**2 / sum(dark.frames for dark in fitted.darks)
        seams = find_seams(levels.offset_dn, usable, 1 / spread_dn2)
        seams = [seam for seam in seams if seam.difference > _NOTABLE_STEP * read_dn]
    return Pixels(read, ratio, telegraph, hot, noisy, dead, levels, response, response_e, gain, why, tuple(seams))


def noise_maps(fitted: SeriesFit, estimates: Mapping[str, Estimate], pixels: Pixels) -> NoiseMaps:
    """Return the maps; those in electrons only where the gain is known."""
    mean_gain = estimates["gain_dn_per_e"].value
    levels, read = pixels.levels, pixels.read
    maps: dict[str, Map] = {"offset_dn": levels.offset_dn, "offset_variance_dn2": levels.offset_variance_dn2}
    absent = {"gain_dn_per_e": pixels.gain_why} if pixels.gain is None else {}

    def in_electrons(values: Map, power: int = 1, least: float = -np.inf) -> Map:
        """Return a map over a power of the gain of the pixels, and at least `least`."""
        own = None if pixels.gain is None else pixels.gain.relative

        def work(rows: slice) -> Array:
            gain = np.float64(mean_gain) * (1.0 if own is None else own[rows])
            return np.asarray(np.maximum(values[rows] / gain**power, least))

        return map_of(work, values.shape)

    if mean_gain is None:
        absent = dict.fromkeys(("gain_dn_per_e", "read_noise_e"), str(estimates["gain_dn_per_e"].why))
    else:
        if (gain := pixels.gain) is not None:
            maps["gain_dn_per_e"] = map_of(lambda rows: mean_gain * gain.relative[rows], gain.relative.shape)
            maps["gain_se_dn_per_e"] = map_of(lambda rows: mean_gain * gain.se[rows], gain.se.shape)
        maps["read_noise_e"] = in_electrons(read.read_noise_dn)
        if fitted.likelihood is not _CENSORED:
            maps["read_noise_se_e"] = in_electrons(read.se_dn)
        if estimates["dark_current_e_per_s"].value is not None:
            maps["dark_current_e_per_s"] = in_electrons(levels.dark_signal_dn_per_s, least=0.0)
            maps["dark_current_variance_e2_per_s2"] = in_electrons(levels.dark_signal_variance_dn2_per_s2, 2)
    response = pixels.response if mean_gain is None else pixels.response_e
    if response is not None:
        maps |= {"relative_response": response.relative, "vignetting": response.vignetting}
        maps["relative_response_se"] = response.relative_se
    single = {name: values.astype(np.float32, copy=False) for name, values in maps.items()}
    return NoiseMaps(unusable=pixels.hot | pixels.noisy | pixels.dead, absent=absent, **single)


def _read_noise(fitted: SeriesFit, hot: Mask) -> tuple[PixelReadNoise, Mask]:
    """Return the read noise of every pixel, and the telegraph pixels; the sensor's own if values are cut off."""
    read_dn2, noise_dn2 = float(np.exp(fitted.fit.values["log_read_dn2"])), fitted.dark_noise_dn2
    if fitted.likelihood is _CENSORED:
        common, none = (np.full(hot.shape, value, np.float32) for value in (np.sqrt(read_dn2), 0.0))
        return PixelReadNoise(common, none, resolved=False), np.zeros_like(hot)
    read = measure_read_noise(fitted.darks, read_dn2, noise_dn2, ~hot)
    return read, telegraph_pixels(fitted.darks, read, noise_dn2) & ~hot


def _levels(fitted: SeriesFit, read: PixelReadNoise, hot: Mask) -> PixelLevels:
    values = fitted.fit.values
    if fitted.likelihood is _CENSORED:
        names = ("offset_dn", "dark_signal_dn_per_s", "dsnu_dn2", "dcnu_dn2_per_s2")
        return PixelLevels(*(np.full(hot.shape, values[name], np.float32) for name in names))

    def noise(beside_dn2: float) -> Callable[[slice], Array]:
        return lambda rows: np.square(read.read_noise_dn[rows], dtype=np.float64) + beside_dn2

    noise_dn2 = [noise(variance - float(np.exp(values["log_read_dn2"]))) for variance in fitted.dark_noise_dn2]
    return pixel_levels(fitted.darks, values, noise_dn2, line_pattern(fitted.darks, values["dsnu_dn2"]), hot)


def line_pattern(darks: Sequence[Series], dsnu_dn2: float) -> LinePattern:
    """Return what rows and columns share in the offsets, by the dark series of most frames, shrunk by chance.

    `dsnu_dn2` is the variance of the offsets of the pixels, which scatters the means of rows and columns, too.
    """
    most = max(darks, key=lambda dark: dark.frames)
    rows, columns = most.pattern_dn.shape
    patterns, error = [], 0.0
    lines = (most.row_dn, most.row_noise_dn2, columns), (most.column_dn, most.column_noise_dn2, rows)
    for profile_dn, noise_dn2, averaged in lines:
        # A lone frame does not tell the noise of its lines
        chance = max(dsnu_dn2, 0.0) / averaged + noise_dn2 / most.frames
        total = float(profile_dn.var())
        kept = max(1 - chance / total, 0.0) if total > 0 and most.frames > 1 else 0.0
        patterns.append(kept * profile_dn)
        error += kept * chance if most.frames > 1 else total
    return LinePattern(patterns[0], patterns[1], error)


def pixel_levels(
    darks: Sequence[Series],
    values: Mapping[str, float],
    noise_dn2: Sequence[Callable[[slice], Array | float]],
    pattern: LinePattern,
    hot: Mask,
) -> PixelLevels:
    """Return the posterior means of every pixel's offset and dark signal.

    Parameters
    ----------
    darks, values : sequence of Series, mapping
        Dark series, and `offset_dn`, `dark_signal_dn_per_s`, `dsnu_dn2`, `dcnu_dn2_per_s2` of the fit.
    noise_dn2 : sequence of callables
        Return the noise of some rows of pixels (row, column) in each series, or one number for all.
    pattern : LinePattern
        Pattern of rows and columns in the offsets.
    hot : array (row, column), bool
        Pixels whose dark signal the prior does not describe; only their own values determine it.
    """
    exposures = [series.conditions.dark_time_s for series in darks]
    offset_prior = 1 / max(values["dsnu_dn2"] + pattern.variance_dn2, _MIN_SPREAD_DN2[0])
    dcnu2 = max(values.get("dcnu_dn2_per_s2", 0.0), _MIN_SPREAD_DN2[1])
    signal_priors = 1e-12 if np.ptp(exposures) else 1e12, 1 / dcnu2
    # Jitter moves the mean of a whole series off the straight line; that is no pixel's offset.
    levels = [mean_over(series.mean_of, ~hot) for series in darks]

    def work(rows: slice) -> tuple[Array, ...]:
        of_lines = np.add.outer(pattern.row_dn[rows], pattern.column_dn)
        # Precision of offset, of both, and of dark signal; and the deviations that they weigh
        offset, signal = np.full(of_lines.shape, offset_prior), np.where(hot[rows], *signal_priors)
        both, of_offset, of_signal = np.zeros((3, *of_lines.shape))
        for series, variance, level in zip(darks, noise_dn2, levels, strict=True):
            t, weight = series.conditions.dark_time_s, series.frames / np.asarray(variance(rows))
            deviation = series.mean_of(rows)
            deviation -= level
            deviation -= of_lines
            deviation *= weight
            offset += weight
            of_offset += deviation
            if t:
                both += weight * t
                signal += weight * t**2
                deviation *= t
                of_signal += deviation
        determinant = offset * signal - both**2
        offset_dn = (signal * of_offset - both * of_signal) / determinant + values["offset_dn"] + of_lines
        signal_dn = (offset * of_signal - both * of_offset) / determinant + values.get("dark_signal_dn_per_s", 0.0)
        return offset_dn, signal_dn, signal / determinant, offset / determinant

    return PixelLevels(*maps_of(work, hot.shape, (np.float32,) * 4))


def _response(fitted: SeriesFit, levels: PixelLevels, usable: Mask, relative_gain: Map | None) -> Response:
    """Return the photo response, the signals divided by the relative gains of the pixels if there are any."""
    values, flats, shape = fitted.fit.values, fitted.flats, usable.shape
    total = new_map(shape)

    def work(rows: slice) -> Array:
        charge, sums = np.zeros(total[rows].shape), []
        for flat in flats:
            signal = flat.mean_of(rows) - levels.offset_dn[rows]
            sums.append(signal.sum())
            charge += charge_dn(values, signal)
            charge -= levels.dark_signal_dn_per_s[rows] * flat.conditions.dark_time_s
        total[rows] = charge if relative_gain is None else charge / relative_gain[rows]
        return np.array(sums)

    signals = total_of(work, shape) / usable.size
    return measure_response(total, _signal_noise(fitted, signals), usable)


def _signal_noise(fitted: SeriesFit, signals_dn: Array) -> SignalNoise:
    """Return the noise of the sum of the flats' charges, in DN, given their mean signals (flat,)."""
    values, frames = fitted.fit.values, fitted.moments.flats.frames
    slope2 = np.square(charge_slope(values, signals_dn))
    shot = float(np.exp(values["log_gain"]) * np.sum(np.maximum(charge_dn(values, signals_dn), 0.0) / frames))
    read = float(np.exp(values["log_read_dn2"]) * np.sum(1 / frames))
    by_parameter = np.array([{"log_gain": shot, "log_read_dn2": read}.get(name, 0.0) for name in values])
    return SignalNoise(
        shot,
        read + ROUNDING_DN2 * float(np.sum(slope2 / frames)) + _offset_error_dn2(fitted),
        float(np.sqrt(by_parameter @ fitted.fit.covariance @ by_parameter)),
    )


def _offset_error_dn2(fitted: SeriesFit) -> float:
    """Return the variance that the error of a pixel's offset and dark signal makes of the sum of its flats.

    It is that of `pixel_levels` for a pixel of the usual noise.
    """
    values, times_s = fitted.fit.values, fitted.moments.darks.exposure_s
    if fitted.likelihood is _CENSORED:  # one offset and dark signal for all
        error, signal_error = max(values["dsnu_dn2"], 0.0), max(values.get("dcnu_dn2_per_s2", 0.0), 0.0)
        return error * len(fitted.flats) ** 2 + signal_error * float(fitted.moments.flats.exposure_s.sum()) ** 2
    weights = fitted.moments.darks.frames / np.array(fitted.dark_noise_dn2)
    precision = np.diag([
        1 / max(values["dsnu_dn2"], _MIN_SPREAD_DN2[0]),
        1 / max(values.get("dcnu_dn2_per_s2", 0.0), _MIN_SPREAD_DN2[1]),
    ])  # fmt: skip
    design = np.stack([np.ones_like(times_s), times_s])
    sums = np.array([len(fitted.flats), float(fitted.moments.flats.exposure_s.sum())])
    return float(sums @ np.linalg.solve(precision + design * weights @ design.T, sums))
