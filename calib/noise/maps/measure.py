"""What differs from pixel to pixel, in the order in which it is measured: noise, offset, response to light, gain."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise.fitting import NoiseLikelihood, SeriesFit
from faintfield.calib.noise.likelihood.response import charge_dn, charge_slope
from faintfield.calib.noise.maps.gain import PixelGain, measure_gain, photon_transfer
from faintfield.calib.noise.maps.photo_response import Response, measure_response
from faintfield.calib.noise.maps.pixels import PixelLevels, line_pattern, noisy_pixels, pixel_levels, variance_ratio
from faintfield.calib.noise.maps.read_noise import PixelReadNoise, measure_read_noise
from faintfield.calib.noise.maps.seams import Seam, find_seams
from faintfield.calib.noise.maps.telegraph import telegraph_pixels
from faintfield.calib.noise.result import Estimate, NoiseMaps

type Array = NDArray[np.float64]

# A step of the offsets is named from this fraction of the read noise, telegraph pixels from this share of all.
_NOTABLE_STEP, _NOTABLE_SHARE = 0.1, 1e-4

_CENSORED = NoiseLikelihood.CENSORED


@dataclass(frozen=True)
class Pixels:
    """What was measured of the pixels.

    Attributes
    ----------
    read : PixelReadNoise
        Their read noise.
    telegraph, noisy : array (row, column), bool
        Pixels that jump between two levels; pixels that are too noisy to be of use.
    levels : PixelLevels
        Their offset and dark signal.
    response, response_e : Response, optional
        Their response to light in DN, and in electrons of the pixels' own gain; None without flats.
    gain : PixelGain, optional
        Their gain over the mean; None if the frames do not determine it.
    gain_why : str
        Why there is no gain per pixel.
    offset_seams : tuple of Seam
        Regions whose offsets differ.
    """

    read: PixelReadNoise
    telegraph: NDArray[np.bool_]
    noisy: NDArray[np.bool_]
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


def measure_pixels(fitted: SeriesFit, hot: NDArray[np.bool_], outlying: NDArray[np.bool_]) -> Pixels:
    """Measure the pixels.

    Parameters
    ----------
    fitted : SeriesFit
        The fit of what the pixels have in common.
    hot, outlying : array (row, column), bool
        Pixels with a large dark signal; pixels with more noise than chance allows.
    """
    read, telegraph = _read_noise(fitted, hot)
    noisy = noisy_pixels(outlying & ~hot, variance_ratio(fitted.darks, fitted.dark_noise_dn2)[0], telegraph)
    usable = ~hot & ~noisy
    levels = _levels(fitted, read, hot)
    response = gain = response_e = None
    why = "no flats: record 10 flats each of 3 light levels"
    if fitted.flats:
        response = response_e = _response(fitted, levels, usable, 1.0)
        transfer = photon_transfer(fitted.flats, levels.offset_dn, read.read_noise_dn**2, fitted.fit.values)
        bright = usable & ~response.dead
        gain, why = measure_gain(
            transfer, bright, response, lambda relative: _response(fitted, levels, usable, relative)
        )
        if gain is not None:
            response_e = _response(fitted, levels, usable, gain.relative)
        if gain is not None and gain.seams:
            # A step of the gain is no spread of the pixels, and no smooth part of the response takes it out
            even = _response(fitted, levels, usable, gain.of_regions)
            response = replace(response, prnu=even.prnu, prnu_se=even.prnu_se, why_no_prnu=even.why_no_prnu)
    seams = () if fitted.likelihood is _CENSORED else _offset_seams(fitted, levels, read, usable)
    return Pixels(read, telegraph, noisy, levels, response, response_e, gain, why, seams)


def noise_maps(
    fitted: SeriesFit, estimates: Mapping[str, Estimate], pixels: Pixels, unusable: NDArray[np.bool_]
) -> NoiseMaps:
    """Return the maps; those in electrons only where the gain is known."""
    mean_gain = estimates["gain_dn_per_e"].value
    levels, read = pixels.levels, pixels.read
    maps = {"offset_dn": levels.offset_dn, "offset_variance_dn2": levels.offset_variance_dn2}
    absent = {"gain_dn_per_e": pixels.gain_why} if pixels.gain is None else {}
    if mean_gain is None:
        absent = dict.fromkeys(("gain_dn_per_e", "read_noise_e"), str(estimates["gain_dn_per_e"].why))
    else:
        gain: Array | float = mean_gain
        if pixels.gain is not None:
            gain = mean_gain * pixels.gain.relative
            maps |= {"gain_dn_per_e": gain, "gain_se_dn_per_e": mean_gain * pixels.gain.se}
        maps["read_noise_e"] = read.read_noise_dn / gain
        if fitted.likelihood is not _CENSORED:
            maps["read_noise_se_e"] = read.se_dn / gain
        if estimates["dark_current_e_per_s"].value is not None:
            maps["dark_current_e_per_s"] = np.maximum(levels.dark_signal_dn_per_s / gain, 0)
            maps["dark_current_variance_e2_per_s2"] = levels.dark_signal_variance_dn2_per_s2 / gain**2
    response = pixels.response if mean_gain is None else pixels.response_e
    if response is not None:
        maps |= {"relative_response": response.relative, "vignetting": response.vignetting}
        maps["relative_response_se"] = response.relative_se
    single = {name: values.astype(np.float32) for name, values in maps.items()}
    return NoiseMaps(unusable=unusable, absent=absent, **single)


def _read_noise(fitted: SeriesFit, hot: NDArray[np.bool_]) -> tuple[PixelReadNoise, NDArray[np.bool_]]:
    """Return the read noise of every pixel, and the telegraph pixels; the sensor's own if values are cut off."""
    read_dn2, noise_dn2 = float(np.exp(fitted.fit.values["log_read_dn2"])), fitted.dark_noise_dn2
    if fitted.likelihood is _CENSORED:
        common = np.full(hot.shape, np.sqrt(read_dn2))
        return PixelReadNoise(common, np.zeros(hot.shape), resolved=False), np.zeros_like(hot)
    read = measure_read_noise(fitted.darks, read_dn2, noise_dn2, ~hot)
    return read, telegraph_pixels(fitted.darks, read, noise_dn2) & ~hot


def _levels(fitted: SeriesFit, read: PixelReadNoise, hot: NDArray[np.bool_]) -> PixelLevels:
    """Return offset and dark signal of every pixel; the sensor's own if values are cut off."""
    values = fitted.fit.values
    if fitted.likelihood is _CENSORED:
        names = ("offset_dn", "dark_signal_dn_per_s", "dsnu_dn2", "dcnu_dn2_per_s2")
        return PixelLevels(*(np.full(hot.shape, values[name]) for name in names))
    more_dn2 = read.read_noise_dn**2 - np.exp(values["log_read_dn2"])
    noise_dn2 = [variance + more_dn2 for variance in fitted.dark_noise_dn2]
    return pixel_levels(fitted.darks, values, noise_dn2, line_pattern(fitted.darks, values["dsnu_dn2"]), hot)


def _response(
    fitted: SeriesFit, levels: PixelLevels, usable: NDArray[np.bool_], relative_gain: Array | float
) -> Response:
    """Return the photo response, the signals divided by the relative gains of the pixels."""
    values, signals, noise = fitted.fit.values, [], []
    for v, one in zip(fitted.flat_noise_dn2, fitted.flats, strict=True):
        signal = one.mean_dn - levels.offset_dn
        dark = levels.dark_signal_dn_per_s * one.conditions.dark_time_s
        signals.append((charge_dn(values, signal) - dark) / relative_gain)
        noise.append(v / one.frames * float(charge_slope(values, np.mean(signal)) ** 2))
    return measure_response(signals, noise, usable)


def _offset_seams(
    fitted: SeriesFit, levels: PixelLevels, read: PixelReadNoise, usable: NDArray[np.bool_]
) -> tuple[Seam, ...]:
    """Return regions whose offsets differ notably."""
    read_dn = float(np.median(read.read_noise_dn))
    spread_dn2 = max(fitted.fit.values["dsnu_dn2"], 0.0) + read_dn**2 / sum(one.frames for one in fitted.darks)
    seams = find_seams(levels.offset_dn, usable / spread_dn2)
    return tuple(seam for seam in seams if seam.difference > _NOTABLE_STEP * read_dn)
