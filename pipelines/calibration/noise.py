"""A sensor's noise from a noise set: each phase of its mosaic calibrated, as the record and the maps of the result."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from faintfield.calib.errors import CalibrationError
from faintfield.calib.noise import Estimate, NoiseCalibration, calibrate
from faintfield.calib.noise.strips import release
from faintfield.pipelines.calibration.noise_emva import EmvaMeasurement, measure_emva
from faintfield.pipelines.calibration.noise_fit import fit_record
from faintfield.pipelines.calibration.noise_frames import MosaicPhase, Readout, read_series
from faintfield.pipelines.console import working
from faintfield.pipelines.formats.files import sha256
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.noise import CovarianceRecord, NoiseRecord, PhaseRecord, Quantities
from faintfield.pipelines.formats.results.noise_fit import Measured
from faintfield.pipelines.formats.sets.noise_set import (
    FILE_NAME,
    NoiseSet,
    scene_temperature_warnings,
    temperature_notes,
)
from faintfield.rig.session.session import PLAN

# Black levels of masked pixels and of covered ones differ by less in a sound camera.
_BLACK_TOLERANCE_DN = 2.0

# Maps by their name in the file, with the fill for pixels that were not calibrated; these are masked anyway.
_MAPS = {
    "offset_dn": 0.0,
    "offset_variance_dn2": 0.0,
    "dark_current_e_per_s": 0.0,
    "dark_current_variance_e2_per_s2": 0.0,
    "read_noise_e": 1.0,
    "read_noise_se_e": 0.0,
    "relative_response": 1.0,
    "relative_response_se": 0.0,
    "vignetting": 1.0,
}
_GAIN_MAPS = {"gain_dn_per_e": 1.0, "gain_se_dn_per_e": 0.0}


@dataclass(frozen=True)
class SensorCalibration:
    """The calibration of a sensor.

    Attributes
    ----------
    folder : Path
        Of the noise set.
    settings : NoiseSet
        The frames that were used.
    readout : Readout
        The layout of the frames.
    phases : list of NoiseCalibration
        One per phase of the mosaic, in the order of `readout.phases`.
    emva : list of EmvaMeasurement
        Likewise, what the report by EMVA 1288 shows.
    """

    folder: Path
    settings: NoiseSet
    readout: Readout
    phases: list[NoiseCalibration]
    emva: list[EmvaMeasurement]


def calibrate_sensor(folder: Path, settings: NoiseSet) -> SensorCalibration:
    """Read the frames of a noise set and calibrate every phase of the mosaic.

    Raises
    ------
    InputError, CalibrationError
        A frame cannot be used, or the frames do not determine the noise; the message says what to record.
    """
    readout = read_series(folder, settings)
    with working("fitting noise and response"):
        phases = [_calibrate_phase(phase, readout.saturation_dn) for phase in readout.phases]
    warmth = {str(folder / frame.file): it for frame in settings.frame if (it := frame.temperature_c) is not None}
    emva = [measure_emva(*of_phase, warmth) for of_phase in zip(readout.phases, phases, strict=True)]
    return SensorCalibration(folder, settings, readout, phases, emva)


def noise_record(sensor: SensorCalibration) -> NoiseRecord:
    """Return the record of a calibration, without the hash of its maps."""
    readout, phases, settings = sensor.readout, sensor.phases, sensor.settings
    records = [_phase_record(*of_phase) for of_phase in zip(readout.phases, phases, sensor.emva, strict=True)]
    bad_pixels: dict[str, Any] = {
        f"{kind}_pixels": np.argwhere(_interleave(readout, [getattr(c, kind) for c in phases], fill=False)).tolist()
        for kind in ("hot", "noisy", "dead")
    }
    temperature_c, warnings = temperature_notes(settings)
    warnings += scene_temperature_warnings(sensor.folder, settings)
    warnings += [warning for calibration in phases for warning in calibration.warnings]
    means = {name: _mean([c.estimates[name] for c in phases]) for name in phases[0].estimates if _is_quantity(name)}
    return NoiseRecord(
        **_records(means),
        covariance=_covariance(phases),
        likelihood=" / ".join(dict.fromkeys(str(c.likelihood) for c in phases)),
        saturation_dn=_saturation(phases),
        size_px=readout.size_px,
        mosaic=readout.mosaic or UNSET,
        planes=records if readout.mosaic else UNSET,
        **bad_pixels,
        temperature_c=temperature_c,
        frames=settings.frame,
        warnings=list(dict.fromkeys(warnings)),
        provenance=provenance("noise", {}, _input_hashes(sensor.folder, settings)),
        fit=UNSET if readout.mosaic else fit_record(phases[0]),
        emva1288=UNSET if readout.mosaic else sensor.emva[0].record(),
    )


def noise_maps(sensor: SensorCalibration) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield name and array of the maps of `noise_maps.npz` (row, column): float32, but the bool `mask`."""
    for name, parts, fill in _parts_of_maps(sensor.phases):
        yield name, _interleave(sensor.readout, parts, fill)
        release()


def _parts_of_maps(phases: Sequence[NoiseCalibration]) -> Iterator[tuple[str, list[NDArray[Any]], float]]:
    """Yield the name of each map, its part of each phase, and the value of pixels that were not calibrated."""
    yield "mask", [c.maps.unusable for c in phases], True
    for name, fill in _MAPS.items():
        parts = [getattr(c.maps, name) for c in phases]
        if all(part is not None for part in parts):
            yield name, parts, fill
    if len(phases) > 1 or phases[0].maps.gain_dn_per_e is not None:
        gains = [_gain_map(c) for c in phases]
        for (name, fill), kept in zip(_GAIN_MAPS.items(), zip(*gains, strict=True), strict=True):
            whole = [part for part in kept if part is not None]
            if len(whole) == len(phases):
                yield name, whole, fill


def _gain_map(calibration: NoiseCalibration) -> tuple[NDArray[np.float32] | None, NDArray[np.float32] | None]:
    """Return the gain of each pixel of a phase, its gain for all where pixels have none of their own; and its error."""
    maps, gain = calibration.maps, calibration.estimates["gain_dn_per_e"].value
    if gain is None:
        return None, None
    if maps.gain_dn_per_e is not None:
        return maps.gain_dn_per_e, maps.gain_se_dn_per_e
    return np.broadcast_to(np.float32(gain), maps.offset_dn.shape), None


def _calibrate_phase(phase: MosaicPhase, saturation_dn: float) -> NoiseCalibration:
    """Calibrate one phase of the mosaic; its name goes into its warnings and failures."""
    prefix = f"plane {phase.name}: " if phase.name else ""
    try:
        calibration = calibrate(phase.series, saturation_dn)
    except CalibrationError as failure:
        raise type(failure)(f"{prefix}{failure}") from failure
    calibration, impossible = _without_impossible_efficiency(calibration)
    warnings = [*calibration.warnings, *_black_level_warnings(phase, calibration), *impossible]
    return replace(calibration, warnings=tuple(prefix + warning for warning in warnings))


def _without_impossible_efficiency(calibration: NoiseCalibration) -> tuple[NoiseCalibration, list[str]]:
    """Return a calibration without a quantum efficiency that is certainly above 100 %, and a warning if it was."""
    efficiency = calibration.estimates["quantum_efficiency"]
    if efficiency.value is None or efficiency.ci95 is None or efficiency.ci95[0] <= 1.0:
        return calibration, []
    why = (
        f"the flats hold {efficiency.value:.4g} electrons per stated photon (95 %: {efficiency.ci95[0]:.4g} to "
        f"{efficiency.ci95[1]:.4g}; limit 1): the photons, or the pixel area that they were computed with, are wrong, "
        "or the light is not the one that was measured; correct `photons` (the mean per pixel and exposure)"
    )
    estimates = {**calibration.estimates, "quantum_efficiency": Estimate(None, why=why)}
    return replace(calibration, estimates=estimates), [why]


def _black_level_warnings(phase: MosaicPhase, calibration: NoiseCalibration) -> list[str]:
    """Return a warning where masked pixels and covered ones disagree on the black level."""
    offset = calibration.estimates["offset_dn"]
    if not phase.black_dn or offset.value is None:
        return []
    black_dn = sum(phase.black_dn) / len(phase.black_dn)
    if abs(offset.value - black_dn) <= _BLACK_TOLERANCE_DN + 3 * (offset.se or 0.0):
        return []
    return [
        f"the darks' offset is {offset.value:.1f} DN, the black level stated in the files {black_dn:.1f} DN (at most "
        f"{_BLACK_TOLERANCE_DN:g} DN apart is usual); the lens was not quite covered, or the amplifier glows"
    ]


def _phase_record(phase: MosaicPhase, calibration: NoiseCalibration, emva: EmvaMeasurement) -> PhaseRecord:
    """Return the entry of one phase in noise.json."""
    return PhaseRecord(
        phase=phase.phase,
        colour=phase.colour,
        likelihood=str(calibration.likelihood),
        masked_black_dn=float(np.mean(phase.black_dn)) if phase.black_dn else None,
        fit=fit_record(calibration),
        emva1288=emva.record(),
        **_records({name: it for name, it in calibration.estimates.items() if _is_quantity(name)}),
    )


def _interleave(readout: Readout, parts: Sequence[NDArray[Any]], fill: float | bool) -> NDArray[Any]:
    """Return the phases' arrays interleaved to the size of a frame."""
    width, height = readout.size_px
    whole = np.full((height, width), fill, parts[0].dtype)
    region = whole[readout.rows, readout.columns]
    for phase, part in zip(readout.phases, parts, strict=True):
        phase.of(region)[...] = part
    return whole


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


def _records(estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    """Return the entries of estimates in noise.json."""
    return msgspec.convert(estimates, dict[str, Measured], from_attributes=True)


def _is_quantity(name: str) -> bool:
    """Return whether a quantity has a key of its own in noise.json."""
    return name in Quantities.__struct_fields__


def _saturation(phases: Sequence[NoiseCalibration]) -> Measured | float:
    """Return the value from which a pixel is saturated: of the phase that saturates first."""
    first = min(phases, key=lambda c: c.saturation_dn)
    if first.saturation.limit == "full well":
        return Measured(first.saturation_dn, ci95=first.saturation.interval_dn)
    return first.saturation_dn


def _covariance(calibrations: Sequence[NoiseCalibration]) -> CovarianceRecord:
    """Return names and matrix; of the phases' mean where there are several."""
    names = calibrations[0].covariance[0]
    if any(c.covariance[0] != names for c in calibrations):
        return CovarianceRecord([], [])
    matrix = np.sum([c.covariance[1] for c in calibrations], axis=0) / len(calibrations) ** 2
    return CovarianceRecord(list(names), matrix.tolist())


def _input_hashes(folder: Path, settings: NoiseSet) -> dict[str, str]:
    """Return the SHA-256 of the set's description and of its frames, by name."""
    described_in = FILE_NAME if (folder / FILE_NAME).is_file() else PLAN
    return {name: sha256(folder / name) for name in [described_in, *(frame.file for frame in settings.frame)]}
