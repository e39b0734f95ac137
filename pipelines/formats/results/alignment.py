"""The record of poses that were found by the views, a `geometry.json` with `source = "views"`, and its page."""

from msgspec import UNSET, Struct, UnsetType

from faintfield.pipelines.formats.results.geometry import CameraPoses
from faintfield.pipelines.formats.results.records import Poses
from faintfield.pipelines.formats.units import Node, StatedUnits

ALIGNMENT_PAGE = "alignment.html"


class ViewChange(Struct, frozen=True):
    """By how much the picture of a view moves with its new pose, at the middle depth, and by its last step.

    `shift_px` is the mean shift right and down, `turn_rad` the turn about the axis, and `left_px` the rms of what the
    last round still moved.
    """

    node: Node
    shift_px: tuple[float, float]
    turn_rad: float
    left_px: float


class HeldOutGain(Struct, frozen=True):
    """Log-likelihood of held-out pixels at the new poses less that at the old ones, and its standard error.

    `by_gradient`: its slope along a first step from the old poses, found without the part that is held out.
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
    """Standard deviations of the rotations and translations of a node."""

    sigma_rad: float
    sigma_mm: float


class LensChange(Struct, frozen=True):
    """Relative change of the focal length and change of the first distortion term, each with its σ."""

    focal_length: float
    focal_length_sigma: float
    distortion: float
    distortion_sigma: float


class AlignmentOptions(Struct, frozen=True):
    """The options of `faintfield align` as they took effect."""

    depth_mm: tuple[float, ...]
    depth_range_mm: tuple[float, float] | None
    position_error_mm: float
    rotation_error_mrad: float
    poses: Poses
    with_lens: bool = False


class AlignmentRecord(CameraPoses, frozen=True, kw_only=True):
    """`geometry.json` of poses by the views.

    `errors_assumed` are those of the old poses before the views were looked at, `errors_found` as the views tell them;
    `dispersion` is by how much the views scatter more than their noise, which the sigmas count.
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
