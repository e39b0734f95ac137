"""An independent simulation of a sensor in the dark, for the tests of the noise calibration."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise import Conditions, Series, measure_series

Frames = list[tuple[str, NDArray[np.uint16]]]

EXPOSURES_S = (0.1, 1.0, 10.0, 60.0)
TRUTH = {"gain_dn_per_e": 2.0, "read_noise_e": 12.0**0.5, "dark_current_e_per_s": 0.2}


@dataclass(frozen=True)
class Sensor:
    """The camera of Stern, Aloni and Javidi, unless told otherwise; every field is a truth to be found again."""

    shape: tuple[int, int] = (64, 64)
    offset_dn: float = 100.0
    gain_dn_per_e: float | NDArray[np.float64] = 2.0
    read_noise_e: float | NDArray[np.float64] = 12.0**0.5
    dark_current_e_per_s: float = 0.2
    dsnu_e: float = 1.5
    dcnu: float = 0.0
    jitter_dn: float = 0.0
    banding_dn: float = 0.0
    hot_fraction: float = 0.0
    prnu: float = 0.0
    bend_per_dn: float = 0.0
    quantum_efficiency: float = 0.5
    well_e: float = np.inf  # mean over the pixels, which differ by 3 %
    ceiling_dn: float = 65535.0
    jump_e: float | NDArray[np.float64] = 0.0  # of pixels that are up in half of the frames


@dataclass(frozen=True)
class Chip:
    """One specimen of a sensor: the numbers that its pixels were born with."""

    sensor: Sensor
    offset_dn: NDArray[np.float64]
    dark_current_e_per_s: NDArray[np.float64]
    response: NDArray[np.float64]
    hot: NDArray[np.bool_]
    well_e: NDArray[np.float64] | float


def make_chip(sensor: Sensor, rng: np.random.Generator) -> Chip:
    shape = sensor.shape
    hot = rng.random(shape) < sensor.hot_fraction
    dark = sensor.dark_current_e_per_s * np.maximum(1 + sensor.dcnu * rng.standard_normal(shape), 0)
    return Chip(
        sensor,
        sensor.offset_dn + sensor.gain_dn_per_e * sensor.dsnu_e * rng.standard_normal(shape),
        np.where(hot, dark + rng.uniform(1.0, 30.0, shape), dark),
        1 + sensor.prnu * rng.standard_normal(shape),
        hot,
        sensor.well_e if np.isinf(sensor.well_e) else sensor.well_e * (1 + 0.03 * rng.standard_normal(shape)),
    )


def expose(chip: Chip, exposure_s: float, rng: np.random.Generator, photons: float = 0.0) -> NDArray[np.uint16]:
    """Take one frame (row, column), in DN."""
    sensor = chip.sensor
    mean_e = chip.dark_current_e_per_s * exposure_s + sensor.quantum_efficiency * photons * chip.response
    signal_e = np.minimum(rng.poisson(mean_e), chip.well_e) + rng.normal(0, sensor.read_noise_e, sensor.shape)
    if np.any(sensor.jump_e):
        signal_e += sensor.jump_e * (rng.random(sensor.shape) < 0.5)
    signal_dn = sensor.gain_dn_per_e * signal_e
    if sensor.bend_per_dn:
        # The charge e makes the signal s with e·g = s (1 + κ s).
        signal_dn = (np.sqrt(1 + 4 * sensor.bend_per_dn * signal_dn) - 1) / (2 * sensor.bend_per_dn)
    dn = chip.offset_dn + signal_dn + sensor.jitter_dn * rng.standard_normal()
    dn += sensor.banding_dn * rng.standard_normal((sensor.shape[0], 1))
    return np.clip(np.rint(dn), 0, sensor.ceiling_dn).astype(np.uint16)


def darks(chip: Chip, exposures_s: Sequence[float], frames: int, rng: np.random.Generator) -> dict[float, Frames]:
    """Take `frames` darks of each exposure."""
    return {t: [(f"dark_{t:g}s_{k}", expose(chip, t, rng)) for k in range(frames)] for t in exposures_s}


def dark_series(chip: Chip, exposures_s: Sequence[float], frames: int, rng: np.random.Generator) -> list[Series]:
    """Measure `frames` darks of each exposure."""
    return [measure_series(named, Conditions("dark", t)) for t, named in darks(chip, exposures_s, frames, rng).items()]


def flat_series(
    chip: Chip,
    photons: float,
    frames: int,
    rng: np.random.Generator,
    *,
    level: int = 0,
    exposure_s: float = 0.1,
    stated: bool = True,
) -> Series:
    """Measure flats of one light level, which is stated in photons per pixel or not."""
    named = [(f"flat_{level}_{k}", expose(chip, exposure_s, rng, photons)) for k in range(frames)]
    return measure_series(named, Conditions("flat", exposure_s, level, photons if stated else None))


def with_flats(
    chip: Chip,
    rng: np.random.Generator,
    photons: Sequence[float] = (8000.0,),
    exposures_s: Sequence[float] = EXPOSURES_S,
    frames: int = 10,
    dark_frames: int = 10,
) -> list[Series]:
    """Measure darks of each exposure, and flats of each light level."""
    series = dark_series(chip, exposures_s, dark_frames, rng)
    return [*series, *(flat_series(chip, light, frames, rng, level=level) for level, light in enumerate(photons))]


def specimen(seed: int | np.random.Generator, **changes: object) -> tuple[Chip, np.random.Generator]:
    """Make a chip of the paper's camera with some fields changed, and the generator to expose it with."""
    rng = np.random.default_rng(seed)
    return make_chip(replace(Sensor(), **changes), rng), rng  # type: ignore[arg-type] # fields are named by the test
