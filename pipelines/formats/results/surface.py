"""`surface.json`: the record of a picture that is sharp everywhere, with its depth, and of the files beside it.

Its writer, its readers and its tests share these types. Light is in the unit that the record
states. Depths are in the `unit` of the surface: mm; those of the poses if their scale is not known ("relative"); or px
of disparity from one node to the next.
"""

from dataclasses import dataclass
from math import ceil
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

# Largest share of what changes from view to view that a surface may leave unexplained: with right poses and range it is
# at most 0.60, outside the range more than 1 (docs/quality.md). The share is known if the changes raise the deviance by
# at least the second number.
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

    Attributes
    ----------
    depth_range_mm : (float, float), optional
        Nearest and farthest depth of the search; null if the range was to be found.
    unit : {"mm", "px", "relative"}
        Unit of depths: "px" if disparities were asked for, else that of the set.
    prior : {"tv", "patches", "learned", "auto"}, optional
        Prior that was asked for; otherwise the picture is that of total variation with detail added by a filter.
    poses : {"stated", "measured", "aligned", "nominal", "true"}
        Source of the poses: the set, boards, the views, the commanded places, or the simulator.
    """

    uncertainty: bool | UnsetType = UNSET  # type: ignore[assignment]
    prior: PriorName | UnsetType | None = UNSET  # type: ignore[assignment]
    proposal: bool | UnsetType = UNSET  # type: ignore[assignment]
    poses: Poses


class HeldOutRecord(Struct, frozen=True, kw_only=True):
    """Prediction of views that were left out from the other views.

    Attributes
    ----------
    views : list of int
        Indices of the views that were left out, in the order of the set.
    pixels : int
        Number of their pixels that were compared.
    surface : float
        Mean squared error over the variance of the noise, predicted by the surface; 1 is perfect.
    planes : float, optional
        That error, predicted by the depths of the surface on a few planes.
    standard_error : float, optional
        Standard error of the difference between `planes` and `surface`.
    neighbours : float, optional
        That error, predicted by the mean of each view's neighbours, blurred.
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
    """Solution of one colour of the picture.

    Attributes
    ----------
    channel : str
        Colour of the picture.
    penalty_weight : float, optional
        Penalty weight β.
    penalty_weight_chosen : str
        How the weight was chosen, in words.
    penalty_weight_curve : list of WeightScore, optional
        Weights that were tried; null if the weight was not chosen by held-out views.
    certificate : Certificate, optional
        Convergence of the iteration.
    passes : int
        Passes over the data.
    likelihood : str
        Name of the noise model of a pixel.
    mean_e : float
        Mean light of the samples per detector pixel of the reference view.
    saturated_share, unknown_share : float, optional
        Share of saturated pixels in all views; share of the samples, NaN, that mostly saturated pixels see.
    prior : PriorRecord, optional
        Prior of the picture.
    """

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

    Attributes
    ----------
    unit : {"mm", "px", "relative"}
        Unit of depths: mm, px of disparity from one node to the next, or the unit of the poses.
    searched : (float, float)
        Nearest and farthest depth that were considered, in `unit`.
    range_found : bool
        True if the range was found in the views.
    depths : int
        Number of depths that were compared.
    bins_px : int
        Width in detector pixels of the bins in which views were compared.
    rounds : int
        Number of times that depth and picture were estimated in turn.
    sure_above : float
        Probability from which on a depth counts as sure.
    held_out : HeldOutRecord, optional
        Prediction of views that were left out; null if nothing could be compared.
    share_of_sure : list of float, optional
        Share of the sure samples at each depth that stands out.
    sure_of_lit : float, optional
        Share of the samples with light whose depth is sure.
    spacing_needed : float, optional
        Factor by which nodes must be farther apart for the nearest depths to be sure; at most 1 if they are far
        enough.
    channels : list of SurfaceChannel
        Solution of each colour of the picture.
    wall_time_s : float
        Time that the command took.
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
    spacing_needed: Annotated[float, Meta(gt=0)] | UnsetType = UNSET
    channels: Annotated[list[SurfaceChannel], Meta(min_length=1)]
    wall_time_s: float


class SurfaceRecord(SurfaceFacts, frozen=True, kw_only=True):
    """A surface: what the estimation says, the names of its files, and how much of it is known.

    Attributes
    ----------
    picture, picture_sigma : str
        Name of the TIFF with the light of each sample; name of the TIFF with the standard deviation of that light, for
        known depths and total variation.
    picture_proposal, picture_moved : str, optional
        Name of the TIFF with the light that the prior proposed; name of the TIFF with picture less proposal, in
        standard deviations of the noise.
    depth, depth_sigma : str
        Name of the TIFF with the depth of each sample in `unit`, NaN where it is not known; name of the TIFF with the
        standard deviation of that depth in `unit`, by `depth_confidence`.
    depth_confidence : str
        Name of the TIFF with the probability that each depth is right within 2 %.
    visibility : str
        Name of the TIFF with the pixels that see each sample, about one for each view.
    points : str, optional
        Name of the point cloud of the samples of known depth; null for depths in px.
    film : str, optional
        Name of the film from viewpoints between the nodes; null if it could not be made.
    shape : (int, int)
        Rows and columns of the maps.
    known_share, sure_share : float
        Share of the samples whose depth is known; share of the samples whose depth is sure.
    median : float, optional
        Median of the known depths, in `unit`; null without any.
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
        sentence = f"{'Almost no' if self.sure_share else 'No'} depth of this surface is sure: do not measure in it; "
        if self.spacing_needed is not UNSET and self.spacing_needed > 1:
            return sentence + (
                "its nodes are too close together even for the nearest depths: use more than "
                f"{ceil(10 * self.spacing_needed) / 10:.1f} times their distance, or more views"
            )
        return sentence + "use more light, more views or nodes farther apart, or check poses and range of depths"

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
    """`surface.json`, with the SHA-256 of its files.

    Attributes
    ----------
    format : 1
        Version of the format.
    surface : SurfaceRecord
        The surface.
    sha256 : dict of str
        SHA-256 of each file beside the record, by its name.
    """

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
