"""The planes of a report: read from disk, in the columns of the report, and their errors against the truth."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from msgspec import UNSET
from numpy.typing import NDArray

from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.formats.files import files_below
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.figures import METRICS_FILE, GeometryErrors, Metrics, PlaneErrors
from faintfield.pipelines.formats.results.records import JOINT_METHODS, Method, PlaneRecord, Poses, ReconstructionRecord
from faintfield.pipelines.formats.results.surface import read_result
from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS
from faintfield.pipelines.formats.units import StatedUnits, units_of
from faintfield.pipelines.pages.page import format_depths

# Order of the columns.
_POSES_IN_ORDER: tuple[Poses, ...] = ("measured", "aligned", "nominal", "true", "stated")

# The poses that a report leads with: the first of these that there are.
PREFERRED_POSES: tuple[Poses, ...] = ("measured", "aligned", "stated", "nominal", "true")

# Order of the poses in the comparison of errors.
_COMPARED_POSES: tuple[Poses, ...] = ("nominal", "measured", "aligned", "true")

# Names of the methods, in the order of the columns; a report leads with the last that there is.
METHOD_NAMES: dict[Method, str] = {
    "backprojection": "back-projection",
    "mlem": "MLEM",
    "pmlem-osl": "PMLEM (one-step-late, TV)",
    "pmlem": "PMLEM",
    "joint": "PMLEM, all planes together",
    "occlusion": "PMLEM, all planes together, with occlusion",
}


# Methods that a prior may guide.
_OF_PRIORS: tuple[Method, ...] = ("pmlem", *JOINT_METHODS)


@dataclass(frozen=True)
class Plane:
    """One plane of one method on disk, with its records, one per colour.

    Its column of the report is the method, after the folder of its set if that is not the report's own. Its depth on
    the axis is in the unit of its records.
    """

    column: str
    method: Method
    poses: Poses
    depth_mm: float
    path: Path
    records: list[PlaneRecord]
    units: StatedUnits = field(default_factory=StatedUnits)

    @property
    def name(self) -> str:
        """Name of a plane that was given by a pose; empty for others."""
        return self.records[0].name or ""

    @property
    def place(self) -> tuple[float, str]:
        """Depth and name, which planes of several columns share when they stand side by side."""
        return (self.depth_mm, self.name)

    @property
    def label(self) -> str:
        """Name of the plane on the page."""
        return place_name(self.units, *self.place)

    def pixels(self) -> NDArray[Any]:
        """Return the light of the plane (row, column[, colour])."""
        return read_frame(self.path).pixels_dn

    def sidecar_pixels(self, key: Literal["sigma_file", "proposal_file", "moved_file"]) -> NDArray[Any] | None:
        """Return the pixels of a file beside the plane that its record names, None if it names none."""
        name = getattr(self.records[0], key)
        return read_frame(existing(self.path.with_name(Path(name).name))).pixels_dn if name else None


def method_title(records: Sequence[PlaneRecord], *, all_priors: bool = False) -> str:
    """Return the name of the method of records, with its prior; it says if occlusion was left out.

    Total variation alone is named with `all_priors` only.
    """
    names = {record.prior.name for record in records if record.prior} - {"tv"}
    if all_priors and not names and records[0].method in _OF_PRIORS and records[0].prior_name == "tv":
        names = {"tv"}
    prior = f", prior: {' and '.join(sorted(names))}" if names else ""
    left_out = dict.fromkeys(record.channel for record in records if record.occlusion is False)
    if not left_out:
        return METHOD_NAMES[records[0].method] + prior
    in_colours = "" if all(record.channel in left_out for record in records) else f" in {', '.join(left_out)}"
    return f"{METHOD_NAMES['joint']}{prior} (occlusion left out{in_colours})"


def read_planes(directory: Path, results: dict[Path, ReconstructionRecord]) -> list[Plane]:
    """Return all planes, in the order of the columns; a colour plane has one record per channel."""
    planes = []
    for folder, result in results.items():
        by_file: dict[str, list[PlaneRecord]] = {}
        for record in result.planes:
            by_file.setdefault(record.file, []).append(record)
        where = folder.relative_to(directory)
        for name, records in by_file.items():
            method = records[0].method
            # The folders of a method and of a session's reconstructions tell nothing more
            parts = [part for part in where.parts if part not in (method, RECONSTRUCTIONS)]
            column = f"{parts[-1]}/{method}" if parts else method
            path, depth = existing(folder / Path(name).name), records[0].depth_mm
            planes.append(Plane(column, method, result.options.poses, depth, path, records, units_of(result)))
    poses, methods = _POSES_IN_ORDER.index, list(METHOD_NAMES).index
    return sorted(
        planes, key=lambda plane: (poses(plane.poses), plane.column.rpartition("/")[0], methods(plane.method))
    )


def existing(path: Path) -> Path:
    """Return the path of a file that a record names (MissingFile)."""
    if not path.is_file():
        raise MissingFile(f"{path}: is recorded but missing; reconstruct again")
    return path


def column_titles(planes: list[Plane]) -> dict[str, str]:
    """Return the title of each column: the method, with the poses or the set's folder if these differ."""
    columns = {plane.column: plane for plane in planes}
    priors_differ = len({plane.records[0].prior_name for plane in planes if plane.method in _OF_PRIORS}) > 1
    names = {column: method_title(plane.records, all_priors=priors_differ) for column, plane in columns.items()}
    kinds = {(names[column], plane.poses) for column, plane in columns.items()}
    poses_differ = len(kinds) == len(columns) and len({plane.poses for plane in planes}) > 1
    titles = {}
    for column, plane in columns.items():
        where = column.rpartition("/")[0]
        if poses_differ and plane.poses != "stated":
            titles[column] = f"{names[column]}, {plane.poses} poses"
        else:
            titles[column] = (f"{where} set: " if where else "") + names[column]
    return titles


def best_column(planes: list[Plane]) -> str:
    """Return the column that a report leads with: the best method with the best poses."""
    methods = list(METHOD_NAMES)
    best = min(planes, key=lambda plane: (PREFERRED_POSES.index(plane.poses), -methods.index(plane.method)))
    return best.column


def place_name(units: StatedUnits, depth: float, name: str) -> str:
    """Return the name of a plane on the page."""
    if units.depth != "mm":
        where = format_depths(units, depth)
    else:
        where = f"{depth:.1f} mm" if name else f"{round(depth, 1):g} mm"
    return f"{name}, {where} on the axis" if name else where


@dataclass(frozen=True)
class ErrorSections:
    """Part of the page about errors: of each plane, after the title of its method, and of the measured poses.

    `by_poses` holds the errors against the object by poses, after depth, object and method; `pose_kinds` are its poses
    in order.
    """

    metrics: list[tuple[str, PlaneErrors]]
    geometry_off: GeometryErrors | None
    pose_kinds: list[Poses]
    by_poses: list[tuple[tuple[float, str, str], dict[Poses, float]]]

    def of(self, planes: Sequence[Plane]) -> list[PlaneErrors]:
        """Return the errors of some planes."""
        return [errors for _, errors in self.metrics if any(_is_of(errors, plane) for plane in planes)]


def error_sections(directory: Path, planes: Sequence[Plane]) -> ErrorSections:
    """Return the errors against the truth: the folder's own, else those of the folders within it."""
    own = directory / METRICS_FILE
    paths = [own] if own.is_file() else files_below(directory, METRICS_FILE)
    all_metrics = [read_result(path, Metrics) for path in paths]
    rows = [(_title_of(errors, planes), errors) for metrics in all_metrics for errors in metrics.planes]
    by_place: dict[tuple[float, str, str], dict[Poses, float]] = {}
    for title, errors in rows:
        by_place.setdefault((errors.depth_mm, errors.object, title), {})[errors.poses] = errors.mse_texture
    return ErrorSections(
        rows,
        next((metrics.geometry for metrics in all_metrics if metrics.geometry is not UNSET), None),
        [kind for kind in _COMPARED_POSES if any(errors.poses == kind for _, errors in rows)],
        sorted((place, errors) for place, errors in by_place.items() if len(errors) > 1),
    )


def _is_of(errors: PlaneErrors, plane: Plane) -> bool:
    """Compare errors with a plane's method, depth, prior and poses; poses that a set states match those of any kind."""
    same_place = (errors.method, errors.depth_mm) == (plane.method, plane.depth_mm)
    same_prior = errors.prior in (UNSET, plane.records[0].prior_name)
    return same_place and same_prior and plane.poses in ("stated", errors.poses)


def _title_of(errors: PlaneErrors, planes: Sequence[Plane]) -> str:
    records = next((plane.records for plane in planes if _is_of(errors, plane)), None)
    return METHOD_NAMES[errors.method] if records is None else method_title(records)
