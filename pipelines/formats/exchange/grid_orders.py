"""The order of a grid that its pictures bear out where names mistake it: column by column, back and forth."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.arrangement.look import Look, look
from faintfield.calib.arrangement.orientation import Orientation
from faintfield.pipelines.errors import AmbiguousOrder
from faintfield.pipelines.formats.exchange.image_grid import ImageGrid

# Share of other pictures that neighbours fit better than, from which no other order is tried in place of a square.
_SURELY = 0.95

# Correlation by which the blocks must agree better in another order of a list.
_CLEARLY_MORE = 0.05

# Displacement in px beyond what disparities explain from which names may run back and forth, and the share of it that
# may remain if they do.
_DOUBTFUL_PX, _CLEARLY_LESS = 0.15, 0.5

type Grey = Callable[[Path], NDArray[np.float32]]


def look_at_grid(grid: ImageGrid, given: Orientation | None, read: Grey) -> tuple[ImageGrid, Look]:
    """Look at a grid; where its order is doubtful, look at others, and take the one in which the pictures agree."""
    found = _look(grid, given, read)
    if given is not None or grid.measured is not None or min(grid.size) == 1:
        return grid, found
    if grid.guessed and not _surely_fits(found):
        grid, found = _square_or_line(grid, found, given, read)
    rows, columns = grid.size
    if grid.ordered and rows != columns:
        other = replace(grid, paths={(k % rows, k // rows): path for k, path in enumerate(grid.paths.values())})
        seen = _look(other, given, read)
        # The order as documented unless the other agrees clearly more
        if seen.seen and seen.level > found.level + _CLEARLY_MORE:
            grid, found = other, seen
    if min(grid.size) > 1 and found.seen and _shifts_px(found) > _DOUBTFUL_PX:
        for other in _back_and_forth(grid):
            seen = _look(other, given, read)
            fits = seen.seen and len(seen.odd) <= len(found.odd) and seen.level >= found.level
            if fits and _shifts_px(seen) < _CLEARLY_LESS * _shifts_px(found):
                grid, found = other, seen
    return grid, found


def _square_or_line(grid: ImageGrid, found: Look, given: Orientation | None, read: Grey) -> tuple[ImageGrid, Look]:
    """Return the grid as the square that was guessed, or as one line of views, in whichever the neighbours fit.

    Raises
    ------
    AmbiguousOrder
        They fit in both.
    """
    rows, columns = grid.size
    count = rows * columns
    line = replace(
        grid,
        paths={(0, place): path for place, path in enumerate(grid.paths.values())},
        said=[*grid.said, f"the pictures show one line of {count} views, not {rows} x {columns}"],
    )
    seen = _look(line, given, read)
    if not seen.seen or seen.order.verdict != "fits" or _runs_back_and_forth(grid, given, read):
        return grid, found
    if not found.seen or found.order.verdict == "denied":
        return line, seen
    if found.order.verdict == "fits" and found.order.share < seen.order.share:
        raise AmbiguousOrder(
            f"{next(iter(grid.paths.values())).parent}: the views may be a grid of {rows} x {columns}, whose "
            f"neighbours fit better than {found.order.share:.0%} of other pictures, or one line of {count}, whose "
            f"neighbours fit better than {seen.order.share:.0%}; give --rows {rows} --columns {columns}, "
            f"--rows 1 --columns {count}, or --rows {count} --columns 1"
        )
    return grid, found


def _surely_fits(found: Look) -> bool:
    """Return whether neighbours fit better than nearly all other pictures."""
    return found.seen and found.order.verdict == "fits" and found.order.share > _SURELY


def _runs_back_and_forth(grid: ImageGrid, given: Orientation | None, read: Grey) -> bool:
    """Return whether a square fits whose rows run back and forth; the views of such a one make a line, too."""
    return any(_surely_fits(_look(other, given, read)) for other in _back_and_forth(grid))


def _look(grid: ImageGrid, given: Orientation | None, read: Grey) -> Look:
    paths = list(grid.paths.values())
    return look(list(grid.paths), lambda index: read(paths[index]), given)


def _shifts_px(found: Look) -> float:
    """Return how far views are from where a grid would have them, root mean square."""
    return float(np.sqrt(np.mean(found.shift_px**2)))


def _back_and_forth(grid: ImageGrid) -> list[ImageGrid]:
    """Return the grid with every other row reversed, as gantries move, and with every other column."""
    last_row, last_column = grid.size[0] - 1, grid.size[1] - 1
    orders = []
    for what in ("row", "column"):
        paths = {}
        for (row, column), path in grid.paths.items():
            if what == "row":
                node = (row, last_column - column if row % 2 else column)
            else:
                node = (last_row - row if column % 2 else row, column)
            paths[node] = path
        said = [*grid.said, f"names run back and forth: the pictures agree if every other {what} is reversed"]
        orders.append(replace(grid, paths={node: paths[node] for node in sorted(paths)}, said=said))
    return orders
