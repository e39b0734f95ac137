"""The failures of calibration, one tree: catch `CalibrationError` to catch them all.

CalibrationError
└── LensNotInvertible
"""


class CalibrationError(Exception):
    """The measurements given cannot support the calibration asked for."""


class LensNotInvertible(CalibrationError):
    """The distortion folds the image over itself within the detector."""
