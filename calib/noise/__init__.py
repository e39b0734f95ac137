"""The noise of a sensor, measured from dark and flat frames; the physics is in docs/noise.md.

`SeriesSums` streams frames into sufficient statistics, `calibrate` turns those into numbers, maps and doubts, and
`cramer_rao` says how well it could be done at all.
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
