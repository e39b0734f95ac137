"""The failures of calibration, one tree: catch `CalibrationError` to catch them all.

CalibrationError
├── LensNotInvertible
├── NotIdentifiable
│   └── TooFewFrames
├── BadFrame
│   ├── CopiedFrame
│   ├── LightLeak
│   └── SaturatedFlat
├── PoorFit
└── TooFewViews
"""


class CalibrationError(Exception):
    """The measurements given cannot support the calibration asked for."""


class LensNotInvertible(CalibrationError):
    """The distortion folds the image over itself within the detector."""


class NotIdentifiable(CalibrationError):
    """The measurements cannot tell the quantity asked for, however many of the same kind are taken."""


class TooFewFrames(NotIdentifiable):
    """Too few frames were taken under the same conditions to tell noise from a fixed pattern."""


class BadFrame(CalibrationError):
    """One frame does not belong with the others; the message names it."""


class CopiedFrame(BadFrame):
    """Two frames are identical, pixel for pixel, which noise never allows."""


class LightLeak(BadFrame):
    """One dark frame is brighter than the others of its exposure."""


class SaturatedFlat(BadFrame):
    """A flat frame reaches the end of the sensor's range, where its noise is cut off."""


class PoorFit(CalibrationError):
    """A model was fitted, and the measurements contradict it."""


class TooFewViews(CalibrationError):
    """Too few images of a target were found to determine the camera."""
