"""Tables of poses: a CSV file with the name of each image and the place of its camera."""

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from faintfield.calib.lens import Lens
from faintfield.pipelines.errors import BadValue, WrongUsage
from faintfield.pipelines.formats.exchange.camera_to_world import rt_cam_world
from faintfield.pipelines.formats.exchange.imported_set import (
    ImportedSet,
    PosedImage,
    PosedModel,
    import_posed,
    read_picture,
)
from faintfield.pipelines.formats.exchange.options import ImportOptions
from faintfield.pipelines.formats.exchange.picture_folder import picture_named
from faintfield.pipelines.formats.reading import read_text

_NAMES = ("name", "file", "image", "filename")

# What a coordinate's column may add to x, y, z, and how many mm its unit has; nothing says that it is not known.
_UNITS: dict[str, float | None] = {"_mm": 1.0, "_m": 1000.0, "": None}
_QUATERNION = ("qx", "qy", "qz", "qw")

# By how much the length of a quaternion may be off 1, as that of rounded numbers is.
_TOLERANCE = 1e-2

# Rows of a table: as many views as any set has.
_MAX_ROWS = 100_000


class PoseTable:
    """The rows of a table, by column.

    Parameters
    ----------
    path : Path
        The file; columns are parted by commas, semicolons or tabs, and the first line names them in any order.

    Attributes
    ----------
    path : Path
        The file.
    mm_per_unit : float or None
        mm of the unit of its positions; None if the header says none.

    Raises
    ------
    MissingFile, BadValue
        The file cannot be read, or lacks a column.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        text = read_text(path).removeprefix("\ufeff")
        lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
        if not 2 <= len(lines) <= _MAX_ROWS + 1:
            raise BadValue(
                f"{path}: has {len(lines)} lines; a line that names the columns and 1 to {_MAX_ROWS} rows are needed"
            )
        delimiter = max(",;\t", key=lines[0].count)
        try:
            header, *self._rows = [
                [cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter, strict=True)
            ]
        except csv.Error as failure:
            raise BadValue(f"{path}: is no table that can be read ({failure}); export it as CSV") from failure
        self._columns = [word.lower() for word in header]
        twice = next((word for word in self._columns if self._columns.count(word) > 1), None)
        if twice is not None:
            raise BadValue(f"{path}: has two columns {twice}; keep one of them")
        name = next((word for word in _NAMES if word in self._columns), None)
        unit = next((unit for unit in _UNITS if all(axis + unit in self._columns for axis in "xyz")), None)
        turned = [word for word in _QUATERNION if word in self._columns]
        if name is None or unit is None or len(turned) not in (0, 4):
            raise BadValue(
                f"{path}: its columns are {', '.join(header)[:200]}; needed are name, x, y, z (or x_mm, y_mm, z_mm), "
                "and all or none of qw, qx, qy, qz: correct the first line"
            )
        self._name, self._unit, self._turned = name, unit, bool(turned)
        self.mm_per_unit = _UNITS[unit]

    def posed(self, lens: Lens, images: Path) -> PosedModel:
        """Return the images with their poses; without quaternions all cameras look along z, with x right and y down.

        Raises
        ------
        BadValue
            A row is incomplete, a number is none, or a name leads out of the folder of images or is there twice.
        """
        posed: dict[Path, PosedImage] = {}
        for number in range(len(self._rows)):
            place, cells = self._row(number)
            image = picture_named(images, cells[self._name], f"{place}: {self._name}")
            if image in posed:
                raise BadValue(f"{place}: {image.name} has a pose already; keep one row for each image")
            centre = _numbers(place, cells, [f"{axis}{self._unit}" for axis in "xyz"])
            turn = _turn(place, _numbers(place, cells, _QUATERNION)) if self._turned else np.eye(3)
            posed[image] = PosedImage(image, lens, rt_cam_world(turn, centre))
        return PosedModel([self.path], list(posed.values()))

    def first_picture(self, images: Path) -> Path:
        """Return the picture of the first row."""
        place, cells = self._row(0)
        return picture_named(images, cells[self._name], f"{place}: {self._name}")

    def _row(self, number: int) -> tuple[str, dict[str, str]]:
        """Return where a row is, for messages, and its cells by column."""
        place, row = f"{self.path}: row {number + 1}", self._rows[number]
        if len(row) != len(self._columns):
            raise BadValue(f"{place}: has {len(row)} columns, the first line {len(self._columns)}; correct it")
        return place, dict(zip(self._columns, row, strict=True))


def _numbers(place: str, cells: dict[str, str], columns: Sequence[str]) -> NDArray[np.float64]:
    """Return finite numbers of a row."""
    values = []
    for column in columns:
        try:
            values.append(float(cells[column]))
        except ValueError:
            values.append(np.nan)
        if not np.isfinite(values[-1]):
            raise BadValue(f"{place}: {column} = '{cells[column][:40]}' is no finite number; correct it")
    return np.array(values)


def _turn(place: str, quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation (3, 3) of a unit quaternion (x, y, z, w)."""
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) <= _TOLERANCE:
        raise BadValue(f"{place}: qw, qx, qy, qz have the length {length:g}, that of a rotation is 1; correct them")
    return np.asarray(Rotation.from_quat(quaternion).as_matrix())


def import_table(
    src: Path,
    out: Path,
    options: ImportOptions,
    fx_px: float,
    fy_px: float,
    centre_px: tuple[float | None, float | None],
    distortion: tuple[float, ...],
) -> ImportedSet:
    """Make an elemental set of a table and its images, with the lens given; by default its centre is the picture's.

    Raises
    ------
    WrongUsage
        The lens cannot be, or the unit of positions is stated twice.
    """
    table, folder = PoseTable(src), options.images or src.parent
    if options.mm_per_unit is not None and table.mm_per_unit is not None:
        raise WrongUsage(f"{src}: its header states the unit of positions; leave --mm-per-unit out")
    options = replace(options, mm_per_unit=options.mm_per_unit or table.mm_per_unit)
    height, width = read_picture(table.first_picture(folder)).pixels_dn.shape[:2]
    cx_px, cy_px = centre_px
    try:
        lens = Lens(
            (width, height),
            fx_px,
            fy_px,
            (width - 1) / 2 if cx_px is None else cx_px,
            (height - 1) / 2 if cy_px is None else cy_px,
            distortion,
        )
    except ValueError as failure:
        raise WrongUsage(f"the lens of the options cannot be: {failure}; correct them") from failure
    return import_posed(out, table.posed(lens, folder), options, "import poses")
