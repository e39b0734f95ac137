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
    """The distortion folds the image onto itself within the detector.

    Correct the signs and the order (k1, k2, p1, p2, k3 …) of numbers typed by hand. If a calibration found them, move
    boards into the corners of the image, or use a simpler `--lens`.
    """


class MissingMrcal(CalibrationError):
    """mrcal, which solves for the geometry and reads camera models, is not installed.

    The message gives the `pip install` command.
    """


class NotIdentifiable(CalibrationError):
    """The measurements do not determine a quantity, and more of the same kind would not either.

    The message says what to add: flats, longer darks; boards, tilts, distances.
    """


class TooFewFrames(NotIdentifiable):
    """Too few frames share the same conditions to separate noise from fixed pattern.

    Record two of each kind at least; ten are better.
    """


class BadFrame(CalibrationError):
    """One frame differs from the others; the message names it.

    Look at it; leave it out or take it again.
    """


class CopiedFrame(BadFrame):
    """Two frames are identical in every pixel, which noise rules out.

    The program saved one frame twice; take it again.
    """


class LightLeak(BadFrame):
    """One dark frame is brighter than the others of its exposure.

    Cover lens and viewfinder, record again.
    """


class SaturatedFlat(BadFrame):
    """All flats reach the end of the sensor's range, which clips their noise.

    Expose shorter, or dim the light.
    """


class PoorFit(CalibrationError):
    """The measurements contradict the fitted model.

    Check the lens cap, node numbers, flatness, and whether a board moved within a sweep; try `--lens opencv8`.
    """


class TooFewViews(CalibrationError):
    """Too few images show a target to determine the camera.

    Compare `[[board]]` with the print; check exposure and view.
    """
