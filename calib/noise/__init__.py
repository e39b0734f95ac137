"""Measure the noise of a sensor from dark and flat frames; docs/explanation/noise.md describes the physics.

`SeriesSums` reduces frames to sufficient statistics, and `calibrate` turns these into numbers, maps and warnings.
"""

from faintfield.calib.estimate import Estimate
from faintfield.calib.noise.calibrate import NoiseCalibration, calibrate
from faintfield.calib.noise.maps.measure import NoiseMaps
from faintfield.calib.noise.misfit import TransferPoint
from faintfield.calib.noise.series import Conditions, Series
from faintfield.calib.noise.sums import SeriesSums, measure_series

__all__ = [
    "Conditions",
    "Estimate",
    "NoiseCalibration",
    "NoiseMaps",
    "Series",
    "SeriesSums",
    "TransferPoint",
    "calibrate",
    "measure_series",
]
