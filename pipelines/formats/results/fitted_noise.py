"""The result of `faintfield noise` as a reconstruction takes it: the model with its maps, the mask, the response."""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise_model import NoiseModel
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.results.noise import NOISE_MAPS, Measured, NoiseRecord, read_noise

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
    record = read_noise(path)
    values = _numbers(path, record)
    shape = size_px[::-1]
    hot = np.array(record.hot_pixels, int).reshape(-1, 2)
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
        # Pixels with no response are masked already; the operator takes no negative one
        response = np.where(unusable, 1, np.maximum(response, 0)).astype(np.float32)
    stated = {name: _value(getattr(record, name)) for name in ("quantum_efficiency", "saturation_dn")}
    model = NoiseModel(**(values | maps), **{name: value for name, value in stated.items() if value is not None})
    return FittedNoise(model, unusable, response, record.mosaic or None)


def _numbers(path: Path, record: NoiseRecord) -> dict[str, float]:
    """Return the numbers that a reconstruction needs; an unknown dark current counts as none."""
    values: dict[str, float] = {}
    for name in _NUMBERS:
        measured: Measured = getattr(record, name)
        why = measured.why or "no reason stated"
        if measured.value is not None:
            values[name] = measured.value
        elif name == "dark_current_e_per_s":
            inform(f"{path}: {name} is not known ({why}); 0 is taken, which is right for short exposures only")
            values[name] = 0.0
        else:
            raise BadValue(f"{path}: {name} is not known ({why}); record what it names, or state [noise] yourself")
    # An estimate near zero may fall below it; a dark current cannot.
    values["dark_current_e_per_s"] = max(values["dark_current_e_per_s"], 0.0)
    return values


def _value(stated: Measured | float | None) -> float | None:
    """Return a number that may be written with or without its error."""
    return stated.value if isinstance(stated, Measured) else stated


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
