"""Pictures taken on a regular grid, found by their names or by their order."""

from dataclasses import dataclass, field, replace
from math import dist, gcd
from pathlib import Path

import numpy as np

from faintfield.calib.arrangement.orientation import Orientation
from faintfield.calib.lens import Lens
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.exchange.grid_names import Place, by_number, places_by_habit, places_by_pattern
from faintfield.pipelines.formats.exchange.grid_places import Node, Steps, measured_steps, nodes_of
from faintfield.pipelines.formats.exchange.imported_set import PosedImage
from faintfield.pipelines.formats.exchange.picture_folder import pictures_in
from faintfield.rig.plan import centre_node, grid_nodes

# Largest ratio of missing pictures to those found; beyond it, the numbers in the names are not rows and columns.
_MAX_MISSING_RATIO = 10

# Largest step of numbers, such as 2 for every second view; times and serial numbers may have larger ones.
_MAX_STEP = 8


@dataclass(frozen=True)
class ImageGrid:
    """A picture for the nodes (row, column) of a grid, row by row; some nodes may have none.

    Attributes
    ----------
    paths : dict of node to Path
        The pictures.
    measured : dict of node to (float, float), optional
        Where each camera was measured to be, right and down of the first node in steps of the grid's columns; None for
        a regular grid.
    said : list of str
        What a person should know of how the pictures were found: files left out, sizes guessed.
    ordered : bool
        Names tell no more than an order, which may run by row or by column, and back and forth.
    guessed : bool
        That the grid is a square follows from the number of pictures only.
    """

    paths: dict[Node, Path]
    measured: dict[Node, Steps] | None = None
    said: list[str] = field(default_factory=list)
    ordered: bool = False
    guessed: bool = False

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        last_row, last_column = map(max, zip(*self.paths, strict=True))
        return last_row + 1, last_column + 1

    @property
    def centre(self) -> int:
        """Index of the picture at the centre node, or at the nearest one that has a picture."""
        middle, nodes = centre_node(*self.size), list(self.paths)
        return min(range(len(nodes)), key=lambda index: dist(nodes[index], middle))

    @property
    def missing(self) -> list[Node]:
        """Nodes without a picture."""
        return [node for node in grid_nodes(*self.size) if node not in self.paths]

    def steps_from_centre(self) -> dict[Node, Steps]:
        """Return how far each camera is right and down of the one at `centre`, in steps of the grid."""
        centre = list(self.paths)[self.centre]
        places = self.measured or {(row, column): (float(column), float(row)) for row, column in self.paths}
        right_0, down_0 = places[centre]
        return {node: (right - right_0, down - down_0) for node, (right, down) in places.items()}

    def turned(self, by: Orientation) -> "ImageGrid":
        """Return the grid with rows and columns exchanged first, then counted from the other end.

        Measured positions go with their cameras; the distance between columns remains their unit, or takes its place.
        """
        moved = dict(zip(self.paths, by.of(list(self.paths)), strict=True))
        paths = {moved[node]: path for node, path in self.paths.items()}
        measured = None
        if self.measured is not None:
            positions = {moved[node]: steps[::-1] if by.transpose else steps for node, steps in self.measured.items()}
            measured = measured_steps({node: positions[node] for node in sorted(positions)})
        return replace(self, paths={node: paths[node] for node in sorted(paths)}, measured=measured)

    def without(self, left_out: list[Node]) -> "ImageGrid":
        """Return the grid without the pictures of some nodes."""
        paths = {node: path for node, path in self.paths.items() if node not in left_out}
        measured = self.measured and {node: self.measured[node] for node in paths}
        return replace(self, paths=paths, measured=measured)

    def posed(self, lens: Lens, pitch_mm: float, disparity_px: float, ratio: float = 1.0) -> list[PosedImage]:
        """Return the pictures at measured poses where positions were measured, else at nominal ones.

        Parameters
        ----------
        lens : Lens
            The camera's lens.
        pitch_mm : float
            Distance between neighbouring nodes: the mean distance between columns, if positions were measured.
        disparity_px : float
            For pictures aligned on a plane: how far that plane moved from node to node before it was aligned.
            Aligning has moved the principal points by as much.
        ratio : float
            Pitch along columns over pitch along rows, if positions were not measured; `pitch_mm` and `disparity_px`
            are those along rows.
        """
        steps = self.steps_from_centre()
        images = []
        for node, path in self.paths.items():
            right, down = steps[node]
            if self.measured is None:
                right *= ratio
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

    Parameters
    ----------
    folder : Path
        Where they lie.
    rows, columns : int, optional
        Size of the grid; the pictures are then taken in the order of their names. When both are None, names tell, see
        `grid_names`.
    pattern : str, optional
        What the names say, such as "{name}_{row}_{column}_{y}_{x}.png".
    running : (int, int), optional
        Rows and columns of the grid, for names with running numbers, if a file beside the pictures states them.

    Raises
    ------
    MissingFile
        There is no such folder, it holds no pictures that are read, or half of the nodes have none.
    BadValue
        A name has no row and column, two pictures have the same, or a pattern matches not all names.
    """
    paths, said = pictures_in(folder, every=pattern is not None)
    names = [path.name for path in paths]
    if pattern is not None:
        places = places_by_pattern(pattern, names)
        running = running or ((rows, columns) if rows and columns else None)
    elif rows is not None or columns is not None:
        return _in_order(folder, paths, rows or 1, columns or 1, said)
    elif len(paths) == 1:
        return ImageGrid({(0, 0): paths[0]}, said=said)
    else:
        places = _of(folder, names)
    try:
        nodes, how = nodes_of(places, *(running or (None, None)))
    except BadValue as failure:
        raise BadValue(f"{folder}: {failure}") from failure
    named: dict[Node, Path] = {}
    for node, path in zip(nodes, paths, strict=True):
        if node in named:
            raise BadValue(f"{path}: is at node {node} like {named[node].name}; keep one of the two")
        named[node] = path
    grid = _counted_from_zero(folder, named)
    if (rows or grid.size[0], columns or grid.size[1]) != grid.size:
        raise BadValue(
            f"{folder}: --pattern makes a grid of {grid.size[0]} x {grid.size[1]}, --rows and --columns say otherwise; "
            "give one of them, or correct them"
        )
    measured = _measured(folder, named, dict(zip(nodes, places, strict=True)))
    if measured:
        said = [*said, f"names state positions ({names[0]}): the cameras are placed by them"]
    by_index = _by_index(places)
    said = [*said, how] if how else said
    return replace(grid, measured=measured, said=said, ordered=by_index, guessed=by_index and running is None)


def _by_index(places: list[Place]) -> bool:
    """Return whether names tell no more than an order."""
    return all(place.index is not None and place.row is None and place.x is None for place in places)


def _of(folder: Path, names: list[str]) -> list[Place]:
    """Return what names say by habit; a failure names the folder."""
    try:
        return places_by_habit(names)
    except BadValue as failure:
        raise BadValue(f"{folder}/{failure}") from failure


def _measured(folder: Path, named: dict[Node, Path], places: dict[Node, Place]) -> dict[Node, Steps] | None:
    """Return the measured positions by node counted from zero, None if not all names state one."""
    counted = _counted(named)
    positions = {
        counted[node]: (place.x, place.y)
        for node, place in sorted(places.items(), key=lambda item: item[0])
        if place.x is not None and place.y is not None
    }
    if len(positions) < max(len(places), 2):
        return None
    try:
        return measured_steps(positions)
    except BadValue as failure:
        raise BadValue(f"{folder}: {failure}") from failure


def _in_order(folder: Path, paths: list[Path], rows: int, columns: int, said: list[str]) -> ImageGrid:
    """Return pictures in the order of their names as a grid of the size given."""
    if len(paths) != rows * columns:
        raise MissingFile(
            f"{folder}: holds {len(paths)} pictures, a grid of {rows} x {columns} needs {rows * columns}; "
            "correct --rows and --columns, or add the missing ones" + "".join(f" ({remark})" for remark in said)
        )
    in_order = sorted(paths, key=lambda path: by_number(path.name))
    return ImageGrid(dict(zip(grid_nodes(rows, columns), in_order, strict=True)), said=said, ordered=True)


def _counted(named: dict[Node, Path]) -> dict[Node, Node]:
    """Return each node counted from zero in the common steps of rows and of columns: every second view is a grid."""
    row_0, column_0 = (min(node[axis] for node in named) for axis in (0, 1))
    by_rows = _step([row - row_0 for row, _ in named])
    by_columns = _step([column - column_0 for _, column in named])
    return {(row, column): ((row - row_0) // by_rows, (column - column_0) // by_columns) for row, column in named}


def _step(numbers: list[int]) -> int:
    """Return the common step of numbers that begin at zero, 1 if it is too large to be every n-th view."""
    step = gcd(*numbers)
    return step if 0 < step <= _MAX_STEP else 1


def _counted_from_zero(folder: Path, named: dict[Node, Path]) -> ImageGrid:
    """Return pictures with their nodes counted from zero; refuse a grid of which half is missing."""
    counted = _counted(named)
    grid = ImageGrid({counted[node]: named[node] for node in sorted(named)})
    rows, columns = grid.size
    missing = rows * columns - len(named)
    if missing > _MAX_MISSING_RATIO * len(named):
        example = next(iter(grid.paths.values())).name
        raise BadValue(
            f"{folder}: numbers in names like {example} would make a grid of {rows} x {columns} "
            f"of {len(named)} pictures, so they are not row and column; "
            "give --rows and --columns to take files in order, or --pattern"
        )
    if missing >= len(named):
        row, column = grid.missing[0]
        raise MissingFile(
            f"{folder}: the view in row {row} and column {column}, counted from 0, is missing, "
            f"{missing} of {rows * columns} in all; add it, or give --rows and --columns for a smaller grid"
        )
    return grid
