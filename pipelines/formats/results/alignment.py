"""The record of poses that were found by the views, a `geometry.json` with `source = "views"`, and its page."""

from msgspec import UNSET, Struct, UnsetType

from faintfield.pipelines.formats.results.geometry import CameraPoses
from faintfield.pipelines.formats.results.records import Poses
from faintfield.pipelines.formats.units import Node, StatedUnits

ALIGNMENT_PAGE = "alignment.html"


class ViewChange(Struct, frozen=True):
    """Change of a view by its new pose, seen in its picture at the middle depth.

    Attributes
    ----------
    node : (int, int)
        Row and column of the node.
    shift_px : (float, float)
        Mean shift of the picture, right and down.
    turn_rad : float
        Turn of the camera about its axis.
    left_px : float
        Shift by the step of the last round, rms over the picture.
    """

    node: Node
    shift_px: tuple[float, float]
    turn_rad: float
    left_px: float


class HeldOutGain(Struct, frozen=True):
    """Log-likelihood of held-out pixels at the new poses less that at the old ones.

    Attributes
    ----------
    value, sigma : float
        The gain; standard error of `value`.
    patches : int
        Number of patches of the scene whose scatter gives the standard error.
    by_gradient : bool
        True if the value is the slope along a first step from the old poses, found without the part that is held out.
    """

    value: float
    sigma: float
    patches: int
    by_gradient: bool = False

    @property
    def text(self) -> str:
        """The gain in standard errors."""
        along = " of the slope along a first step" if self.by_gradient else ""
        return f"{self.value / self.sigma if self.sigma else 0:.1f} standard errors{along}"


class PoseErrors(Struct, frozen=True):
    """Standard deviations of the poses.

    Attributes
    ----------
    sigma_rad, sigma_mm : float
        Standard deviation of the rotation about each axis; standard deviation of the translation along each axis.
    """

    sigma_rad: float
    sigma_mm: float


class LensChange(Struct, frozen=True):
    """Change of the lens, each number with its standard deviation.

    Attributes
    ----------
    focal_length, focal_length_sigma : float
        Relative change of the focal length; standard deviation of `focal_length`.
    distortion, distortion_sigma : float
        Change of the first distortion coefficient; standard deviation of `distortion`.
    """

    focal_length: float
    focal_length_sigma: float
    distortion: float
    distortion_sigma: float


class AlignmentOptions(Struct, frozen=True):
    """The options of `faintfield align` as they took effect.

    Attributes
    ----------
    depth_mm : tuple of float
        Depths of the planes that hold the scene; empty if depths were searched for.
    depth_range_mm : (float, float), optional
        Nearest and farthest depth of the search; null if the range was found in the views.
    position_error_mm, rotation_error_mrad : float
        Standard deviation of the old positions; standard deviation of the old rotations.
    poses : {"stated", "measured", "aligned", "nominal", "true"}
        Source of the old poses.
    with_lens : bool
        True if focal length and first distortion coefficient were found, too.
    """

    depth_mm: tuple[float, ...]
    depth_range_mm: tuple[float, float] | None
    position_error_mm: float
    rotation_error_mrad: float
    poses: Poses
    with_lens: bool = False


class AlignmentRecord(CameraPoses, frozen=True, kw_only=True):
    """`geometry.json` of poses by the views. Lengths are in the unit of the poses, mm if their scale is known.

    Attributes
    ----------
    views : list of ViewChange
        Change of each view.
    lens_change : LensChange, optional
        Change of the lens, if it was to be found.
    gain : HeldOutGain
        Gain of the new poses on held-out pixels.
    errors_assumed, errors_found : PoseErrors
        Errors of the old poses that were assumed beforehand; errors of the old poses that the views show.
    dispersion : float
        Variance of the gradient of the likelihood over that of the noise alone, at least 1; the sigmas count it.
    rounds : int
        Number of rounds.
    bins_px : int
        Width in detector pixels of the bins of the finest pictures.
    transfer_sigma_px : dict of float
        Standard deviation of a point that is transferred between views, at the nearest and the farthest depth; rms over
        views and image.
    units : StatedUnits, optional
        Units of the set.
    command : str
        Name of the command that made the result.
    options : AlignmentOptions
        Options of the command as they took effect.
    inputs : dict of str
        SHA-256 of each file that was read, by its name.
    versions : dict of str
        Versions of Python and of the packages that computed the result.
    sha256 : dict of str, optional
        SHA-256 of each file beside the record, by its name.
    """

    views: list[ViewChange]
    lens_change: LensChange | UnsetType = UNSET
    gain: HeldOutGain
    errors_assumed: PoseErrors
    errors_found: PoseErrors
    dispersion: float
    rounds: int
    bins_px: int
    transfer_sigma_px: dict[str, float]
    units: StatedUnits | UnsetType = UNSET
    command: str
    options: AlignmentOptions
    inputs: dict[str, str]
    versions: dict[str, str]
    sha256: dict[str, str] | UnsetType = UNSET
