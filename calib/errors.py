"""The failures of calibration, one tree: catch `CalibrationError` to catch them all.

CalibrationError
├── LensNotInvertible
├── NotIdentifiable
├── PoorFit
└── TooFewViews
"""


class CalibrationError(Exception):
    """The measurements given cannot support the calibration asked for."""


class LensNotInvertible(CalibrationError):
    """The distortion folds the image over itself within the detector."""


class NotIdentifiable(CalibrationError):
    """The measurements cannot tell the quantity asked for, however many of the same kind are taken."""


class PoorFit(CalibrationError):
    """A model was fitted, and the measurements contradict it."""


class TooFewViews(CalibrationError):
    """Too few images of a target were found to determine the camera."""
