"""The failures of calibration form one tree: catch `CalibrationError` to catch them all.

CalibrationError
├── LensNotInvertible
├── MissingMrcal
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
    """The measurements do not support the requested calibration.

    All failures of calibration are of this class. Each message says what is wrong, the value and its limit, and after
    a semicolon what to do.

    Examples
    --------
    >>> from faintfield import CalibrationError, calibrate_noise
    >>> try:
    ...     calibrate_noise([])
    ... except CalibrationError as failure:
    ...     print(failure)
    no dark frames: the offset cannot be told from the light; record darks, lens covered
    """


class LensNotInvertible(CalibrationError):
    """The distortion folds the image onto itself within the detector."""


class MissingMrcal(CalibrationError):
    """mrcal, which solves for the geometry and reads camera models, is not installed."""


class NotIdentifiable(CalibrationError):
    """The measurements do not determine a quantity, and more of the same kind would not either."""


class TooFewFrames(NotIdentifiable):
    """Too few frames share the same conditions to separate noise from fixed pattern."""


class BadFrame(CalibrationError):
    """One frame differs from the others; the message names it."""


class CopiedFrame(BadFrame):
    """Two frames are identical in every pixel, which noise rules out."""


class LightLeak(BadFrame):
    """One dark frame is brighter than the others of its exposure."""


class SaturatedFlat(BadFrame):
    """All flats reach the end of the sensor's range, which clips their noise."""


class PoorFit(CalibrationError):
    """The measurements contradict the fitted model."""


class TooFewViews(CalibrationError):
    """Too few images show a target to determine the camera."""
