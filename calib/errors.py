"""The failures of calibration, one tree: catch `CalibrationError` to catch them all.

CalibrationError
"""


class CalibrationError(Exception):
    """The measurements given cannot support the calibration asked for."""
