"""Measure the noise of a sensor from dark and flat frames; docs/noise.md describes the physics.

`SeriesSums` reduces frames to sufficient statistics, `calibrate` turns these into numbers, maps and warnings, and
`cramer_rao` returns the smallest errors that any unbiased method could reach.
"""

from faintfield.calib.noise.bounds import Sensor, cramer_rao
from faintfield.calib.noise.calibrate import calibrate
from faintfield.calib.noise.result import Estimate, NoiseCalibration, NoiseMaps, TransferPoint
from faintfield.calib.noise.statistics import Conditions, Series, SeriesSums, measure_series

__all__ = [
    "Conditions",
    "Estimate",
    "NoiseCalibration",
    "NoiseMaps",
    "Sensor",
    "Series",
    "SeriesSums",
    "TransferPoint",
    "calibrate",
    "cramer_rao",
    "measure_series",
]
