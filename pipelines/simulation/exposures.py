"""Frames of a set exposed by a simulated sensor, and the noise that the set states."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.sets.elemental_file import Noise
from faintfield.pipelines.formats.sets.elemental_set import NOISE_REFERENCE
from faintfield.rig.simulation.optics import SimulatedSensor


def stated_noise(sensor: SimulatedSensor) -> Noise:
    """Return the `[noise]` table of a set taken with a sensor."""
    return Noise(
        gain_dn_per_e=sensor.gain_dn_per_e,
        read_noise_e=sensor.read_noise_e,
        offset_dn=sensor.offset_dn,
        dark_current_e_per_s=sensor.dark_current_e_per_s,
        quantum_efficiency=sensor.quantum_efficiency,
        saturation_dn=float(sensor.saturation_dn),
    )


def write_exposures(
    folder: Path,
    names: Iterable[str],
    signal_e: Iterable[NDArray[np.floating]],
    sensor: SimulatedSensor,
    exposure_s: float,
    generator: np.random.Generator,
) -> None:
    """Expose every view and write it under its name; an exposure without light is the noise reference.

    Parameters
    ----------
    signal_e : iterable of array (row, column)
        Expected photoelectrons of each view.
    """
    for name, view_e in zip(names, signal_e, strict=True):
        write_frame(folder / name, sensor.expose(view_e / sensor.quantum_efficiency, exposure_s, generator))
    write_frame(folder / NOISE_REFERENCE, sensor.expose(np.zeros_like(view_e), exposure_s, generator))
