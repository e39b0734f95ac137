"""What `faintfield noise` writes: numbers as `noise.json` and maps as `noise_maps.npz`; docs/noise.md says of what."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise import Estimate, NoiseCalibration
from faintfield.pipelines.calibration.noise_frames import Readout
from faintfield.pipelines.formats.files import writing

STANDARD = "EMVA 1288 release 4.0"

# By the name of each map in the file: fill for pixels that were not calibrated, which are masked anyway.
_MAPS = {
    "offset_dn": 0.0,
    "offset_variance_dn2": 0.0,
    "dark_current_e_per_s": 0.0,
    "dark_current_variance_e2_per_s2": 0.0,
    "read_noise_e": 1.0,
    "relative_response": 1.0,
    "vignetting": 1.0,
}


def result_of(readout: Readout, calibrations: Sequence[NoiseCalibration]) -> dict[str, Any]:
    """Return the numbers of `noise.json`: of the sensor, and of each plane where there are several.

    Parameters
    ----------
    readout : Readout
        Where each plane's pixels lie.
    calibrations : sequence of NoiseCalibration
        One per plane.
    """
    result: dict[str, Any] = {"format": 1, "standard": STANDARD}
    result |= {name: _as_json(_mean([c.estimates[name] for c in calibrations])) for name in calibrations[0].estimates}
    result["covariance"] = _covariance(calibrations)
    result["likelihood"] = " / ".join(dict.fromkeys(str(c.likelihood) for c in calibrations))
    result["saturation_dn"] = readout.saturation_dn
    result["size_px"] = list(readout.size_px)
    if readout.mosaic is not None:
        result["mosaic"] = list(readout.mosaic)
        result["planes"] = [
            {
                "phase": list(plane.phase),
                "colour": plane.colour,
                "likelihood": str(c.likelihood),
                "masked_black_dn": float(np.mean(plane.black_dn)) if plane.black_dn else None,
            }
            | {name: _as_json(estimate) for name, estimate in c.estimates.items()}
            for plane, c in zip(readout.planes, calibrations, strict=True)
        ]
    for kind in ("hot", "noisy", "dead"):
        found = _assembled(readout, [getattr(c, kind) for c in calibrations], fill=False)
        result[f"{kind}_pixels"] = np.argwhere(found).tolist()
    return result


def maps_of(readout: Readout, calibrations: Sequence[NoiseCalibration]) -> dict[str, NDArray[Any]]:
    """Return the arrays of `noise_maps.npz` (row, column): float32 by the names in `NoiseMaps`, and the bool `mask`."""
    maps = {"mask": _assembled(readout, [c.maps.unusable for c in calibrations], fill=True)}
    for name, fill in _MAPS.items():
        parts = [getattr(c.maps, name) for c in calibrations]
        if all(part is not None for part in parts):
            maps[name] = _assembled(readout, parts, fill)
    gains = [c.estimates["gain_dn_per_e"].value for c in calibrations]
    if len(gains) > 1 and None not in gains:
        shape = calibrations[0].maps.offset_dn.shape
        maps["gain_dn_per_e"] = _assembled(readout, [np.full(shape, gain, np.float32) for gain in gains], fill=1.0)
    return maps


def write_maps(path: Path, maps: dict[str, NDArray[Any]]) -> None:
    """Write the maps, whole or not at all."""
    with writing(path) as file:
        np.savez_compressed(file, allow_pickle=False, **maps)


def _assembled(readout: Readout, parts: Sequence[NDArray[Any]], fill: float | bool) -> NDArray[Any]:
    """Return the planes' arrays interleaved to the size of a frame."""
    width, height = readout.size_px
    whole = np.full((height, width), fill, parts[0].dtype)
    region = whole[readout.rows, readout.columns]
    for plane, part in zip(readout.planes, parts, strict=True):
        plane.of(region)[...] = part
    return whole


def _mean(estimates: Sequence[Estimate]) -> Estimate:
    """Return the mean over planes, or the reason why one of them has no value."""
    if len(estimates) == 1:
        return estimates[0]
    unknown = next((estimate for estimate in estimates if estimate.value is None), None)
    if unknown is not None:
        return unknown
    count = len(estimates)
    value = sum(estimate.value or 0.0 for estimate in estimates) / count
    se = float(np.sqrt(sum((estimate.se or 0.0) ** 2 for estimate in estimates))) / count
    return Estimate(value, se, (value - 1.96 * se, value + 1.96 * se))


def _as_json(estimate: Estimate) -> dict[str, Any]:
    """Return the value with its uncertainty, or null with the reason."""
    if estimate.value is None:
        return {"value": None, "why": estimate.why}
    return {key: value for key, value in asdict(estimate).items() if value is not None}


def _covariance(calibrations: Sequence[NoiseCalibration]) -> dict[str, Any]:
    """Return names and matrix; of the planes' mean where there are several."""
    names = calibrations[0].covariance[0]
    if any(c.covariance[0] != names for c in calibrations):
        return {"names": [], "matrix": []}
    matrix = np.sum([c.covariance[1] for c in calibrations], axis=0) / len(calibrations) ** 2
    return {"names": list(names), "matrix": matrix.tolist()}
