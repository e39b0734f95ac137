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
    """Convergence of an iteration.

    PMLEM to its optimum: `value` bounds the relative distance to the optimum (`stationarity` and `slack` are its
    parts), and `reached` says whether it is below `tolerance`. One-step-late: `relative_change` of the last pass.
    With a penalty of one's own: `relative_change` still to expect, and whether it has `settled` below the tolerance.
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
    """A penalty weight that was tried: the negative log-likelihood of the held-out views."""

    weight: float
    held_out: float


class PenaltyRecord(Struct, frozen=True):
    """The penalty, with its smoothing in electrons."""

    name: str
    smoothing_e: float


class PriorRecord(Struct, frozen=True, kw_only=True):
    """Proposal of a prior for a plane, and its change by the data.

    `mixture` has the weights of the candidates by region, with or without light and detail. `moved_sigma` is the root
    mean square of plane less proposal, in standard deviations of the back-projection's noise, and `penalty_weight` the
    weight of their differences. `no_network` says why the trained network has no part in it, `left_out` why the plane
    is that of total variation instead.
    """

    name: str
    mixture: dict[str, dict[str, float]] | UnsetType = UNSET
    moved_sigma: float | UnsetType = UNSET
    penalty_weight: float | UnsetType = UNSET
    no_network: str | UnsetType = UNSET
    left_out: str | UnsetType = UNSET


class SolveRecord(Struct, frozen=True, kw_only=True):
    """Solution of one colour of a plane: the middle part of `PlaneRecord`."""

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

    A plane given by a pose has a `name` and `rt_ref_plane`, whose lengths are those of the poses of the set.
    `saturated_share` is that of the pixels of all views, and `unknown_share` that of the samples, NaN, most of whose
    pixels are; unset without any.
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
    """The power of detail on a plane, and its standard deviation."""

    detail_e2: float
    sigma_e2: float


class FocusCurve(Struct, frozen=True, kw_only=True):
    """Focus against depth, and the depths at which it peaks."""

    depth_mm: list[float]
    detail_e2: list[float]
    sigma_e2: list[float] | UnsetType = UNSET
    sharp_mm: list[float]

    def __post_init__(self) -> None:
        lengths = {len(self.depth_mm), len(self.detail_e2), len(self.sigma_e2 or self.depth_mm)}
        if len(lengths) > 1 or 0 in lengths:
            raise ValueError(f"the focus curve has {sorted(lengths)} depths and values")


class BestFocusRecord(Struct, frozen=True):
    """Search by `--depth-mm auto` for depths of best focus.

    `p_value` is the share of `shuffles`, views exchanged between their places, whose views agree at least as well, and
    `z_shuffled` by how many of their standard deviations the stated places are better. `sure_of_lit` is the share of
    the samples with light whose depth is sure.
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

    `share_of_sure` are the shares of the sure samples at the depths that stand out, as of `BestFocusRecord`.
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
    """The options of `faintfield reconstruct` as they took effect."""

    prior: PriorName | UnsetType | None = UNSET  # type: ignore[assignment]
    proposal: bool | UnsetType = UNSET  # type: ignore[assignment]
    pitch_mm: float | UnsetType | None = UNSET
    focus: bool | UnsetType = UNSET
    auto_sweep: Count | UnsetType = UNSET
    depth_map: Literal["mm", "px", "relative"] | UnsetType | None = UNSET
    plane_pose: dict[str, list[float]] | UnsetType = UNSET
    poses: Poses = "stated"


class PlaneFileRecord(Provenance[ReconstructionOptions], frozen=True):
    """The record beside a plane (`plane_00500.0.json`), which vouches for its files."""

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
    """`depth_map.json`, which vouches for the maps beside it."""

    format: Literal[1]
    depth_map: DepthMapRecord
    sha256: dict[FileName, Sha256]

    @property
    def files(self) -> list[str]:
        """Names of the maps, beside the record."""
        return self.depth_map.files


class ReconstructionRecord(Struct, frozen=True, kw_only=True):
    """`reconstruction.json`: all planes of one method, and their `Provenance`."""

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
