"""Far side of a depth edge: it is hidden from one of the two neighbours, the near side from neither.

At an edge where the disparity changes from d₁ to d₂ the near surface covers the far one in the view on one side: the
one before if the disparity grows along the axis, the one after if it shrinks, whichever of both is near. Only the place
of the error tells near from far: it lies on the far side. So the test takes, on either side, the error in the view that
would be blind less that in the other view. Noise and texture are in both, and leave nothing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.arrangement.matching import displaced
from faintfield.calib.arrangement.pictures import Node, Picture

# Half of the window in px in which an edge is looked for, and on either side of which disparities are compared.
_REACH_PX = 7

# Limits of the hidden band in px: a narrower one cannot be seen, a wider one reaches beyond the window.
_MIN_BAND_PX, _MAX_BAND_PX = 1.5, 6

# Side of the window in px that finds disparities, and length along an edge over which errors are averaged.
_WINDOW_PX, _ALONG_PX = 9, 5

# Errors count no more than this, in standard deviations of the pictures: beyond it, one is as wrong as another.
_LARGEST_ERROR = 1.5

# Share by which two surfaces must explain an edge better than one.
_LEAST_GAIN = 0.05

# Side of the tiles in px whose means are the independent samples, rows between tested lines, and edges of a tile.
_TILE_PX, _LINE_PX, _MIN_EDGES = 32, 3, 3

type Errors = NDArray[np.float32]


@dataclass(frozen=True)
class NearAndFar:
    """The result of the test.

    Attributes
    ----------
    z : float
        Standard errors by which what is hidden lies where the disparity is larger, negative where it is smaller.
    edges, tiles : int
        Number of edges, and of the parts of the picture that count as samples.
    """

    z: float
    edges: int
    tiles: int


def find_far_side(
    pictures: Mapping[Node, Picture],
    nodes: Sequence[Node],
    shifts_px: NDArray[np.floating],
    *,
    distance: int,
    ratio: float,
) -> NearAndFar:
    """Test which sign of disparity is far.

    Parameters
    ----------
    pictures : mapping of node to array (row, column)
        Views by row and column; disparities along x and y have one sign.
    nodes : sequence of (int, int)
        Views whose edges are tested; each needs neighbours on both sides along a row, a column, or both.
    shifts_px : array (shift,)
        Disparities per node to compare, in ascending order.
    distance : int
        Nodes from a view to the neighbours that it is compared with.
    ratio : float
        Disparity along x over disparity along y.
    """
    tiles: dict[tuple[int, int, int], list[tuple[float, float]]] = {}
    for node in nodes:
        errors = _errors(pictures, node, shifts_px, distance, ratio)
        if not errors:
            continue
        best = _disparities(list(errors.values()))
        for axis, (before, after) in errors.items():
            scale = distance * (1.0 if axis == 0 else 1.0 / ratio)
            if axis == 1:
                before, after = before.transpose(0, 2, 1), after.transpose(0, 2, 1)
            index = best if axis == 0 else best.T
            for place, value, gain in _edges(before, after, index, scale * shifts_px):
                tiles.setdefault((axis, *place), []).append((value, gain))
    full = [np.array(values) for values in tiles.values() if len(values) >= _MIN_EDGES]
    samples = np.array([np.average(values[:, 0], weights=values[:, 1]) for values in full])
    edges = sum(map(len, tiles.values()))
    if len(samples) < 4 or not samples.std():
        return NearAndFar(0.0, edges, len(samples))
    return NearAndFar(float(samples.mean() / samples.std(ddof=1) * np.sqrt(len(samples))), edges, len(samples))


def _errors(
    pictures: Mapping[Node, Picture], node: Node, shifts_px: NDArray[np.floating], distance: int, ratio: float
) -> dict[int, tuple[Errors, Errors]]:
    """Return the errors (shift, row, column) of the view before and the one after, for each axis that has both."""
    row, column = node
    sides = {
        0: ((row, column - distance), (row, column + distance)),
        1: ((row - distance, column), (row + distance, column)),
    }
    found = {}
    for axis, pair in sides.items():
        if not all(node in pictures for node in pair):
            continue
        scale = distance * (1.0 if axis == 0 else 1.0 / ratio)
        both = []
        for sign, other in zip((-1, 1), pair, strict=True):
            layers = []
            for shift_px in sign * scale * shifts_px:
                moved = displaced(pictures[other], *((shift_px, 0.0) if axis == 0 else (0.0, shift_px)))
                layers.append(np.minimum(np.abs(pictures[node] - moved), _LARGEST_ERROR))
            both.append(np.stack(layers))
        found[axis] = (both[0], both[1])
    return found


def _disparities(pairs: Sequence[tuple[Errors, Errors]]) -> NDArray[np.intp]:
    """Return the index (row, column) of each pixel's best disparity, by the better of the views on either side."""
    total = sum(
        np.stack(
            [
                np.minimum(*(cv2.blur(layer, (_WINDOW_PX, _WINDOW_PX)) for layer in layers))
                for layers in zip(*pair, strict=True)
            ]
        )
        for pair in pairs
    )
    index = np.argmin(np.asarray(total), axis=0)
    return np.asarray(cv2.medianBlur(index.astype(np.float32), 5), np.intp)


def _edges(
    before: Errors, after: Errors, index: NDArray[np.intp], shifts_px: NDArray[np.floating]
) -> list[tuple[tuple[int, int], float, float]]:
    """Return tile, value and weight of each edge along the rows of a picture."""
    reach = _REACH_PX
    height, width = index.shape
    if width < 6 * reach or height < _ALONG_PX:
        return []
    moved_px = shifts_px[index]
    change = np.zeros((height, width))
    change[:, reach:-reach] = moved_px[:, 2 * reach :] - moved_px[:, : -2 * reach]
    size = np.abs(change)
    steep = size >= cv2.dilate(size, np.ones((1, 2 * reach + 1))) - 1e-9
    steep &= size >= _MIN_BAND_PX
    steep[:, : 3 * reach] = steep[:, -3 * reach :] = False
    steep[np.arange(height) % _LINE_PX > 0] = False
    rows, columns = np.nonzero(steep)
    values, gains = _values(before, after, index, shifts_px, rows, columns)
    return [
        ((int(row) // _TILE_PX, int(column) // _TILE_PX), float(value), float(gain))
        for row, column, value, gain in zip(rows, columns, values, gains, strict=True)
        if gain > _LEAST_GAIN
    ]


def _values(
    before: Errors,
    after: Errors,
    index: NDArray[np.intp],
    shifts_px: NDArray[np.floating],
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return by how much more is hidden on the side of larger disparity, and how clearly there is an edge.

    An edge is clear if two surfaces explain the window much better than either of them alone.
    """
    reach = _REACH_PX
    offsets = np.arange(-2 * reach, 2 * reach + 1)
    left, right = index[rows, columns - reach], index[rows, columns + reach]
    blurred = [_along_edges(view) for view in (before, after)]
    place = rows[:, np.newaxis], columns[:, np.newaxis] + offsets
    # Errors (edge, offset) if all of the window had the left disparity, or all of it the right one
    by_left = [view[left[:, np.newaxis], *place] for view in blurred]
    by_right = [view[right[:, np.newaxis], *place] for view in blurred]
    split, gain = _split(np.minimum(*by_left), np.minimum(*by_right))
    sign = np.sign(shifts_px[right] - shifts_px[left])[:, np.newaxis]
    band_px = np.clip(np.abs(shifts_px[right] - shifts_px[left]), 1, _MAX_BAND_PX).round()[:, np.newaxis]
    from_split = offsets - offsets[split][:, np.newaxis]
    on_right = (from_split >= 0) & (from_split < band_px)
    on_left = (from_split < 0) & (from_split >= -band_px)
    hidden_right = _mean_where(on_right, sign * (by_right[0] - by_right[1]))
    hidden_left = _mean_where(on_left, sign * (by_left[0] - by_left[1]))
    return sign[:, 0] * (hidden_right - hidden_left), gain


def _along_edges(errors: Errors) -> Errors:
    """Return errors averaged over a few pixels down the columns."""
    return np.stack([cv2.blur(layer, (1, _ALONG_PX)) for layer in np.ascontiguousarray(errors)])


def _split(by_left: NDArray[np.float32], by_right: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the offset's index (edge,) at which the right surface begins: the least error of both sides together.

    Also return by which share that error is less than one surface's.
    """
    first = np.cumsum(by_left, axis=1) - by_left
    rest = np.cumsum(by_right[:, ::-1], axis=1)[:, ::-1]
    total = (first + rest)[:, _REACH_PX:-_REACH_PX]
    alone = np.minimum(by_left.sum(axis=1), by_right.sum(axis=1))
    gain = 1 - total.min(axis=1) / np.maximum(alone, 1e-9)
    return np.asarray(np.argmin(total, axis=1) + _REACH_PX, np.intp), np.asarray(gain, np.float64)


def _mean_where(mask: NDArray[np.bool_], values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the mean (edge,) over the offsets of a mask."""
    return np.asarray((mask * values).sum(axis=1) / np.maximum(mask.sum(axis=1), 1), np.float64)
