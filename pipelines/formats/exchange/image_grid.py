"""Pictures taken on a regular grid, found by the numbers in their names or by their order."""

import re
from dataclasses import dataclass, replace
from pathlib import Path

from faintfield.calib.lens import Lens
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.exchange.imported_set import PosedImage
from faintfield.pipelines.formats.frames import IMAGE_SUFFIXES
from faintfield.pipelines.formats.reading import is_file, is_folder
from faintfield.rig.plan import centre_node, grid_nodes, nominal_poses_rt_cam_ref

# Largest ratio of missing pictures to those found; beyond it, the numbers in the names are not rows and columns.
_MAX_MISSING_RATIO = 10

# Digits of the largest row or column: times and serial numbers have more.
_MAX_DIGITS = 9

type Node = tuple[int, int]


@dataclass(frozen=True)
class ImageGrid:
    """A picture for every node (row, column) of a grid, row by row."""

    paths: dict[Node, Path]

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        last_row, last_column = map(max, zip(*self.paths, strict=True))
        return last_row + 1, last_column + 1

    @property
    def centre(self) -> int:
        """Index of the picture at the centre node."""
        return list(self.paths).index(centre_node(*self.size))

    def posed(self, lens: Lens, pitch_mm: float, disparity_px: float) -> list[PosedImage]:
        """Return the pictures at nominal poses.

        Parameters
        ----------
        lens : Lens
            The camera's lens.
        pitch_mm : float
            Distance between neighbouring nodes.
        disparity_px : float
            For pictures aligned on a plane: how far that plane moved from node to node before it was aligned.
            Aligning has moved the principal points by as much.
        """
        row_0, column_0 = centre_node(*self.size)
        poses = nominal_poses_rt_cam_ref(*self.size, pitch_mm)
        images = []
        for ((row, column), path), pose in zip(self.paths.items(), poses, strict=True):
            cx_px = lens.cx_px + disparity_px * (column - column_0)
            cy_px = lens.cy_px + disparity_px * (row - row_0)
            images.append(PosedImage(path, replace(lens, cx_px=cx_px, cy_px=cy_px), pose, (row, column)))
        return images


def find_grid(folder: Path, rows: int | None = None, columns: int | None = None) -> ImageGrid:
    """Return the pictures of a folder by node.

    Parameters
    ----------
    folder : Path
        Where they lie.
    rows, columns : int, optional
        Size of the grid; the pictures are then taken in the order of their names. When both are None, the last two
        numbers of a name are its row and column.

    Raises
    ------
    MissingFile
        There is no such folder, it holds no pictures, or a node has none.
    BadValue
        A name has no row and column, or two pictures have the same.
    """
    if not is_folder(folder):
        raise MissingFile(f"{folder}: no such folder; name the folder that holds the pictures")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and is_file(path))
    if not paths:
        raise MissingFile(f"{folder}: holds no pictures; formats read are {', '.join(sorted(IMAGE_SUFFIXES))}")
    if rows is not None or columns is not None:
        return _in_order(folder, paths, rows or 1, columns or 1)
    if len(paths) == 1:
        return ImageGrid({(0, 0): paths[0]})
    named: dict[Node, Path] = {}
    for path in paths:
        numbers = re.findall(r"[0-9]+", path.stem)
        if len(numbers) < 2:
            raise BadValue(f"{path}: its name has no row and column; give --rows and --columns to take files in order")
        if max(map(len, numbers[-2:])) > _MAX_DIGITS:
            raise BadValue(
                f"{path}: its name has a number of more than {_MAX_DIGITS} digits, which is no row or column; "
                "give --rows and --columns to take files in order"
            )
        node = int(numbers[-2]), int(numbers[-1])
        if node in named:
            raise BadValue(f"{path}: is at node {node} like {named[node].name}; keep one of the two")
        named[node] = path
    return _counted_from_zero(folder, named)


def _in_order(folder: Path, paths: list[Path], rows: int, columns: int) -> ImageGrid:
    """Return pictures in the order of their names as a grid of the size given."""
    if len(paths) != rows * columns:
        raise MissingFile(
            f"{folder}: holds {len(paths)} pictures, a grid of {rows} x {columns} needs {rows * columns}; "
            "correct --rows and --columns, or add the missing ones"
        )
    return ImageGrid(dict(zip(grid_nodes(rows, columns), paths, strict=True)))


def _counted_from_zero(folder: Path, named: dict[Node, Path]) -> ImageGrid:
    """Return pictures with their nodes counted from zero; refuse a grid with a gap."""
    row_0, column_0 = (min(node[axis] for node in named) for axis in (0, 1))
    grid = ImageGrid({(row - row_0, column - column_0): path for (row, column), path in sorted(named.items())})
    rows, columns = grid.size
    missing = rows * columns - len(named)
    if missing > _MAX_MISSING_RATIO * len(named):
        example = next(iter(grid.paths.values())).name
        raise BadValue(
            f"{folder}: numbers in names like {example} would make a grid of {rows} x {columns} "
            f"of {len(named)} pictures, so they are not row and column; "
            "give --rows and --columns to take files in order"
        )
    if missing:
        row, column = next(node for node in grid_nodes(rows, columns) if node not in grid.paths)
        raise MissingFile(
            f"{folder}: the view of node {(row + row_0, column + column_0)} is missing, "
            f"{missing} of {rows * columns} in all; add it, or give --rows and --columns for a smaller grid"
        )
    return grid
