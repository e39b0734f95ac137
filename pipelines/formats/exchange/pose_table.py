"""Tables of poses: a CSV file with the name of each image and the place of its camera."""

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from faintfield.pipelines.errors import BadValue, WrongUsage
from faintfield.pipelines.formats.exchange.grid_names import picture_named
from faintfield.pipelines.formats.exchange.imported_set import (
    ImportedSet,
    PosedImage,
    check_set_free,
    import_posed,
    pose_of,
    read_picture,
    stated_lens,
)
from faintfield.pipelines.formats.exchange.options import ImportOptions, LensOptions
from faintfield.pipelines.formats.reading import read_text

_NAMES = ("name", "file", "image", "filename")

# Endings of the columns of coordinates x, y, z, and mm of their unit; nothing says that it is not known.
_UNITS: dict[str, float | None] = {"_mm": 1.0, "_m": 1000.0, "": None}
_QUATERNION = ("qx", "qy", "qz", "qw")

# By how much the length of a quaternion may be off 1, as that of rounded numbers is.
_TOLERANCE = 1e-2

# Rows of a table: as many views as any set has.
_MAX_ROWS = 100_000


def import_table(src: Path, out: Path, lens_options: LensOptions, options: ImportOptions) -> ImportedSet:
    """Make an elemental set of a table and its images, with the lens given; by default its centre is the picture's.

    Raises
    ------
    WrongUsage
        The lens cannot be, or the unit of positions is stated twice.
    """
    check_set_free(out, options)
    poses, mm_per_unit = read_poses(src, options.images or src.parent)
    if options.mm_per_unit is not None and mm_per_unit is not None:
        raise WrongUsage(f"{src}: its header states the unit of positions; leave --mm-per-unit out")
    options = replace(options, mm_per_unit=options.mm_per_unit or mm_per_unit)
    height, width = read_picture(next(iter(poses))).pixels_dn.shape[:2]
    lens = stated_lens((width, height), lens_options.fx_px, lens_options.fy_px or lens_options.fx_px, lens_options)
    images = [PosedImage(path, lens, pose) for path, pose in poses.items()]
    return import_posed(out, [src], images, options, "import poses")


def read_poses(path: Path, images: Path) -> tuple[dict[Path, NDArray[np.float64]], float | None]:
    """Return the pose rt_cam_world (6,) of each image of a folder, and mm of its unit; None if the header says none.

    Columns are parted by commas, semicolons or tabs, and the first line names them in any order. Without quaternions
    all cameras look along z, with x right and y down.

    Raises
    ------
    MissingFile, BadValue
        The file cannot be read or lacks a column, a row is incomplete, a number is none, or a name leads out of the
        folder of images or is there twice.
    """
    header, rows = _read_cells(path)
    name = next((word for word in _NAMES if word in header), None)
    unit = next((unit for unit in _UNITS if all(axis + unit in header for axis in "xyz")), None)
    turned = [word for word in _QUATERNION if word in header]
    if name is None or unit is None or len(turned) not in (0, 4):
        raise BadValue(
            f"{path}: its columns are {', '.join(header)[:200]}; needed are name, x, y, z (or x_mm, y_mm, z_mm), "
            "and all or none of qw, qx, qy, qz: correct the first line"
        )
    poses: dict[Path, NDArray[np.float64]] = {}
    for number, row in enumerate(rows, 1):
        place = f"{path}: row {number}"
        if len(row) != len(header):
            raise BadValue(f"{place}: has {len(row)} columns, the first line {len(header)}; correct it")
        cells = dict(zip(header, row, strict=True))
        image = picture_named(images, cells[name], f"{place}: {name}")
        if image in poses:
            raise BadValue(f"{place}: {image.name} has a pose already; keep one row for each image")
        centre = _numbers(place, cells, [f"{axis}{unit}" for axis in "xyz"])
        rotation = _rotation(place, _numbers(place, cells, _QUATERNION)) if turned else np.eye(3)
        poses[image] = pose_of(rotation, centre)
    return poses, _UNITS[unit]


def _read_cells(path: Path) -> tuple[list[str], list[list[str]]]:
    """Return the names of the columns, in small letters, and the cells of each row."""
    lines = [line for line in read_text(path).removeprefix("\ufeff").splitlines() if line.strip()]
    lines = [line for line in lines if not line.startswith("#")]
    if not 2 <= len(lines) <= _MAX_ROWS + 1:
        raise BadValue(
            f"{path}: has {len(lines)} lines; a line that names the columns and 1 to {_MAX_ROWS} rows are needed"
        )
    delimiter = max(",;\t", key=lines[0].count)
    try:
        header, *rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter, strict=True)]
    except csv.Error as failure:
        raise BadValue(f"{path}: is no table that can be read ({failure}); export it as CSV") from failure
    header = [word.lower() for word in header]
    twice = next((word for word in header if header.count(word) > 1), None)
    if twice is not None:
        raise BadValue(f"{path}: has two columns {twice}; keep one of them")
    return header, rows


def _numbers(place: str, cells: dict[str, str], columns: Sequence[str]) -> NDArray[np.float64]:
    values = []
    for column in columns:
        try:
            values.append(float(cells[column]))
        except ValueError:
            values.append(np.nan)
        if not np.isfinite(values[-1]):
            raise BadValue(f"{place}: {column} = '{cells[column][:40]}' is no finite number; correct it")
    return np.array(values)


def _rotation(place: str, quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation (3, 3) of a unit quaternion (x, y, z, w)."""
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) <= _TOLERANCE:
        raise BadValue(f"{place}: qw, qx, qy, qz have the length {length:g}, that of a rotation is 1; correct them")
    return np.asarray(Rotation.from_quat(quaternion).as_matrix())
