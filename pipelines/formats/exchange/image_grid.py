"""Pictures taken on a regular grid, by the places that names state or by their order."""

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.arrangement.views import Node
from faintfield.calib.lens import Lens
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.exchange.grid_names import (
    Places,
    name_form,
    pictures_in,
    places_by_habit,
    places_by_pattern,
)
from faintfield.pipelines.formats.exchange.imported_set import PosedImage
from faintfield.pipelines.formats.files import some
from faintfield.rig.plan import centre_node, grid_nodes

# Largest ratio of missing pictures to those found; beyond it, the numbers in the names are not rows and columns.
_MAX_MISSING_RATIO = 10

# Largest step of numbers, such as 2 for every second view; times and serial numbers may have larger ones.
_MAX_STEP = 8

# Positions in the same row or column differ by less than this share of the largest distance between neighbours.
_SAME_LINE = 0.4

# Largest rms by which measured positions may leave the regular grid, in steps: beyond it they belong to other nodes.
_MAX_RMS_STEPS = 0.4

# Smallest distance between rows, in distances between columns: rows at one place are none.
_MIN_STEP = 0.05

# Displacement of a camera from the first node, right and down, in steps of the grid's columns.
type Steps = tuple[float, float]


@dataclass(frozen=True)
class ImageGrid:
    """A picture for the nodes (row, column) of a grid, row by row; some nodes may have none.

    Attributes
    ----------
    paths : dict of node to Path
        The pictures.
    measured : dict of node to (float, float), optional
        Measured places of the cameras, right and down of the first node in steps of the grid's columns; None for a
        regular grid.
    remarks : list of str
        Files left out and sizes guessed, in words.
    ordered, guessed : bool
        Names tell no more than an order, which may run by row or by column, and back and forth; that the grid is a
        square follows from the number of pictures only.
    sources, dn_per_value : list of Path, float, optional
        Files of the user that hold the pictures, and the factor by which float values became whole numbers.
    """

    paths: dict[Node, Path]
    measured: dict[Node, Steps] | None = None
    remarks: list[str] = field(default_factory=list)
    ordered: bool = False
    guessed: bool = False
    sources: list[Path] = field(default_factory=list)
    dn_per_value: float | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        last_row, last_column = map(max, zip(*self.paths, strict=True))
        return last_row + 1, last_column + 1

    @property
    def centre(self) -> int:
        """Index of the picture at the centre node, or at the nearest one that has a picture."""
        middle, nodes = centre_node(*self.size), list(self.paths)
        return min(range(len(nodes)), key=lambda index: math.dist(nodes[index], middle))

    def moved(self, nodes: Sequence[Node], *, transposed: bool = False, omit: Collection[int] = ()) -> "ImageGrid":
        """Return the grid with its pictures at other nodes, some left out by their places in the list.

        Measured positions go with their cameras; the distance between columns remains their unit, or takes its place.
        """
        moves = sorted(zip(nodes, self.paths, strict=True))
        measured = self.measured
        if measured is not None:  # all cameras tell the unit, those whose pictures are left out, too
            places = {to: measured[node] for to, node in moves}
            measured = measured_steps({to: (y, x) if transposed else (x, y) for to, (x, y) in places.items()})
        left_out = {nodes[index] for index in omit}
        paths = {to: self.paths[node] for to, node in moves if to not in left_out}
        return replace(self, paths=paths, measured=measured and {to: measured[to] for to in paths})

    def posed(self, lens: Lens, pitch_mm: float, disparity_px: float, ratio: float = 1.0) -> list[PosedImage]:
        """Return the pictures at measured poses where positions were measured, else at nominal ones.

        `pitch_mm` is the distance between columns, their mean if positions were measured; else that between rows, and
        `ratio` the pitch along columns over that along rows. Aligning pictures on a plane has moved their principal
        points by as much as the plane moved from node to node, `disparity_px`.
        """
        places = self.measured or {(row, column): (ratio * column, float(row)) for row, column in self.paths}
        right_0, down_0 = places[list(self.paths)[self.centre]]
        images = []
        for node, path in self.paths.items():
            right, down = places[node][0] - right_0, places[node][1] - down_0
            pose = np.array([0, 0, 0, -pitch_mm * right, -pitch_mm * down, 0])
            moved = replace(lens, cx_px=lens.cx_px + disparity_px * right, cy_px=lens.cy_px + disparity_px * down)
            images.append(PosedImage(path, moved, pose, node))
        return images


def find_grid(
    folder: Path,
    rows: int | None = None,
    columns: int | None = None,
    pattern: str | None = None,
    *,
    running: tuple[int, int] | None = None,
) -> ImageGrid:
    """Return the pictures of a folder by node.

    With the size of the grid, `rows` and `columns`, pictures are taken in the order of their names, which tell where
    some are missing; else names tell, by a pattern or by habit, see `grid_names`. `running` is the size for names with
    running numbers, if a file beside the pictures states it.

    Raises
    ------
    MissingFile
        There is no such folder, it holds no pictures that are read, or half of the nodes have none, or names do not
        tell which.
    BadValue
        A name has no row and column, two pictures have the same, there are more than nodes, or a pattern matches not
        all names.
    """
    paths, remarks = pictures_in(folder, every=pattern is not None)
    names = [path.name for path in paths]
    if pattern is None and (rows or columns):
        return _grid_in_order(folder, paths, rows or 1, columns or 1, remarks)
    if pattern is None and len(paths) == 1:
        return ImageGrid({(0, 0): paths[0]}, remarks=remarks, sources=paths)
    if running is None and pattern is not None and rows and columns:
        running = rows, columns
    try:
        places = places_by_habit(names) if pattern is None else places_by_pattern(pattern, names)
        nodes, remark = nodes_of(places, running)
        double = Counter(nodes).most_common(1)[0][0]
        alike = [name for name, node in zip(names, nodes, strict=True) if node == double]
        if len(alike) > 1:
            raise BadValue(f"{alike[1]}: is at node {double} like {alike[0]}; keep one of the two")
        nodes = _count_from_zero(nodes)
        positions = sorted(zip(nodes, places.get("x", []), places.get("y", []), strict=False))
        measured = measured_steps({node: (x, y) for node, x, y in positions}) if len(positions) > 1 else None
    except BadValue as failure:
        raise BadValue(f"{folder}: {failure}") from failure
    remarks += [remark] if remark else []
    if measured:
        remarks.append(f"names state positions ({names[0]}): the cameras are placed by them")
    by_index = places.keys() == {"index"}
    grid_paths = dict(sorted(zip(nodes, paths, strict=True)))
    grid = ImageGrid(grid_paths, measured, remarks, by_index, by_index and running is None, list(grid_paths.values()))
    _check_size(folder, grid, rows, columns)
    remarks += _missing_remark(grid.paths, *grid.size)
    return grid


def _grid_in_order(folder: Path, paths: list[Path], rows: int, columns: int, remarks: list[str]) -> ImageGrid:
    """Return the pictures at the nodes in order, row by row, or without those that are missing by their names."""
    count, size = len(paths), rows * columns
    left_out = "".join(f" ({text})" for text in remarks)
    if count > size:
        usual = Counter(map(name_form, paths)).most_common(1)[0][0]
        unlike = [path.name for path in paths if name_form(path) != usual]
        alike = [path.name for path in paths if name_form(path) == usual]
        extra = [*unlike, *reversed(alike)][: count - size]
        raise BadValue(
            f"{folder}: holds {count} pictures, {count - size} too many for a grid of {rows} x {columns}: "
            f"{some(extra)}, unlike the others by name, or the last; move what is no view away, or correct --rows and "
            f"--columns{left_out}"
        )
    nodes = list(grid_nodes(rows, columns))
    if count < size:
        told = _nodes_by_name([path.name for path in paths], rows, columns)
        if told is None or 2 * count <= size:
            which, them = ("which one is", "it") if size - count == 1 else ("which are", "them")
            raise MissingFile(
                f"{folder}: holds {count} pictures, {size - count} fewer than a grid of {rows} x {columns} has, and "
                f"their names do not tell {which} missing; add {them}, name all by row and column (view_r0_c0.png), or "
                f"correct --rows and --columns{left_out}"
            )
        nodes = told
    grid_paths = dict(zip(nodes, paths, strict=True))
    remarks = [*remarks, *_missing_remark(grid_paths, rows, columns)]
    return ImageGrid(grid_paths, remarks=remarks, ordered=True, sources=paths)


def _nodes_by_name(names: Sequence[str], rows: int, columns: int) -> list[Node] | None:
    """Return the nodes of names in order that leave some of a grid out, None if the names do not tell them.

    They tell by row and column, or by running numbers whose first and last are there.
    """
    try:
        places = places_by_habit(names)
    except BadValue:
        return None
    if "index" in places:
        numbers = np.array(places["index"], int)
        nodes = [divmod(place, columns) for place in (numbers - numbers.min()).tolist()]
        told = nodes[-1] == (rows - 1, columns - 1)
    else:
        nodes = _count_from_zero(nodes_of(places)[0])
        told = "row" in places and tuple(np.max(nodes, axis=0) + 1) == (rows, columns)
    return nodes if told and nodes == sorted(set(nodes)) else None


def _missing_remark(nodes: Collection[Node], rows: int, columns: int) -> list[str]:
    """Return a sentence that names the nodes of a grid without a picture; none if all have one."""
    missing = [f"row {row}, column {column}" for row, column in grid_nodes(rows, columns) if (row, column) not in nodes]
    if not missing:
        return []
    one = len(missing) == 1
    return [
        f"warning: {len(missing)} of {rows * columns} pictures {'is' if one else 'are'} missing, counted from 0: "
        f"{some(missing, '; ')}; the set is made without {'it' if one else 'them'}"
    ]


def _count_from_zero(nodes: Sequence[Node]) -> list[Node]:
    """Return nodes counted in the common steps of rows and of columns: every second view is a grid."""
    numbers = np.array(nodes) - np.min(nodes, axis=0)
    steps = [step if 0 < (step := math.gcd(*line)) <= _MAX_STEP else 1 for line in numbers.T.tolist()]
    return [(row, column) for row, column in (numbers // steps).tolist()]


def _check_size(folder: Path, grid: ImageGrid, rows: int | None, columns: int | None) -> None:
    """Refuse a grid of which half is missing, or of another size than stated."""
    (row_count, column_count), count, first = grid.size, len(grid.paths), next(iter(grid.paths.values())).name
    missing = row_count * column_count - count
    if missing > _MAX_MISSING_RATIO * count:
        raise BadValue(
            f"{folder}: numbers in names like {first} would make a grid of {row_count} x {column_count} of {count} "
            "pictures, so they are not row and column; give --rows and --columns to take files in order, or --pattern"
        )
    if missing >= count:
        row, column = next(node for node in np.ndindex(grid.size) if node not in grid.paths)
        raise MissingFile(
            f"{folder}: the view in row {row} and column {column}, counted from 0, is missing, {missing} of "
            f"{missing + count} in all; add it, or give --rows and --columns, or --pattern, if numbers in names like "
            f"{first} are not row and column"
        )
    if (rows or row_count, columns or column_count) != grid.size:
        raise BadValue(
            f"{folder}: --pattern makes a grid of {row_count} x {column_count}, --rows and --columns say otherwise; "
            "give one of them, or correct them"
        )


def nodes_of(places: Places, size: tuple[int, int] | None = None) -> tuple[list[Node], str]:
    """Return row and column of each picture, and a sentence on how they follow, empty where the names say them.

    Running numbers make a grid of `size`, or a square if that is not known.

    Raises
    ------
    BadValue
        Running numbers have gaps, or no known size.
    """
    if {"row", "column"} <= places.keys():
        return [(int(row), int(column)) for row, column in zip(places["row"], places["column"], strict=True)], ""
    if {"x", "y"} <= places.keys():
        across, down = np.array(places["x"]), np.array(places["y"])
        gap = _SAME_LINE * max(float(np.diff(np.sort(values)).max(initial=0.0)) for values in (across, down))
        nodes = list(zip(_lines(down, gap), _lines(across, gap), strict=True))
        return nodes, "rows and columns follow from the positions in the names: x along a row, y along a column"
    indices = [int(index) for index in places["index"]]
    first, last, count = min(indices), max(indices), len(indices)
    side = math.isqrt(count)
    rows, columns = size or (side, side)
    double, times = Counter(indices).most_common(1)[0]
    if times > 1:
        raise BadValue(
            f"two pictures have the number {double}; keep one of them, or give --pattern, or --rows and --columns"
        )
    if rows * columns != count or last - first != count - 1:
        lacking = (
            min(set(range(first, first + count)) - set(indices), default=None) if last - first < 2 * count else None
        )
        lacks = "" if lacking is None else f" without {lacking}"
        raise BadValue(
            f"names count {count} pictures by one number, from {first} to {last}{lacks}, which is no square grid "
            "and no row and column; give --rows and --columns to take files in order, or --pattern"
        )
    remark = f"names count {count} pictures by one number; they are taken as {side} x {side}, row by row"
    return [divmod(index - first, columns) for index in indices], "" if size else remark


def _lines(values: NDArray[np.float64], gap: float) -> list[int]:
    """Return the number of the row or column of each position: a new one begins after a gap."""
    order = np.argsort(values)
    numbers = np.empty(len(values), int)
    numbers[order] = np.append(0, np.cumsum(np.diff(values[order]) > gap))
    return numbers.tolist()


def measured_steps(positions: Mapping[Node, tuple[float, float]]) -> dict[Node, Steps]:
    """Return measured positions (x, y) of cameras in steps of the grid's columns, right and down.

    Unit and directions of the positions are not known and follow from the nodes: right is where columns grow, down
    where rows grow, and the mean distance between columns is 1. Deviations across a single row or column are dropped.

    Raises
    ------
    BadValue
        The positions do not follow rows and columns.
    """
    nodes = np.array(list(positions), float)
    places = np.array(list(positions.values()), float)
    centred, moved = nodes - nodes.mean(axis=0), places - places.mean(axis=0)
    slopes = np.linalg.lstsq(centred, moved, rcond=None)[0]  # (row, column) by (x, y)
    along = np.array([slopes[1, 0], slopes[0, 1]])  # x per column, y per row
    extent = np.ptp(nodes[:, ::-1], axis=0)  # columns, rows
    unit = float(abs(along[0]) if extent[0] else abs(along[1]))
    fits = unit > 0 and np.sqrt(np.mean((moved - centred @ slopes) ** 2)) <= _MAX_RMS_STEPS * unit
    apart = np.abs(along) >= _MIN_STEP * unit
    if not fits or np.abs(np.diag(slopes)).max() > _MAX_RMS_STEPS * unit or not (apart | (extent == 0)).all():
        raise BadValue(
            "the positions in the names do not follow their rows and columns (x along a row, y along a column); "
            "exchange {x} and {y} in --pattern, or put * in their place to do without"
        )
    steps = moved * np.sign(along) / unit * (extent > 0)
    first = steps[int(np.argmin(nodes.sum(axis=1)))]
    return {node: (float(right), float(down)) for node, (right, down) in zip(positions, steps - first, strict=True)}
