"""`surface.json`: the record of a picture that is sharp everywhere, with its depth, and of the files beside it.

Its writer, its readers and its tests share these types. Light is in the unit that the record
states. Depths are in the `unit` of the surface: mm; those of the poses if their scale is not known ("relative"); or px
of disparity from one node to the next.
"""

from pathlib import Path
from typing import Annotated, Literal

from msgspec import UNSET, Meta, Struct, UnsetType

from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.formats.provenance import Provenance
from faintfield.pipelines.formats.results.records import (
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
from faintfield.pipelines.formats.results.result_files import file_within, files_below, read_result, results_below

SURFACE_FILE = "surface.json"

type Share = Annotated[float, Meta(ge=0, le=1)]


class SurfaceOptions(Struct, frozen=True, kw_only=True):
    """The options of `faintfield reconstruct --surface` as they took effect.

    `depth_range_mm` is None if the range was to be found. `prior` is stated if one was asked for; otherwise the picture
    is that of total variation with detail added by a filter.
    """

    depth_range_mm: tuple[float, float] | None
    unit: Literal["mm", "px", "relative"] = "mm"
    penalty_weight: float | Literal["auto"]
    penalty: str
    likelihood: str
    prior: str | UnsetType = UNSET
    proposal: bool | UnsetType = UNSET
    passes: int | None = None
    poses: Poses


class HeldOutRecord(Struct, frozen=True, kw_only=True):
    """Prediction of views that were left out from the other views.

    Attributes
    ----------
    views : list of int
        The views that were left out.
    pixels : int
        Number of their pixels that were compared.
    surface, planes, neighbours : float
        Mean deviance per pixel of their prediction by the surface; by the same depths on a few planes; and by the mean
        of each view's neighbours, blurred. None if it was not computed. Smaller is better; a perfect prediction has
        about 1.
    standard_error : float
        Of the difference between `planes` and `surface`.
    """

    views: list[Count]
    pixels: int
    surface: float
    planes: float | None = None
    standard_error: float | UnsetType = UNSET
    neighbours: float | None = None


class SurfaceChannel(Struct, frozen=True, kw_only=True):
    """Solution of one colour of the picture."""

    channel: str
    penalty_weight: float | None
    penalty_weight_chosen: str
    penalty_weight_curve: list[WeightScore] | None = None
    certificate: Certificate | None
    passes: int
    likelihood: str
    mean_e: float
    prior: PriorRecord | UnsetType = UNSET


class SurfaceFacts(Struct, frozen=True, kw_only=True):
    """Record of the estimation of a surface, without its maps.

    Attributes
    ----------
    unit : str
        Of all depths: "mm"; "relative", that of the poses; or "px" of disparity from one node to the next.
    searched : (float, float)
        Nearest and farthest depth that were considered.
    range_found : bool
        This range was found in the views, not given.
    depths : int
        Number of depths that were compared.
    bins_px : int
        Width in detector pixels of the bins in which depths were first compared.
    rounds : int
        How often depth and picture were estimated in turn.
    sure_above : float
        Probability from which on a depth counts as sure.
    held_out : HeldOutRecord, optional
        How well the surface predicts views that were left out.
    channels : list of SurfaceChannel
        The picture, colour by colour.
    wall_time_s : float
        How long it took.
    """

    unit: Literal["mm", "px", "relative"]
    searched: tuple[float, float]
    range_found: bool
    depths: int
    bins_px: Count
    rounds: Count
    sure_above: Share
    held_out: HeldOutRecord | None = None
    channels: Annotated[list[SurfaceChannel], Meta(min_length=1)]
    wall_time_s: float


class SurfaceRecord(SurfaceFacts, frozen=True, kw_only=True):
    """A surface: what the estimation says, the names of its files, and how much of it is known.

    Attributes
    ----------
    picture, picture_sigma : str
        The light of each sample and its standard deviation.
    picture_proposal, picture_moved : str, optional
        What the prior proposed, and how far the data moved the picture from it.
    depth, depth_sigma : str
        The depth of each sample and its standard deviation, in `unit`; NaN where the depth is not known.
    depth_confidence : str
        Probability, 0 to 1, that the depth is right within 2 %.
    visibility : str
        Number of views that see each sample.
    points : str, optional
        The samples whose depth is known as a point cloud, in `unit`; None if that is px.
    film : str, optional
        The picture from viewpoints between the nodes; None if these do not differ, or it could not be encoded.
    shape : (int, int)
        Rows and columns.
    known_share, sure_share : float
        Shares of the samples whose depth is known, and whose depth is right with a probability of `sure_above`.
    median : float, optional
        Median of the known depths; None if there are none.
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
    def maps(self) -> list[str]:
        """Names of the TIFFs, each of which has a preview."""
        proposed = [name for name in (self.picture_proposal, self.picture_moved) if name is not UNSET]
        return [
            self.picture,
            self.picture_sigma,
            *proposed,
            self.depth,
            self.depth_sigma,
            self.depth_confidence,
            self.visibility,
        ]

    @property
    def files(self) -> list[str]:
        """Names of all files beside the record, previews included."""
        others = [name for name in (self.points, self.film) if name is not None]
        return [*self.maps, *map(preview_name, self.maps), *others]


class SurfaceFileRecord(Provenance[SurfaceOptions], frozen=True):
    """`surface.json`, which vouches for the files beside it."""

    format: Literal[1]
    surface: SurfaceRecord
    sha256: dict[FileName, Sha256]

    @property
    def files(self) -> list[str]:
        """Names of all files beside the record, previews included."""
        return self.surface.files


def planes_below(directory: Path) -> dict[Path, ReconstructionRecord]:
    """Return each reconstruction.json in a folder and below it, by its folder: for what shows planes alone.

    Raises
    ------
    MissingFile, BadValue
        There is none, perhaps because a surface was reconstructed; or one that cannot be read.
    """
    if not results_below(directory, required=False) and surfaces_below(directory):
        raise MissingFile(
            f"{directory}: holds a surface and no planes; open its TIFFs or surface.ply by other programs, or "
            "reconstruct planes"
        )
    return results_below(directory)


def surfaces_below(directory: Path) -> dict[Path, SurfaceFileRecord]:
    """Return each surface.json in a folder and below it, by its folder.

    Raises
    ------
    MissingFile, BadValue
        The folder does not exist, a record cannot be read, or one names a file outside its folder.
    """
    if not directory.is_dir():
        raise MissingFile(f"{directory}: no such folder; name one that `faintfield reconstruct` wrote")
    paths = files_below(directory, SURFACE_FILE)
    surfaces = {path.parent: read_result(path, SurfaceFileRecord) for path in paths}
    for folder, record in surfaces.items():
        for name in record.files:
            file_within(folder, name)
    return surfaces
