"""The records of planes and reconstructions: one type per JSON file, for its writer, its readers and its tests.

Fields are named for sets in mm and electrons; their numbers are in the `units` that the record states, and the keys in
its file are named by these (`formats.units`).

Keys stand in a file in the order of the fields; a field that is UNSET is left out. Fields that reports, views and
exports can do without have defaults, so that results of earlier versions and those made by hand can be read.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from msgspec import UNSET, Meta, Struct, UnsetType

from faintfield.pipelines.arguments import Method as Method
from faintfield.pipelines.arguments import PriorName, SolverOptions
from faintfield.pipelines.formats.provenance import Provenance
from faintfield.pipelines.formats.units import StatedUnits

RECONSTRUCTION_FILE = "reconstruction.json"
DEPTH_MAP_FILE = "depth_map.json"
REPORT_FILE = "report.html"

# A file beside a record: one name, which cannot lead elsewhere or act on a terminal.
type FileName = Annotated[str, Meta(pattern=r"^(?!\.{1,2}\Z)[^/\\\x00-\x1f\x7f]+\Z", max_length=200)]

type Sha256 = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]

# Lengths of a plane, in mm from atoms to a thousand km: what is outside can only be damage.
type LengthMm = Annotated[float, Meta(ge=1e-6, le=1e9)]

# A depth is such a length, and positive unless it is stated as a disparity, see `check_depths`.
type DepthMm = Annotated[float, Meta(ge=-1e9, le=1e9)]

_LEAST_DEPTH = 1e-6

type Count = Annotated[int, Meta(ge=0, le=1_000_000)]

# Methods that reconstruct all planes together.
JOINT_METHODS: tuple[Method, ...] = ("joint", "occlusion")

# Where poses come from: as the set states them, measured, where the stage was told to go, or known to the simulator.
type Poses = Literal["stated", "measured", "aligned", "nominal", "true"]


def preview_name(name: str) -> str:
    """Return the name of the preview of a plane or a map."""
    return str(Path(name).with_suffix(".png"))


def record_name(name: str) -> str:
    """Return the name of the record that vouches for a plane."""
    return str(Path(name).with_suffix(".json"))


class Certificate(Struct, frozen=True, kw_only=True):
    """Convergence of an iteration; the keys depend on the method.

    Attributes
    ----------
    kind : str
        What the certificate states, in words.
    value : float
        PMLEM: bound on the relative distance to the optimum.
    stationarity, slack : float
        PMLEM: part of the bound from the gradient; PMLEM: part of the bound from the penalty and the limit at zero.
    tolerance : float
        Distance at which the iteration stops.
    reached : bool
        PMLEM: true if the bound is within the tolerance.
    passes : int
        Passes over the data.
    inner_steps : int
        PMLEM: steps of the inner problems, all together.
    relative_change : float
        One-step-late: change of the plane by the last pass. With a penalty of one's own: change still to expect.
    settled : bool
        True if the relative change is small enough to stop.
    oscillates : bool
        One-step-late: true if the plane swings between passes.
    kept_at_start : int
        One-step-late: number of samples that keep their first value, as too few pixels see them for this weight.
    """

    kind: str = ""
    value: float | UnsetType = UNSET
    stationarity: float | UnsetType = UNSET
    slack: float | UnsetType = UNSET
    tolerance: float | UnsetType = UNSET
    reached: bool | UnsetType = UNSET
    passes: int | UnsetType = UNSET
    inner_steps: int | UnsetType = UNSET
    relative_change: float | UnsetType = UNSET
    settled: bool | UnsetType = UNSET
    oscillates: bool | UnsetType = UNSET
    kept_at_start: int | UnsetType = UNSET

    @property
    def is_bound(self) -> bool:
        """Return whether `value` bounds the distance to the optimum."""
        return self.value is not UNSET


class WeightScore(Struct, frozen=True):
    """A penalty weight that was tried, and its score.

    Attributes
    ----------
    weight : float
        Penalty weight β.
    held_out : float
        Negative log-likelihood of the held-out views; the smallest is best.
    """

    weight: float
    held_out: float


class PenaltyRecord(Struct, frozen=True):
    """Penalty of a plane.

    Attributes
    ----------
    name : str
        Name of the penalty, such as "tv".
    smoothing_e : float
        δ: difference of neighbouring samples up to which "huber-tv" is quadratic, or the scale of "quadratic"; else 0.
    """

    name: str
    smoothing_e: float


class PriorRecord(Struct, frozen=True, kw_only=True):
    """Proposal of a prior for a plane, and its change by the data.

    Attributes
    ----------
    name : str
        Name of the prior.
    mixture : dict of dict of float
        Weights of the candidates, by region of the plane: with or without light and detail.
    moved_sigma : float
        Plane less proposal, rms, in standard deviations of the back-projection's noise.
    penalty_weight : float
        Weight of the penalty on the differences between plane and proposal.
    no_network : str
        Reason why the trained network has no part in the proposal.
    left_out : str
        Reason why the plane is that of total variation instead.
    """

    name: str
    mixture: dict[str, dict[str, float]] | UnsetType = UNSET
    moved_sigma: float | UnsetType = UNSET
    penalty_weight: float | UnsetType = UNSET
    no_network: str | UnsetType = UNSET
    left_out: str | UnsetType = UNSET


class SolveRecord(Struct, frozen=True, kw_only=True):
    """Solution of one colour of a plane: the middle part of `PlaneRecord`, which describes the fields."""

    penalty_weight: float | None
    penalty_weight_chosen: str
    epsilon_e2: float | None = None
    passes: int
    objective: float | None = None
    certificate: Certificate | None = None
    passes_before: float | UnsetType = UNSET
    penalty_weight_curve: list[WeightScore] | UnsetType | None = UNSET
    penalty: PenaltyRecord | UnsetType = UNSET
    likelihood: str | UnsetType = UNSET
    occlusion: bool | UnsetType = UNSET
    occlusion_left_out: str | UnsetType = UNSET
    prior: PriorRecord | UnsetType = UNSET


class PlaneRecord(Struct, frozen=True, kw_only=True):
    """One colour of one plane, in reconstruction.json and in the plane's own record.

    Attributes
    ----------
    name : str, optional
        Name of a plane that is given by a pose.
    depth_mm : float
        Depth at which the axis of the reference camera meets the plane.
    rt_ref_plane : tuple of float, optional
        Pose of the plane, Rodrigues vector in rad and translation in the unit of the poses of the set, from the plane's
        frame to the reference camera's.
    method : str
        Method of the reconstruction.
    channel : str
        Colour of the plane.
    file : str
        Name of the TIFF with the light of the samples.
    shape : (int, int)
        Rows and columns.
    pitch_mm : float
        Distance between neighbouring samples.
    origin_mm : (float, float)
        x and y of the first sample's centre on the plane.
    penalty_weight : float, optional
        Penalty weight β; null if the method has none.
    penalty_weight_chosen : str
        How the weight was chosen, in words.
    epsilon_e2 : float, optional
        ε of eq. (3), the smoothing of total variation by one-step-late iterations; null for other methods.
    passes : int
        Passes over the data.
    objective : float, optional
        Negative log-likelihood plus weighted penalty; null for a back-projection.
    certificate : Certificate, optional
        Convergence of the iteration; null for a back-projection.
    mean_e : float
        Mean light of the samples per detector pixel of the reference view.
    saturated_share, unknown_share : float, optional
        Share of saturated pixels in all views; share of the samples, NaN, that mostly saturated pixels see.
    passes_before : float, optional
        Passes over the data before the iteration: for its start, its weight and its prior.
    penalty_weight_curve : list of WeightScore, optional
        Weights that were tried; null if the weight was not chosen by held-out views.
    penalty : PenaltyRecord, optional
        Penalty of the plane.
    likelihood : str, optional
        Name of the noise model of a pixel.
    occlusion : bool, optional
        True if planes hide those behind them; false if this did not explain the images better.
    occlusion_left_out : str, optional
        Reason why no plane hides another.
    prior : PriorRecord, optional
        Prior of the plane.
    flux_e : float
        Light of the whole plane in one view: the sum over its samples, weighted by their area in detector pixels.
    sigma_file : str, optional
        Name of the TIFF with the standard deviation of each sample.
    opacity_file : str, optional
        Name of the TIFF with the opacity of each sample, 0 to 1.
    proposal_file : str, optional
        Name of the TIFF with the light that the prior proposed.
    moved_file : str, optional
        Name of the TIFF with plane less proposal, in standard deviations of the back-projection's noise.
    """

    name: str | UnsetType = UNSET
    depth_mm: DepthMm
    rt_ref_plane: tuple[float, float, float, float, float, float] | UnsetType = UNSET
    method: Method
    channel: str
    file: FileName
    shape: tuple[Count, Count] = (0, 0)
    pitch_mm: LengthMm
    origin_mm: tuple[float, float] = (0.0, 0.0)
    penalty_weight: float | None
    penalty_weight_chosen: str
    epsilon_e2: float | None = None
    passes: int
    objective: float | None = None
    certificate: Certificate | None
    mean_e: float = math.nan
    saturated_share: float | UnsetType = UNSET
    unknown_share: float | UnsetType = UNSET
    passes_before: float | UnsetType = UNSET
    penalty_weight_curve: list[WeightScore] | UnsetType | None = UNSET
    penalty: PenaltyRecord | UnsetType = UNSET
    likelihood: str | UnsetType = UNSET
    occlusion: bool | UnsetType = UNSET
    occlusion_left_out: str | UnsetType = UNSET
    prior: PriorRecord | UnsetType = UNSET
    flux_e: float
    sigma_file: FileName | UnsetType = UNSET
    opacity_file: FileName | UnsetType = UNSET
    proposal_file: FileName | UnsetType = UNSET
    moved_file: FileName | UnsetType = UNSET

    @property
    def prior_name(self) -> str | UnsetType:
        """Name of the prior, else of the penalty; unset where nothing is penalised."""
        if self.prior is not UNSET:
            return self.prior.name
        if self.penalty is not UNSET:
            return self.penalty.name
        return "tv" if self.penalty_weight else UNSET

    @property
    def files(self) -> list[str]:
        """Names of the files of this plane, beside the record."""
        sidecars = (self.sigma_file, self.opacity_file, self.proposal_file, self.moved_file)
        return [self.file, *(name for name in sidecars if name is not UNSET)]


def check_depths(planes: Sequence[PlaneRecord], units: StatedUnits | UnsetType) -> None:
    """Refuse depths that are none, unless they are stated as disparities (ValueError)."""
    if (units or StatedUnits()).depth != "disparity_px" and any(plane.depth_mm < _LEAST_DEPTH for plane in planes):
        raise ValueError(f"a depth is below {_LEAST_DEPTH:g}")


class FocusPoint(Struct, frozen=True):
    """Focus of one colour of a plane.

    Attributes
    ----------
    detail_e2, sigma_e2 : float
        Power of the detail that two halves of the views share; standard deviation of `detail_e2`.
    """

    detail_e2: float
    sigma_e2: float


class FocusCurve(Struct, frozen=True, kw_only=True):
    """Focus against depth, and the depths at which it peaks.

    Attributes
    ----------
    depth_mm : list of float
        Depths of the planes.
    detail_e2, sigma_e2 : list of float
        Power of the detail that two halves of the views share, by plane; standard deviation of `detail_e2`.
    sharp_mm : list of float
        Depths at which the power peaks.
    """

    depth_mm: list[float]
    detail_e2: list[float]
    sigma_e2: list[float] | UnsetType = UNSET
    sharp_mm: list[float]

    def __post_init__(self) -> None:
        lengths = {len(self.depth_mm), len(self.detail_e2), len(self.sigma_e2 or self.depth_mm)}
        if len(lengths) > 1 or 0 in lengths:
            raise ValueError(f"the focus curve has {sorted(lengths)} depths and values")


class BestFocusRecord(Struct, frozen=True):
    """Search by `--depth auto` for depths of best focus.

    Attributes
    ----------
    depth_mm : list of float
        Depths of best focus.
    searched_mm : list of (float, float)
        Nearest and farthest depth of each search, the coarsest first.
    depths_per_search : int
        Number of depths that each search compares.
    bins_px : int
        Width in detector pixels of the bins of the last search.
    share_of_sure : list of float
        Share of the sure samples that are at each depth of best focus.
    sure_of_lit : float, optional
        Share of the samples with light whose depth is sure.
    p_value : float, optional
        Probability of such agreement by chance: (1 + the shuffles that agree as well)/(1 + `shuffles`).
    z_shuffled : float, optional
        Standard deviations of the shuffled views by which the stated places agree better than their mean.
    shuffles : int, optional
        Number of times that the views were shuffled among their places.
    """

    depth_mm: list[float]
    searched_mm: list[tuple[float, float]]
    depths_per_search: int
    bins_px: int
    share_of_sure: list[float]
    sure_of_lit: float | UnsetType = UNSET
    p_value: float | UnsetType = UNSET
    z_shuffled: float | UnsetType = UNSET
    shuffles: int | UnsetType = UNSET


class DepthMapRecord(Struct, frozen=True):
    """The maps of a sweep: their files, unit and how much of them is known.

    Attributes
    ----------
    file : str
        Name of the TIFF with the depth or disparity of each sample, NaN where it is not sure.
    confidence : str
        Name of the TIFF with the probability of each depth.
    all_in_focus : str
        Name of the TIFF with the light of each sample at its depth.
    unit : {"mm", "px", "relative"}
        Unit of the map: mm, px of disparity, or the unit of the poses.
    bins_px : int
        Width in detector pixels of the bins in which views were compared.
    sure_above : float
        Probability from which on a depth counts as sure.
    sure_share : float
        Share of the samples whose depth is sure.
    median : float, optional
        Median of the sure depths; null without any.
    share_of_sure : list of float, optional
        Share of the sure samples at each depth that stands out.
    sure_of_lit : float, optional
        Share of the samples with light whose depth is sure.
    """

    file: FileName
    confidence: FileName
    all_in_focus: FileName
    unit: Literal["mm", "px", "relative"]
    bins_px: int
    sure_above: float
    sure_share: float
    median: float | None = None
    share_of_sure: list[float] | UnsetType = UNSET
    sure_of_lit: float | UnsetType = UNSET

    @property
    def files(self) -> list[str]:
        """Names of the maps, beside the record, each with a preview."""
        return [self.file, self.confidence, self.all_in_focus]


@dataclass(frozen=True, kw_only=True)
class _Planes:
    method: Method | UnsetType = UNSET
    depth_mm: list[float] | UnsetType = UNSET


@dataclass(frozen=True, kw_only=True)
class ReconstructionOptions(SolverOptions, _Planes):
    """The options of `faintfield reconstruct` as they took effect.

    Attributes
    ----------
    method : str
        Method of the reconstruction.
    depth_mm : list of float
        Depths of the planes.
    pitch_mm : float, optional
        Distance between samples; null: one detector pixel of the reference view at each depth.
    focus : bool
        True if focus was measured.
    auto_sweep : int, optional
        Number of the last depths that are those of `--sweep auto`.
    depth_map : {"mm", "px", "relative"}, optional
        Unit of the depth map; null without one.
    plane_pose : dict of list of float
        Poses of tilted planes by name: Rodrigues vector, translation, then width and height if they are stated.
    poses : {"stated", "measured", "aligned", "nominal", "true"}
        Source of the poses: the set, boards, the views, the commanded places, or the simulator.
    """

    prior: PriorName | UnsetType | None = UNSET  # type: ignore[assignment]
    proposal: bool | UnsetType = UNSET  # type: ignore[assignment]
    pitch_mm: float | UnsetType | None = UNSET
    focus: bool | UnsetType = UNSET
    auto_sweep: Count | UnsetType = UNSET
    depth_map: Literal["mm", "px", "relative"] | UnsetType | None = UNSET
    plane_pose: dict[str, list[float]] | UnsetType = UNSET
    poses: Poses = "stated"


class PlaneFileRecord(Provenance[ReconstructionOptions], frozen=True):
    """The record beside a plane (`plane_00500.0.json`), with the SHA-256 of its files.

    Attributes
    ----------
    format : 1
        Version of the format.
    planes : list of PlaneRecord
        The colours of the plane.
    focus : list of FocusPoint, optional
        Focus of each colour; null if it was not measured.
    sha256 : dict of str
        SHA-256 of each file beside the record, by its name.
    """

    format: Literal[1]
    planes: list[PlaneRecord]
    focus: list[FocusPoint | None]
    sha256: dict[FileName, Sha256]

    def __post_init__(self) -> None:
        check_depths(self.planes, self.units)

    @property
    def files(self) -> list[str]:
        """Names of the files of the plane, beside the record."""
        return [name for plane in self.planes for name in plane.files]


class DepthMapFileRecord(Provenance[ReconstructionOptions], frozen=True):
    """`depth_map.json`, with the SHA-256 of the maps beside it.

    Attributes
    ----------
    format : 1
        Version of the format.
    depth_map : DepthMapRecord
        The maps.
    sha256 : dict of str
        SHA-256 of each file beside the record, by its name.
    """

    format: Literal[1]
    depth_map: DepthMapRecord
    sha256: dict[FileName, Sha256]

    @property
    def files(self) -> list[str]:
        """Names of the maps, beside the record."""
        return self.depth_map.files


class ReconstructionRecord(Struct, frozen=True, kw_only=True):
    """`reconstruction.json`: all planes of one method, and their `Provenance`.

    Attributes
    ----------
    format : 1
        Version of the format.
    planes : list of PlaneRecord
        Each colour of each plane.
    focus : FocusCurve, optional
        Focus curve of a sweep.
    best_focus : BestFocusRecord, optional
        Search for depths of best focus.
    depth_map : DepthMapRecord, optional
        Maps of a sweep.
    wall_time_s : float
        Time that the command took.
    units : StatedUnits, optional
        Units in which the result is stated; without them mm, electrons and s.
    command : str
        Name of the command that made the result.
    options : ReconstructionOptions
        Options of the command as they took effect.
    inputs : dict of str
        SHA-256 of each file that was read, by its name.
    versions : dict of str
        Versions of Python and of the packages that computed the result.
    """

    format: Literal[1] = 1
    planes: Annotated[list[PlaneRecord], Meta(min_length=1)]
    focus: FocusCurve | None = None
    best_focus: BestFocusRecord | None = None
    depth_map: DepthMapRecord | None = None
    wall_time_s: float
    units: StatedUnits | UnsetType = UNSET
    command: str = "reconstruct"
    options: ReconstructionOptions
    inputs: dict[str, str]
    versions: dict[str, str]

    def __post_init__(self) -> None:
        check_depths(self.planes, self.units)

    @property
    def files(self) -> list[str]:
        """Names of the files that it lists, beside it."""
        maps = self.depth_map.files if self.depth_map else []
        return [*dict.fromkeys(name for plane in self.planes for name in plane.files), *maps, *map(preview_name, maps)]
