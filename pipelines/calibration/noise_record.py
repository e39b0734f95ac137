"""A calibrated sensor as its files have it: the record `noise.json`, and the maps of `noise_maps.npz`."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from faintfield.calib.estimate import Estimate
from faintfield.calib.noise import NoiseCalibration
from faintfield.calib.noise.strips import release
from faintfield.pipelines.calibration.noise import Readout, SensorCalibration
from faintfield.pipelines.formats.files import sha256
from faintfield.pipelines.formats.frames import read_ahead
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.noise import (
    CovarianceRecord,
    FitRecord,
    NoiseRecord,
    PhaseRecord,
    Quantities,
    ResponseRecord,
    SaturationRecord,
)

_NUMBER = re.compile(r"\d[\d.]*(?:e[+-]?\d+)?")

# Maps by their name in the file, with the fill for pixels that were not calibrated; these are masked anyway.
_MAPS = {
    "mask": True,
    "offset_dn": 0.0,
    "offset_variance_dn2": 0.0,
    "dark_current_e_per_s": 0.0,
    "dark_current_variance_e2_per_s2": 0.0,
    "read_noise_e": 1.0,
    "read_noise_se_e": 0.0,
    "relative_response": 1.0,
    "relative_response_se": 0.0,
    "vignetting": 1.0,
    "gain_dn_per_e": 1.0,
    "gain_se_dn_per_e": 0.0,
}


def noise_record(sensor: SensorCalibration) -> NoiseRecord:
    """Return the record of a calibration, without the hash of its maps."""
    frames, readout, phases = sensor.frames, sensor.readout, [phase.calibration for phase in sensor.phases]
    bad_pixels: dict[str, Any] = {
        f"{kind}_pixels": np.argwhere(
            _interleave(readout, [getattr(c.pixels, kind) for c in phases], fill=False)
        ).tolist()
        for kind in ("hot", "noisy", "dead")
    }
    warnings = [*frames.warnings, *_phase_warnings({p.name: c for p, c in zip(readout.phases, phases, strict=True)})]
    means: dict[str, Any] = {name: _mean([c.estimates[name] for c in phases]) for name in _quantities(phases[0])}
    first = min(phases, key=lambda c: c.saturation_dn)  # the phase that saturates first
    full_well = first.saturation.limit == "full well"
    return NoiseRecord(
        **means,
        covariance=_covariance(phases),
        likelihood=" / ".join(dict.fromkeys(str(c.likelihood) for c in phases)),
        saturation_dn=Estimate(first.saturation_dn, ci95=first.saturation.interval_dn)
        if full_well
        else first.saturation_dn,
        size_px=readout.size_px,
        mosaic=readout.mosaic or UNSET,
        planes=_phase_records(sensor) if readout.mosaic else UNSET,
        **bad_pixels,
        temperature_c=frames.temperature_range,
        frames=frames.settings.frame,
        warnings=list(dict.fromkeys(warnings)),
        provenance=provenance(
            "noise", {}, dict(read_ahead(frames.file_names, lambda name: sha256(frames.folder / name)))
        ),
        fit=UNSET if readout.mosaic else _fit_record(phases[0]),
        emva1288=UNSET if readout.mosaic else sensor.phases[0].record(),
    )


def _phase_warnings(phases: Mapping[str, NoiseCalibration]) -> Iterator[str]:
    """Yield the warnings of the phases by their names; what holds for all, numbers aside, once."""
    alike: dict[str, dict[str, str]] = {}
    for name, calibration in phases.items():
        for warning in calibration.warnings:
            alike.setdefault(_NUMBER.sub("", warning), {})[name] = warning
    for warnings in alike.values():
        name, first = next(iter(warnings.items()))
        if len(warnings) < len(phases):
            yield from (f"plane {name}: {warning}" for name, warning in warnings.items())
        elif len(set(warnings.values())) == 1:
            yield first
        else:
            yield f"all planes, with the numbers of {name}: {first}"


def _phase_records(sensor: SensorCalibration) -> list[PhaseRecord]:
    return [
        PhaseRecord(
            phase=phase.phase,
            colour=phase.colour,
            likelihood=str(measured.calibration.likelihood),
            masked_black_dn=float(np.mean(phase.black_dn)) if phase.black_dn else None,
            fit=_fit_record(measured.calibration),
            emva1288=measured.record(),
            **_quantities(measured.calibration),
        )
        for phase, measured in zip(sensor.readout.phases, sensor.phases, strict=True)
    ]


def _quantities(calibration: NoiseCalibration) -> dict[str, Any]:
    """Return the estimates that have a key of their own in noise.json."""
    return {name: it for name, it in calibration.estimates.items() if name in Quantities.__struct_fields__}


def _mean(estimates: Sequence[Estimate]) -> Estimate:
    """Return the mean over phases, or the reason why one of them has no value."""
    if len(estimates) == 1:
        return estimates[0]
    unknown = next((estimate for estimate in estimates if estimate.value is None), None)
    if unknown is not None:
        return unknown
    count = len(estimates)
    value = sum(estimate.value or 0.0 for estimate in estimates) / count
    se = float(np.sqrt(sum((estimate.se or 0.0) ** 2 for estimate in estimates))) / count
    return Estimate(value, se, (value - 1.96 * se, value + 1.96 * se))


def _covariance(phases: Sequence[NoiseCalibration]) -> CovarianceRecord:
    names = phases[0].covariance[0]
    if any(c.covariance[0] != names for c in phases):
        return CovarianceRecord([], [])
    matrix = np.sum([c.covariance[1] for c in phases], axis=0) / len(phases) ** 2
    return CovarianceRecord(list(names), matrix.tolist())


def _fit_record(calibration: NoiseCalibration) -> FitRecord:
    names = ("saturation_e", "linearity_error", "noise_error", "drift_dn", "light_error", "lamp_flicker")
    return FitRecord(
        saturation=msgspec.convert(calibration.saturation, SaturationRecord, from_attributes=True),
        response=msgspec.convert(calibration.response, ResponseRecord | None, from_attributes=True),
        series=list(calibration.goodness),
        telegraph_pixels=int(calibration.pixels.telegraph.sum()),
        maps_absent=calibration.maps.absent,
        **{name: calibration.estimates[name] for name in names},
    )


def noise_maps(sensor: SensorCalibration) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield name and array of the maps of `noise_maps.npz` (row, column): float32, but the bool `mask`."""
    several = len(sensor.phases) > 1
    for name, fill in _MAPS.items():
        parts = [_part_of_map(phase.calibration, name, several=several) for phase in sensor.phases]
        whole = [part for part in parts if part is not None]
        if len(whole) == len(parts):
            yield name, _interleave(sensor.readout, whole, fill)
            release()


def _part_of_map(calibration: NoiseCalibration, name: str, *, several: bool) -> NDArray[Any] | None:
    """Return the map of a phase; of several, one whose pixels have no gain of their own has that of all."""
    maps, gain = calibration.maps, calibration.estimates["gain_dn_per_e"].value
    if several and name == "gain_dn_per_e" and maps.gain_dn_per_e is None and gain is not None:
        return np.broadcast_to(np.float32(gain), maps.offset_dn.shape)
    part: NDArray[Any] | None = maps.unusable if name == "mask" else getattr(maps, name)
    return part


def _interleave(readout: Readout, parts: Sequence[NDArray[Any]], fill: float | bool) -> NDArray[Any]:
    width, height = readout.size_px
    whole = np.full((height, width), fill, parts[0].dtype)
    region = whole[readout.rows, readout.columns]
    for phase, part in zip(readout.phases, parts, strict=True):
        phase.of(region)[...] = part
    return whole
