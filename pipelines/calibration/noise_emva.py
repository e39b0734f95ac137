"""The report by EMVA 1288 of a calibrated sensor: which images it shows, and the quantities that follow."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.estimate import Estimate
from faintfield.calib.noise import NoiseCalibration, Series
from faintfield.calib.noise.emva.nonuniformity import Nonuniformity, TemporalNoise, nonuniformity, temporal_noise
from faintfield.calib.noise.emva.quantities import derived_quantities, gather_inputs
from faintfield.calib.noise.maps.photo_response import smooth_part
from faintfield.calib.noise.strips import map_of, mean_over
from faintfield.calib.noise.temperature import dark_current_doubling
from faintfield.pipelines.formats.results.noise import EmvaImageRecord, EmvaRecord

# The bright image is the series of the most frames within so much of half of saturation, or else the nearest to it.
_BRIGHT_SHARE, _BRIGHT_WITHIN = 0.5, 0.1

_NO_PAIR = "no {} has two frames, without which the pattern of the pixels cannot be told from noise; record at least 16"


@dataclass(frozen=True)
class MeanImage:
    """The mean image of a series (row, column), with the temporal noise that is left in it: for DSNU or PRNU.

    Values are in DN for a dark; for a bright one relative to its mean signal, dark and vignetting taken out. The mean
    above the dark of zero exposure is `signal_dn`.
    """

    series: Series
    values: NDArray[np.floating[Any]]
    noise: TemporalNoise
    signal_dn: float

    def record(self) -> EmvaImageRecord:
        """Return which series it is."""
        is_of = self.series.conditions
        return EmvaImageRecord(is_of.exposure_s, is_of.level, self.series.frames, self.signal_dn)


@dataclass(frozen=True)
class EmvaMeasurement:
    """Content of the report of one phase of the mosaic, whose name is "" when it is the only one.

    `series` are all, those that were left out included; `exposure_s` is that of the dark noise; `estimates` have the
    names of `EmvaRecord`; `dark` and `bright` are the images of DSNU and PRNU.
    """

    name: str
    calibration: NoiseCalibration
    series: tuple[Series, ...]
    exposure_s: float
    estimates: dict[str, Estimate]
    dark: MeanImage | None
    bright: MeanImage | None

    @property
    def used(self) -> NDArray[np.bool_]:
        """Pixels that count."""
        return ~self.calibration.maps.unusable

    def record(self) -> EmvaRecord:
        """Return the part of noise.json."""
        return EmvaRecord(
            dark_noise_exposure_s=self.exposure_s,
            **self.estimates,
            dark_image=self.dark.record() if self.dark else None,
            bright_image=self.bright.record() if self.bright else None,
        )


def measure_emva(
    name: str, series: Sequence[Series], calibration: NoiseCalibration, temperature_c: Mapping[str, float]
) -> EmvaMeasurement:
    """Return the quantities of EMVA 1288 of one phase; `temperature_c` is that of each frame by its name."""
    darks = [item for item in series if item.conditions.kind == "dark"]
    exposure_s = _exposure_s(calibration)
    dark, bright = _dark_image(darks, calibration, exposure_s), _bright_image(darks, calibration)
    inputs = gather_inputs(
        calibration.estimates,
        calibration.covariance,
        full_well=calibration.saturation.limit == "full well",
        charge_error=_charge_error(calibration),
    )
    estimates = derived_quantities(inputs, exposure_s)
    estimates |= _spreads("dsnu_{}_e", dark, calibration, "gain_dn_per_e", "dark")
    estimates |= _spreads("prnu_{}", bright, calibration, "prnu", "flat")
    estimates["dark_current_doubling_k"] = _doubling(darks, temperature_c)
    return EmvaMeasurement(name, calibration, tuple(series), exposure_s, estimates, dark, bright)


def _charge_error(calibration: NoiseCalibration) -> float:
    """Return the relative error of the charge of a mean flat that the bend of the response leaves.

    It is that of κ₁ at half of the brightest signal; further coefficients, which take part of it back, do not count.
    """
    se, kept = calibration.estimates["nonlinearity_per_dn"].se, calibration.saturation.kept
    if se is None or not kept:
        return 0.0
    brightest = max(float(flat.levels_dn.mean()) for flat in kept) - (calibration.estimates["offset_dn"].value or 0.0)
    return 0.5 * se * brightest


def _exposure_s(calibration: NoiseCalibration) -> float:
    """Return the exposure of the flats if they share one, else 0, as EMVA 1288 extrapolates to."""
    exposures = {flat.conditions.exposure_s for flat in calibration.saturation.kept}
    return exposures.pop() if len(exposures) == 1 else 0.0


def _dark_image(
    darks: list[Series], calibration: NoiseCalibration, exposure_s: float, *, nearest: bool = False
) -> MeanImage | None:
    """Return the mean of the darks of the most frames, of several those nearest to an exposure; or the nearest ones."""
    used = ~calibration.maps.unusable
    several = [dark for dark in darks if dark.frames > 1]
    if not several or not used.any():
        return None
    most = 0 if nearest else max(item.frames for item in several)
    enough = [dark for dark in several if dark.frames >= most]
    dark = min(enough, key=lambda dark: abs(dark.conditions.exposure_s - exposure_s))
    mean = map_of(dark.mean_of, used.shape, np.float64)
    offset = calibration.estimates["offset_dn"].value or 0.0
    return MeanImage(dark, mean, temporal_noise(dark, used), mean_over(lambda rows: mean[rows], used) - offset)


def _bright_image(darks: list[Series], calibration: NoiseCalibration) -> MeanImage | None:
    """Return the mean of the flats nearest to half of saturation, over its mean; dark and vignetting are taken out."""
    used, offset = ~calibration.maps.unusable, calibration.estimates["offset_dn"].value or 0.0
    kept, end_dn = calibration.saturation.kept, calibration.saturation_dn
    several = [flat for flat in kept if flat.frames > 1]
    if not several or not used.any():
        return None
    brightest = max(float(flat.levels_dn.mean()) for flat in kept)
    span = (end_dn if np.isfinite(end_dn) else brightest) - offset

    def distance(flat: Series) -> float:
        return abs((float(flat.levels_dn.mean()) - offset) / span - _BRIGHT_SHARE)

    def rank(flat: Series) -> tuple[int, float]:
        return -flat.frames if distance(flat) < _BRIGHT_WITHIN else 0, distance(flat)

    flat = min(several, key=rank)
    dark = _dark_image(darks, calibration, flat.conditions.exposure_s, nearest=True)
    if dark is None:
        return None
    response = calibration.response

    def signal(rows: slice) -> NDArray[np.float64]:
        return np.asarray(flat.mean_of(rows) - dark.values[rows])

    def charge(rows: slice) -> NDArray[np.float64]:
        return signal(rows) if response is None else response.charge_dn(signal(rows))

    # Smoothed by itself, an image loses the same share of its pattern and of its noise
    mean = mean_over(charge, used)
    smooth = smooth_part(map_of(lambda rows: charge(rows) / mean, used.shape), used)

    def per_dn(rows: slice) -> NDArray[np.float64]:
        """Return the derivative of the image by the signal; a bend of the response compresses bright pixels."""
        of_light = 1 / (mean * np.maximum(smooth[rows], 1e-3, dtype=np.float64))
        return np.asarray(of_light if response is None else of_light * response.slope(signal(rows)))

    image = map_of(
        lambda rows: charge(rows) / mean / np.maximum(smooth[rows], 1e-3, dtype=np.float64), used.shape, np.float64
    )
    noise = temporal_noise(flat, used, per_dn) + temporal_noise(dark.series, used, per_dn)
    return MeanImage(flat, image, noise, mean_over(signal, used))


def _spreads(
    names: str, image: MeanImage | None, calibration: NoiseCalibration, known: str, kind: str
) -> dict[str, Estimate]:
    """Return DSNU or PRNU, all of it and its parts; those of darks in electrons, which need the gain."""
    needed, parts = calibration.estimates[known], [part.name for part in fields(Nonuniformity)]
    if image is None or needed.value is None:
        return {names.format(part): Estimate(None, why=needed.why or _NO_PAIR.format(kind)) for part in parts}
    scale = 1 / needed.value if kind == "dark" else 1.0
    used = ~calibration.maps.unusable
    spreads = nonuniformity(image.values, used, image.noise, scale, smoothed=kind == "flat")
    return {names.format(part): getattr(spreads, part) for part in parts}


def _doubling(darks: list[Series], temperature_c: Mapping[str, float]) -> Estimate:
    level = np.concatenate([dark.levels_dn for dark in darks])
    exposure = np.concatenate([np.full(dark.frames, dark.conditions.exposure_s) for dark in darks])
    warmth = np.array([temperature_c.get(name, np.nan) for dark in darks for name in dark.names])
    return dark_current_doubling(level, exposure, warmth)
