"""Cameras by row and column: from what names say of each, and their measured positions in steps of the grid."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.exchange.grid_names import Place

# Positions in the same row or column differ by less than this share of the largest distance between neighbours.
_SAME_LINE = 0.4

# Largest rms by which measured positions may leave the regular grid, in steps: beyond it they belong to other nodes.
_MAX_RMS_STEPS = 0.4

# Smallest distance between rows, in distances between columns: rows at one place are none.
_MIN_STEP = 0.05

type Node = tuple[int, int]

# How far a camera is from the first node, right and down, in steps of the grid's columns.
type Steps = tuple[float, float]


def nodes_of(places: Sequence[Place], rows: int | None = None, columns: int | None = None) -> tuple[list[Node], str]:
    """Return row and column of each picture, and a sentence on how they follow, empty where the names say them.

    Parameters
    ----------
    places : sequence of Place
        What the names say.
    rows, columns : int, optional
        Size of the grid for running numbers, if it is known; otherwise a square number of pictures makes a square.

    Raises
    ------
    BadValue
        Running numbers have gaps, or no known size; positions are not those of rows and columns.
    """
    if all(place.row is not None and place.column is not None for place in places):
        return [(place.row or 0, place.column or 0) for place in places], ""
    if all(place.x is not None and place.y is not None for place in places):
        across, down = (np.array([getattr(place, axis) for place in places], float) for axis in "xy")
        gap = _SAME_LINE * max(_largest_gap(across), _largest_gap(down))
        nodes = list(zip(_lines(down, gap), _lines(across, gap), strict=True))
        return nodes, "rows and columns follow from the positions in the names: x along a row, y along a column"
    return _nodes_of_indices([place.index or 0 for place in places], rows, columns)


def _nodes_of_indices(indices: Sequence[int], rows: int | None, columns: int | None) -> tuple[list[Node], str]:
    """Return the nodes of running numbers, row by row."""
    first, last, count = min(indices), max(indices), len(indices)
    known = rows is not None and columns is not None
    side = math.isqrt(count)
    rows, columns = (rows or side, columns or side) if known else (side, side)
    if len(set(indices)) != count:
        double = next(index for index in indices if indices.count(index) > 1)
        raise BadValue(
            f"two pictures have the number {double}; keep one of them, or give --pattern, or --rows and --columns"
        )
    if rows * columns != count or last - first != count - 1:
        gaps = sorted(set(range(first, last + 1)) - set(indices))[:1] if last - first < 2 * count else []
        lacks = f" without {gaps[0]}" if gaps else ""
        raise BadValue(
            f"names count {count} pictures by one number, from {first} to {last}{lacks}, which is no square grid "
            "and no row and column; give --rows and --columns to take files in order, or --pattern"
        )
    nodes = [divmod(index - first, columns) for index in indices]
    said = "" if known else f"names count {count} pictures by one number; they are taken as {side} x {side}, row by row"
    return nodes, said


def _largest_gap(values: NDArray[np.float64]) -> float:
    return float(np.diff(np.sort(values)).max(initial=0.0))


def _lines(values: NDArray[np.float64], gap: float) -> list[int]:
    """Return the number of the row or column of each position: a new one begins after a gap."""
    order = np.argsort(values)
    numbers = np.empty(len(values), int)
    numbers[order] = np.append(0, np.cumsum(np.diff(values[order]) > gap))
    return [int(number) for number in numbers]


def measured_steps(positions: Mapping[Node, tuple[float, float]]) -> dict[Node, Steps]:
    """Return measured positions (x, y) of cameras in steps of the grid's columns, right and down.

    The unit and the directions of the positions are not known, so these are taken from the nodes: right is where
    columns grow, down where rows grow, and the mean distance between columns is 1. The distance between rows follows in
    that unit. Where there is one row, or one column, the direction across it is not known and deviations are dropped.

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
