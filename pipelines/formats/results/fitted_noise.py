"""The result of `faintfield noise` as a reconstruction takes it: the model with its maps, the mask, the response.

Reading it needs none of the fitting, which is heavy to load.
"""

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise_model import NoiseModel
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue

NOISE_FILE, NOISE_MAPS = "noise.json", "noise_maps.npz"

_NUMBERS = ("offset_dn", "gain_dn_per_e", "read_noise_e", "dark_current_e_per_s")


@dataclass(frozen=True)
class FittedNoise:
    """What a noise calibration says of a sensor.

    Attributes
    ----------
    model : NoiseModel
        With a map (row, column) of each quantity that has one.
    unusable : bool array (row, column)
        Hot, noisy and dead pixels.
    response : float array (row, column), optional
        Relative photo response, vignetting included; None when there were no flats.
    mosaic : tuple of str, optional
        Colour filters of the frames that were measured.
    """

    model: NoiseModel
    unusable: NDArray[np.bool_]
    response: NDArray[np.float32] | None
    mosaic: tuple[str, ...] | None = None


def read_fitted_noise(path: Path, size_px: tuple[int, int]) -> FittedNoise:
    """Read `noise.json`, and `noise_maps.npz` when it lies beside it.

    Raises
    ------
    BadValue
        The file is no noise result, is another camera's, or a number that a reconstruction needs is not known.
    ValueError
        A number is out of its range.
    """
    values, stated, hot, mosaic = _read_numbers(path)
    shape = size_px[::-1]
    outside = hot[((hot < 0) | (hot >= shape)).any(axis=1)]
    if len(outside):
        raise BadValue(
            f"{path}: hot pixel {outside[0].tolist()} is not one of {shape}; it seems to be another camera's; "
            "measure this one"
        )
    unusable = np.zeros(shape, bool)
    unusable[tuple(hot.T)] = True
    maps = _read_maps(path.with_name(NOISE_MAPS), (*_NUMBERS, "mask", "relative_response"), shape)
    unusable |= maps.pop("mask", False)
    response = maps.pop("relative_response", None)
    if response is not None:
        # A pixel without a response to speak of is masked already; the operator takes no negative ones
        response = np.where(unusable, 1, np.maximum(response, 0)).astype(np.float32)
    return FittedNoise(NoiseModel(**(values | maps), **stated), unusable, response, mosaic)


def _read_numbers(
    path: Path,
) -> tuple[dict[str, float], dict[str, float], NDArray[np.intp], tuple[str, ...] | None]:
    """Return the numbers that a reconstruction needs, those stated beside them, the hot pixels, and the mosaic."""
    try:
        fitted = json.loads(path.read_text())
        values = {name: fitted[name]["value"] for name in _NUMBERS}
        _assume_no_dark_current(path, fitted, values)
        missing = [name for name in _NUMBERS if values[name] is None]
        hot = np.array(fitted.get("hot_pixels") or np.empty((0, 2)), int).reshape(-1, 2)
        mosaic = tuple(str(row) for row in fitted.get("mosaic") or ()) or None
        optional = {key: fitted.get(key) for key in ("quantum_efficiency", "saturation_dn")}
        stated = {key: part["value"] if isinstance(part, dict) else part for key, part in optional.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as failure:
        raise BadValue(f"{path}: is not the result of `faintfield noise` ({failure!r}); run that again") from failure
    if missing:
        why = fitted[missing[0]].get("why", "no reason stated")
        raise BadValue(f"{path}: {missing[0]} is not known ({why}); record what it names, or state [noise] yourself")
    # An estimate near zero may fall below it; a dark current cannot.
    values["dark_current_e_per_s"] = max(values["dark_current_e_per_s"], 0.0)
    return values, {key: value for key, value in stated.items() if value is not None}, hot, mosaic


def _assume_no_dark_current(path: Path, fitted: dict[str, Any], values: dict[str, float]) -> None:
    """Take a dark current that the frames could not tell for none, as the calibration's own noise model does."""
    if values["dark_current_e_per_s"] is None:
        why = fitted["dark_current_e_per_s"].get("why", "no reason stated")
        inform(
            f"{path}: dark_current_e_per_s is not known ({why}); 0 is taken, which is right for short exposures only"
        )
        values["dark_current_e_per_s"] = 0.0


def _read_maps(path: Path, names: tuple[str, ...], shape: tuple[int, int]) -> dict[str, Any]:
    """Return those of the named maps (row, column) that the file has; none when there is no file."""
    if not path.is_file():
        return {}
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            maps = {name: file[name] for name in names if name in file}
    except (ValueError, TypeError, OSError, EOFError, zipfile.BadZipFile) as failure:
        raise BadValue(f"{path}: cannot be read ({failure}); run `faintfield noise` again") from failure
    for name, values in maps.items():
        if values.shape != shape:
            raise BadValue(
                f"{path}: {name} has shape {values.shape}, the camera {shape}; it seems to be another camera's; "
                "measure this one"
            )
    return maps
