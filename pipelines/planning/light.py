"""The light of a scene before the capture: stated, or estimated from a frame."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from faintfield.pipelines.errors import BadValue, WrongUsage
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.noise import read_fitted_noise
from faintfield.pipelines.formats.results.noise_fit import Measured
from faintfield.pipelines.planning.known import Sensor
from faintfield.pipelines.planning.options import PlanOptions

# Two-sided 95 % of the normal distribution.
_Z95 = 1.96

# Largest part of saturated pixels whose light is still that of the others.
_MAX_SATURATED = 0.01

# The middle of a flat reaches to either side by the frame's larger side over this.
_MIDDLE_DIVISOR = 20


@dataclass(frozen=True)
class Light:
    """Light of the scene in electrons per pixel and second, and where it is from."""

    e_per_s: Measured
    source: str


def planned_light(options: PlanOptions, exposure_s: float, sensor: Sensor) -> Light:
    """Return the light of the scene: as stated, or that of a frame.

    Parameters
    ----------
    options : PlanOptions
        Exactly one of the light, the light per second, a flat and a test frame.
    exposure_s : float
        Exposure of the frame that `light_e` is of.
    sensor : Sensor
        That took the frame.

    Raises
    ------
    WrongUsage
        None or several are given.
    InputError
        The frame cannot be used, or shows no light.
    """
    per_frame_e, per_s, path = options.light_e, options.light_e_per_s, options.flat or options.test_frame
    count = sum(value is not None for value in (per_frame_e, per_s, options.flat, options.test_frame))
    if count != 1:
        raise WrongUsage(
            f"{count} lights are given, and one is wanted; give --light-e, --light-e-per-s, --flat or --test-frame"
        )
    if path is not None:
        return _light_of_frame(path, options, sensor)
    if (options.frame_exposure_ms, options.region_px) != (None, None):
        raise WrongUsage("--frame-exposure-ms and --region-px are those of a frame; give --test-frame or --flat")
    return Light(Measured(per_s if per_frame_e is None else per_frame_e / exposure_s), "as stated")


def _light_of_frame(path: Path, options: PlanOptions, sensor: Sensor) -> Light:
    """Return the light of a frame, with its interval: by the noise of its pixels, and by that of the calibration."""
    frame = read_frame(path)
    stated_ms = options.frame_exposure_ms
    exposure_s = frame.exposure_s if stated_ms is None else 1e-3 * stated_ms
    if exposure_s is None:
        raise BadValue(f"{path}: states no exposure time; give --frame-exposure-ms")
    if frame.pixels_dn.ndim != 2:
        raise BadValue(f"{path}: is a colour picture; give a grey or raw frame as the sensor counts it")
    height, width = frame.pixels_dn.shape
    if sensor.model is not None:
        model, unusable = sensor.model, np.zeros((height, width), bool)
    elif sensor.path is not None:
        fitted = read_fitted_noise(sensor.path, (width, height))
        model, unusable = fitted.model, fitted.unusable
    else:
        raise BadValue(
            f"{path}: its DN tell no electrons, as there is no noise calibration; give the result of `faintfield "
            "noise` as --noise, or the light as --light-e"
        )
    where = _region(path, options, width, height)
    usable = ~unusable[where]
    saturated = model.saturated(frame.pixels_dn)[where] & usable
    if not usable.any() or saturated.sum() > _MAX_SATURATED * usable.sum():
        raise BadValue(
            f"{path}: {saturated.sum()} of {usable.sum()} usable pixels are saturated, at most "
            f"{_MAX_SATURATED:.0%} may be; expose it for less than {1e3 * exposure_s:g} ms"
        )
    usable &= ~saturated
    count = int(usable.sum())
    dark_e = np.broadcast_to(model.background_e(exposure_s), frame.pixels_dn.shape)[where][usable]
    electrons = model.electrons(frame.pixels_dn)[where][usable]
    light_e = float(np.mean(electrons, dtype=np.float64) - np.mean(dark_e))
    known_e2 = float(np.mean(dark_e) + np.mean(model.read_variance_e2()))
    variance_e2 = (max(light_e, 0.0) + known_e2) / count + _variance_of_calibration(sensor, light_e, exposure_s)
    margin_e = _Z95 * variance_e2**0.5
    low_e, high_e = light_e - margin_e, light_e + margin_e
    if low_e <= 0:
        raise BadValue(
            f"{path}: shows {light_e:.3g} e⁻ per pixel (95 %: {low_e:.3g} to {high_e:.3g}), which may be none; "
            f"expose it for longer than {1e3 * exposure_s:g} ms"
        )
    part = "its middle" if options.flat is not None and options.region_px is None else f"{count} pixels"
    exact = "" if sensor.record is not None else ", the sensor's numbers taken as exact"
    source = f"{path.name}, {1e3 * exposure_s:g} ms, mean of {part}{exact}"
    ends = low_e / exposure_s, high_e / exposure_s
    return Light(Measured(light_e / exposure_s, margin_e / _Z95 / exposure_s, ends), source)


def _region(path: Path, options: PlanOptions, width: int, height: int) -> tuple[slice, slice]:
    if options.region_px is not None:
        left, upper, wide, high = options.region_px
        if min(left, upper) < 0 or min(wide, high) < 1 or left + wide > width or upper + high > height:
            raise BadValue(
                f"{path}: --region-px {left} {upper} {wide} {high} is not within its {width} x {height} px; give left "
                "column, upper row, width and height"
            )
        return slice(upper, upper + high), slice(left, left + wide)
    if options.flat is None:
        return slice(None), slice(None)
    near = max(width, height) // _MIDDLE_DIVISOR + 1
    row, column = height // 2, width // 2
    return slice(max(row - near, 0), row + near), slice(max(column - near, 0), column + near)


def _variance_of_calibration(sensor: Sensor, light_e: float, exposure_s: float) -> float:
    """Return the variance in e⁻² of a mean `(dn − offset)/gain − D t` by its calibration, with the frame's jitter."""
    record, gain = sensor.record, sensor.gain_dn_per_e.value
    if record is None or gain is None:
        return 0.0
    charge_e = light_e + (record.dark_current_e_per_s.value or 0.0) * exposure_s
    slopes = {"offset_dn": -1 / gain, "gain_dn_per_e": -charge_e / gain, "dark_current_e_per_s": -exposure_s}
    jitter_e = (record.frame_jitter_dn.value or 0.0) / gain
    names = record.covariance.names
    if slopes.keys() <= {*names}:
        slope = np.array([slopes.get(name, 0.0) for name in names])
        return float(slope @ np.array(record.covariance.matrix) @ slope) + jitter_e**2
    errors = [slope * (getattr(record, name).se or 0.0) for name, slope in slopes.items()]
    return float(np.square(errors).sum()) + jitter_e**2
