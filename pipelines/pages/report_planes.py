"""The planes of a report: read from disk, and in the columns in which the report shows them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.records import Method, PlaneRecord, Poses, ReconstructionRecord
from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS

# Order of the columns.
_POSES_IN_ORDER: tuple[Poses, ...] = ("measured", "nominal", "true", "stated")

# The poses and the method that a report leads with: the first of these that there are.
PREFERRED_POSES: tuple[Poses, ...] = ("measured", "stated", "nominal", "true")
_PREFERRED_METHODS: tuple[Method, ...] = ("occlusion", "joint", "pmlem", "pmlem-osl", "mlem", "backprojection")

# Names of the methods, in the order of the columns.
METHOD_NAMES: dict[Method, str] = {
    "backprojection": "back-projection",
    "mlem": "MLEM",
    "pmlem-osl": "PMLEM (one-step-late, TV)",
    "pmlem": "PMLEM",
    "joint": "PMLEM, all planes together",
    "occlusion": "PMLEM, all planes together, with occlusion",
}


@dataclass(frozen=True)
class Plane:
    """One plane of one method on disk.

    Attributes
    ----------
    column : str
        The column of the report: its method, after the folder of its set if that is not the report's own.
    method, poses : str
        By which it was reconstructed.
    depth_mm : float
        Its depth, on the axis.
    path : Path
        Its file.
    records : list of PlaneRecord
        Its records, one per colour.
    """

    column: str
    method: Method
    poses: Poses
    depth_mm: float
    path: Path
    records: list[PlaneRecord]

    @property
    def title(self) -> str:
        """Name of the method."""
        return method_title(self.records)

    @property
    def name(self) -> str:
        """Name of a plane that was given by a pose; empty for others."""
        return self.records[0].name or ""

    @property
    def place(self) -> tuple[float, str]:
        """What planes of several columns have in common when they stand side by side."""
        return (self.depth_mm, self.name)

    def pixels(self) -> NDArray[Any]:
        """Return the plane (row, column[, colour]) in electrons."""
        return read_frame(self.path).pixels_dn

    def sigma_e(self) -> NDArray[Any] | None:
        """Return the standard deviation of each sample, None if it was not asked for."""
        name = self.records[0].sigma_file
        return read_frame(existing(self.path.with_name(Path(name).name))).pixels_dn if name else None


def method_title(records: Sequence[PlaneRecord]) -> str:
    """Return the name of the method of records; it says if occlusion was left out."""
    left_out = dict.fromkeys(record.channel for record in records if record.occlusion is False)
    if not left_out:
        return METHOD_NAMES[records[0].method]
    in_colours = "" if all(record.channel in left_out for record in records) else f" in {', '.join(left_out)}"
    return f"{METHOD_NAMES['joint']} (occlusion left out{in_colours})"


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
            path = existing(folder / Path(name).name)
            planes.append(Plane(column, method, result.options.poses, records[0].depth_mm, path, records))
    methods = list(METHOD_NAMES)
    return sorted(
        planes,
        key=lambda plane: (
            _POSES_IN_ORDER.index(plane.poses),
            plane.column.rpartition("/")[0],
            methods.index(plane.method),
        ),
    )


def existing(path: Path) -> Path:
    """Return the path of a file that reconstruction.json names, if it exists (else MissingFile)."""
    if not path.is_file():
        raise MissingFile(f"{path}: is recorded in reconstruction.json but missing; reconstruct again")
    return path


def column_titles(planes: list[Plane]) -> dict[str, str]:
    """Return the title of each column: the method, with the poses or the set's folder if these differ."""
    columns = {plane.column: plane for plane in planes}
    by_poses = {column: (plane.method, plane.poses) for column, plane in columns.items()}
    poses_differ = len(set(by_poses.values())) == len(columns) and len({plane.poses for plane in planes}) > 1
    titles = {}
    for column, plane in columns.items():
        where, name = column.rpartition("/")[0], plane.title
        if poses_differ and plane.poses != "stated":
            titles[column] = f"{name}, {plane.poses} poses"
        else:
            titles[column] = f"{where} set: {name}" if where else name
    return titles


def best_column(planes: list[Plane]) -> str:
    """Return the column that a report leads with: the best method with the best poses."""
    best = min(planes, key=lambda plane: (PREFERRED_POSES.index(plane.poses), _PREFERRED_METHODS.index(plane.method)))
    return best.column


def plane_words(depth_mm: float, name: str) -> str:
    """Return the name of a plane on the page."""
    return f"{name}, {depth_mm:.1f} mm on the axis" if name else f"{round(depth_mm, 1):g} mm"
