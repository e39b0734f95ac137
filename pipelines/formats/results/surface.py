"""`surface.json`: the record of a picture that is sharp everywhere, with its depth, and of the files beside it.

Its writer, its readers and its tests share these types. Light is in the unit that the record
states. Depths are in the `unit` of the surface: mm; those of the poses if their scale is not known ("relative"); or px
of disparity from one node to the next.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from msgspec import UNSET, Meta, Struct, UnsetType

from faintfield.pipelines.arguments import PriorName, SolverOptions
from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.formats.files import file_within, files_below
from faintfield.pipelines.formats.provenance import Provenance
from faintfield.pipelines.formats.reading import read_json
from faintfield.pipelines.formats.results.records import (
    RECONSTRUCTION_FILE,
    Certificate,
    Count,
    FileName,
    Poses,
    PriorRecord,
    ReconstructionRecord,
    Sha256,
    WeightScore,
    preview_name,
)

SURFACE_FILE = "surface.json"

# Largest share of what changes from view to view that a surface may leave unexplained: simulated ones with right poses
# and range leave at most 0.44 at any light, with poses off by 3 mm and 15 mrad at least 0.76, outside the range more
# than 1 (docs/explanation/surface.md). The share is known if the changes raise the deviance by at least the second
# number.
MAX_UNEXPLAINED, _MIN_CHANGES = 2 / 3, 0.2

# Mean deviance of a surface above which nothing vouches for it, without neighbours to compare with.
_MAX_DEVIANCE = 10.0

# Share of sure depths below which 0 % is shown.
_MIN_SURE_SHARE = 0.005

type Share = Annotated[float, Meta(ge=0, le=1)]


@dataclass(frozen=True, kw_only=True)
class _Range:
    depth_range_mm: tuple[float, float] | None
    unit: Literal["mm", "px", "relative"] = "mm"


@dataclass(frozen=True, kw_only=True)
class SurfaceOptions(SolverOptions, _Range):
    """The options of `faintfield reconstruct --surface` as they took effect.

    `depth_range_mm` is None if the range was to be found. `prior` is stated if one was asked for; otherwise the picture
    is that of total variation with detail added by a filter.
    """

    uncertainty: bool | UnsetType = UNSET  # type: ignore[assignment]
    prior: PriorName | UnsetType | None = UNSET  # type: ignore[assignment]
    proposal: bool | UnsetType = UNSET  # type: ignore[assignment]
    poses: Poses


class HeldOutRecord(Struct, frozen=True, kw_only=True):
    """Prediction of views that were left out from the other views, compared in a number of `pixels`.

    `surface`, `planes` and `neighbours` are the mean deviances per pixel of the prediction by the surface; by the same
    depths on a few planes; and by the mean of each view's neighbours, blurred. Smaller is better; a perfect prediction
    has 1. `standard_error` is that of the difference between `planes` and `surface`.
    """

    views: list[Count]
    pixels: int
    surface: float
    planes: float | None = None
    standard_error: float | UnsetType = UNSET
    neighbours: float | None = None

    @property
    def unexplained_share(self) -> float | None:
        """Share of what changes from view to view, beyond noise, that the surface does not explain; None in the dark.

        A view differs from its neighbours by what changes. The share does not depend on the light; in bright light the
        errors of any model exceed the noise.
        """
        if self.neighbours is None or self.neighbours < 1 + _MIN_CHANGES:
            return None
        return max(self.surface - 1, 0) / (self.neighbours - 1)


class SurfaceChannel(Struct, frozen=True, kw_only=True):
    """Solution of one colour of the picture; shares of saturated pixels and unknown samples as in `PlaneRecord`."""

    channel: str
    penalty_weight: float | None
    penalty_weight_chosen: str
    penalty_weight_curve: list[WeightScore] | None = None
    certificate: Certificate | None
    passes: int
    likelihood: str
    mean_e: float
    saturated_share: float | UnsetType = UNSET
    unknown_share: float | UnsetType = UNSET
    prior: PriorRecord | UnsetType = UNSET


class SurfaceFacts(Struct, frozen=True, kw_only=True):
    """Record of the estimation of a surface, without its maps.

    `searched` are the nearest and farthest depth that were considered, in `unit`; `range_found` says that they were
    found in the views. `depths` were compared, first in bins of `bins_px` detector pixels. Depth and picture were
    estimated in turn in `rounds`. `sure_above` is the probability from which on a depth counts as sure, and
    `share_of_sure` the shares of the sure samples at the depths that stand out, as of `BestFocusRecord`;
    `sure_of_lit` is the share of the samples with light whose depth is sure.
    """

    unit: Literal["mm", "px", "relative"]
    searched: tuple[float, float]
    range_found: bool
    depths: int
    bins_px: Count
    rounds: Count
    sure_above: Share
    held_out: HeldOutRecord | None = None
    share_of_sure: list[float] | UnsetType = UNSET
    sure_of_lit: Share | UnsetType = UNSET
    channels: Annotated[list[SurfaceChannel], Meta(min_length=1)]
    wall_time_s: float


class SurfaceRecord(SurfaceFacts, frozen=True, kw_only=True):
    """A surface: what the estimation says, the names of its files, and how much of it is known.

    Files of light, of depth in `unit` (NaN where it is not known), and of their standard deviations; `picture_proposal`
    is what the prior proposed, `picture_moved` how far the data moved the picture from it. `depth_confidence` is the
    probability that the depth is right within 2 %, `visibility` the pixels that see a sample, `points` the
    samples of known depth as a point cloud, None in px, and `film` the picture from viewpoints between the nodes.
    `known_share` and `sure_share` are shares of the samples, `median` is that of the known depths.
    """

    picture: FileName
    picture_sigma: FileName
    picture_proposal: FileName | UnsetType = UNSET
    picture_moved: FileName | UnsetType = UNSET
    depth: FileName
    depth_sigma: FileName
    depth_confidence: FileName
    visibility: FileName
    points: FileName | None
    film: FileName | None
    shape: tuple[Count, Count]
    known_share: Share
    sure_share: Share
    median: float | None

    @property
    def warning(self) -> str | None:
        """Words on a surface that does not explain its views; None if it does, or if no view was left out to tell."""
        if self.held_out is None:
            return None
        deviance, neighbours = self.held_out.surface, self.held_out.neighbours
        unexplained = self.held_out.unexplained_share
        if neighbours is not None and deviance > neighbours:
            what = (
                f"The views do not show the depths of this surface: those that were left out are predicted better by "
                f"their neighbours, without any depth (mean deviance {deviance:.4g} against {neighbours:.4g}). Do not "
                "trust them"
            )
        elif unexplained is not None and unexplained > MAX_UNEXPLAINED:
            what = (
                f"This surface does not explain its views: in those that were left out, its prediction misses "
                f"{unexplained:.0%} of what changes from view to view (mean deviance {deviance:.4g}, their neighbours' "
                f"{neighbours:.4g}, 1 is perfect). Trust neither its picture nor its depths"
            )
        elif neighbours is None and deviance > _MAX_DEVIANCE:
            what = (
                f"Nothing vouches for this surface: the views that were left out differ from its prediction by "
                f"{deviance**0.5:.2g} times their noise, and have no neighbours to compare with"
            )
        else:
            return None
        return f"{what}; check poses, range of depths and noise model"

    @property
    def remark(self) -> str | None:
        """Words on a surface of which no depth is sure, or too few to show as 1 %; None if there are more."""
        if self.sure_share >= _MIN_SURE_SHARE:
            return None
        return (
            f"{'Almost no' if self.sure_share else 'No'} depth of this surface is sure: do not measure in it; use more "
            "light, more views or nodes farther apart, or check poses and range of depths"
        )

    @property
    def maps(self) -> list[str]:
        """Names of the TIFFs, each of which has a preview."""
        pictures = (self.picture, self.picture_sigma, self.picture_proposal, self.picture_moved)
        depths = (self.depth, self.depth_sigma, self.depth_confidence, self.visibility)
        return [name for name in (*pictures, *depths) if name is not UNSET]

    @property
    def files(self) -> list[str]:
        """Names of all files beside the record, previews included."""
        others = [name for name in (self.points, self.film) if name is not None]
        return [*self.maps, *map(preview_name, self.maps), *others]


class SurfaceFileRecord(Provenance[SurfaceOptions], frozen=True):
    """`surface.json`, which vouches for its `files`."""

    format: Literal[1]
    surface: SurfaceRecord
    sha256: dict[FileName, Sha256]

    @property
    def files(self) -> list[str]:
        """Names of all files beside the record, previews included."""
        return self.surface.files


def planes_below(directory: Path) -> dict[Path, ReconstructionRecord]:
    """Return each reconstruction.json in a folder and below it, by its folder: for what shows planes alone."""
    if not results_below(directory, required=False) and surfaces_below(directory):
        raise MissingFile(
            f"{directory}: holds a surface and no planes; open its TIFFs or surface.ply by other programs, or "
            "reconstruct planes"
        )
    return results_below(directory)


def surfaces_below(directory: Path) -> dict[Path, SurfaceFileRecord]:
    """Return each surface.json in a folder and below it, by its folder; BadValue if it names a file outside."""
    return _records_below(directory, SURFACE_FILE, SurfaceFileRecord)


def results_below(directory: Path, *, required: bool = True) -> dict[Path, ReconstructionRecord]:
    """Return each reconstruction.json in a folder and below it, by its folder; MissingFile if one is `required`."""
    results = _records_below(directory, RECONSTRUCTION_FILE, ReconstructionRecord)
    if not results and required:
        raise MissingFile(f"{directory}: holds no {RECONSTRUCTION_FILE}; run `faintfield reconstruct` first")
    return results


def _records_below[Record: (SurfaceFileRecord, ReconstructionRecord)](
    directory: Path, name: str, kind: type[Record]
) -> dict[Path, Record]:
    if not directory.is_dir():
        raise MissingFile(f"{directory}: no such folder; name one that `faintfield reconstruct` wrote")
    records = {path.parent: read_result(path, kind) for path in files_below(directory, name)}
    for folder, record in records.items():
        for file in record.files:
            file_within(folder, file)
    return records


def read_result[Record](path: Path, kind: type[Record]) -> Record:
    """Read a JSON file as one of the types of `formats.results.records`."""
    return read_json(path, kind, what="a result that can be shown", remedy="reconstruct again")
