"""The errors against the truth in a report: by plane and method, and with several kinds of poses side by side."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from msgspec import UNSET

from faintfield.pipelines.formats.results.records import METRICS_FILE, GeometryErrors, Metrics, PlaneErrors, Poses
from faintfield.pipelines.formats.results.result_files import files_below, read_result
from faintfield.pipelines.pages.report_planes import METHOD_NAMES, Plane

# Order of the poses in the comparison.
_POSES_IN_ORDER: tuple[Poses, ...] = ("nominal", "measured", "true")


@dataclass(frozen=True)
class ErrorRow:
    """The errors of a plane, with the title of its method."""

    title: str
    errors: PlaneErrors


@dataclass(frozen=True)
class PosesRow:
    """The error of a plane (bright) by the poses it was reconstructed with."""

    depth_mm: float
    object: str
    title: str
    errors: dict[Poses, float]


@dataclass(frozen=True, kw_only=True)
class ErrorSections:
    """What the page shows of errors; the names are those of the template."""

    metrics: list[ErrorRow]
    geometry_off: GeometryErrors | None
    pose_kinds: list[Poses]
    by_poses: list[PosesRow]

    def of(self, plane: Plane) -> list[PlaneErrors]:
        """Return the errors of the method and the poses of a plane."""
        return [row.errors for row in self.metrics if _is_of(row.errors, plane)]


def error_sections(directory: Path, planes: Sequence[Plane]) -> ErrorSections:
    """Return the errors against the truth: the folder's own, else those of the folders within it."""
    own = directory / METRICS_FILE
    found = [read_result(path, Metrics) for path in ([own] if own.is_file() else files_below(directory, METRICS_FILE))]
    rows = [ErrorRow(_title_of(errors, planes), errors) for metrics in found for errors in metrics.planes]
    places: dict[tuple[float, str, str], dict[Poses, float]] = {}
    for row in rows:
        place = (row.errors.depth_mm, row.errors.object, row.title)
        places.setdefault(place, {})[row.errors.poses] = row.errors.mse_bright
    compared = sorted((place, errors) for place, errors in places.items() if len(errors) > 1)
    return ErrorSections(
        metrics=rows,
        geometry_off=next((metrics.geometry for metrics in found if metrics.geometry is not UNSET), None),
        pose_kinds=[kind for kind in _POSES_IN_ORDER if any(row.errors.poses == kind for row in rows)],
        by_poses=[PosesRow(*place, errors) for place, errors in compared],
    )


def _is_of(errors: PlaneErrors, plane: Plane) -> bool:
    """Return whether errors are of a plane's method and poses; errors of stated poses say if these are true."""
    return errors.method == plane.method and plane.poses in ("stated", errors.poses)


def _title_of(errors: PlaneErrors, planes: Sequence[Plane]) -> str:
    """Return the title of the method of errors, as beside the planes."""
    return next((plane.title for plane in planes if _is_of(errors, plane)), METHOD_NAMES[errors.method])
