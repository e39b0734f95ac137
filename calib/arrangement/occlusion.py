"""Far side of a depth edge: it is hidden from one of the two neighbours, the near side from neither.

At an edge where the disparity changes from d₁ to d₂ the near surface covers the far one in the view on one side: the
one before if the disparity grows along the axis, the one after if it shrinks, whichever of both is near. Only the place
of the error tells near from far: it lies on the far side. So the test takes, on either side, the error in the view that
would be blind less that in the other view. Noise and texture are in both, and leave nothing.
"""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.arrangement.matching import Array, Floats, displace
from faintfield.calib.arrangement.views import Node, Picture, neighbour

# Half of the window in px in which an edge is looked for, and on either side of which disparities are compared.
_REACH_PX = 7

# Limits of the hidden band in px: a narrower one cannot be seen, a wider one reaches beyond the window.
_MIN_BAND_PX, _MAX_BAND_PX = 1.5, 6

# Side of the window in px that finds disparities, and length along an edge over which errors are averaged.
_WINDOW_PX, _ALONG_PX = 9, 5

# Errors count no more than this, in standard deviations of the pictures: beyond it, one is as wrong as another.
_LARGEST_ERROR = 1.5

# The best disparity is clear if its error is below this share of the mean over all disparities: elsewhere no texture
# tells them apart, and an edge would lie anywhere.
_CLEAR_SHARE = 0.8

# Share by which two surfaces must explain an edge better than one.
_LEAST_GAIN = 0.05

# Side of the tiles in px whose means are the independent samples, rows between tested lines, and edges of a tile.
_TILE_PX, _LINE_PX, _MIN_EDGES = 32, 3, 3

type Errors = NDArray[np.float32]


def far_side_z(
    pictures: Mapping[Node, Picture], nodes: Sequence[Node], shifts_px: Floats, *, distance: int, ratio: float
) -> float:
    """Return the standard errors by which what is hidden lies where the disparity is larger, negative if smaller.

    Views are by row and column, and disparities along x, over `ratio` those along y, have one sign with them. Edges are
    tested in the views at some nodes that have neighbours at `distance` on both sides along a row, a column, or both;
    `shifts_px` (shift,) are the disparities per node to compare, in ascending order.
    """
    scales = (float(distance), distance / ratio)
    tiles: dict[tuple[int, int, int], list[tuple[float, float]]] = {}
    for node in nodes:
        errors = {}
        for axis in (0, 1):
            pair = [(sign, neighbour(node, 1 - axis, sign * distance)) for sign in (-1, 1)]
            if all(other in pictures for _, other in pair):
                errors[axis] = [
                    _errors(pictures[node], pictures[other], sign * scales[axis] * shifts_px, axis)
                    for sign, other in pair
                ]
        if not errors:
            continue
        best, clear = _best_disparities(list(errors.values()))
        for axis, sides in errors.items():
            before, after = (side if axis == 0 else side.transpose(0, 2, 1) for side in sides)
            maps = (best, clear) if axis == 0 else (best.T, clear.T)
            edges = _edges(before, after, *maps, scales[axis] * shifts_px)
            for row, column, value, gain in edges:
                tiles.setdefault((axis, int(row) // _TILE_PX, int(column) // _TILE_PX), []).append((value, gain))
    full = [np.array(edges) for edges in tiles.values() if len(edges) >= _MIN_EDGES]
    samples = np.array([np.average(values, weights=gains) for values, gains in (edges.T for edges in full)])
    if len(samples) < 4 or not samples.std():
        return 0.0
    return float(samples.mean() / samples.std(ddof=1) * np.sqrt(len(samples)))


def _errors(view: Picture, other: Picture, shifts_px: Floats, axis: int) -> Errors:
    """Return the errors (shift, row, column) of another view, displaced along an axis."""
    return np.stack([np.minimum(np.abs(view - displace(other, shift, axis)), _LARGEST_ERROR) for shift in shifts_px])


def _best_disparities(pairs: Sequence[list[Errors]]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the index of each pixel's best disparity, by the better of the views on either side, and if it is clear.

    Both are (row, column). Where there is no texture, all disparities are alike, and the first one would be the best.
    """
    total = np.array(sum(np.minimum(*(_blur(errors, _WINDOW_PX, _WINDOW_PX) for errors in pair)) for pair in pairs))
    index = np.argmin(total, axis=0)
    clear = total.min(axis=0) < _CLEAR_SHARE * total.mean(axis=0)
    return np.asarray(cv2.medianBlur(index.astype(np.float32), 5), np.intp), clear


def _blur(errors: Errors, width: int, height: int) -> Errors:
    return np.stack([cv2.blur(layer, (width, height)) for layer in np.ascontiguousarray(errors)])


def _edges(
    before: Errors, after: Errors, index: NDArray[np.intp], clear: NDArray[np.bool_], shifts_px: Floats
) -> Array:
    """Return row, column, value and weight (edge, 4) of the edges along the rows of a picture.

    The value is by how much more is hidden on the side of larger disparity. The weight is how clearly there is an edge:
    the share by which two surfaces explain the window better than either of them alone.
    """
    reach = _REACH_PX
    height, width = index.shape
    if width < 6 * reach or height < _ALONG_PX:
        return np.zeros((0, 4))
    moved_px = shifts_px[index]
    change = np.zeros((height, width))
    change[:, reach:-reach] = np.abs(moved_px[:, 2 * reach :] - moved_px[:, : -2 * reach])
    steep = (change >= cv2.dilate(change, np.ones((1, 2 * reach + 1))) - 1e-9) & (change >= _MIN_BAND_PX)
    steep[:, : 3 * reach] = steep[:, -3 * reach :] = False
    steep &= cv2.erode(clear.astype(np.uint8), np.ones((1, 2 * reach + 1))) > 0
    steep[np.arange(height) % _LINE_PX > 0] = False
    rows, columns = np.nonzero(steep)
    left, right = index[rows, columns - reach], index[rows, columns + reach]
    offsets = np.arange(-2 * reach, 2 * reach + 1)
    place = rows[:, np.newaxis], columns[:, np.newaxis] + offsets
    # Errors (edge, offset) if all of the window had the left disparity, or all of it the right one
    views = [_blur(view, 1, _ALONG_PX) for view in (before, after)]
    by_left, by_right = ([view[side[:, np.newaxis], *place] for view in views] for side in (left, right))
    # The right surface begins at the offset where the errors of both surfaces together are least
    left_error, right_error = np.minimum(*by_left), np.minimum(*by_right)
    before_split = np.cumsum(left_error, axis=1) - left_error
    total = (before_split + np.cumsum(right_error[:, ::-1], axis=1)[:, ::-1])[:, reach:-reach]
    split = offsets[np.argmin(total, axis=1) + reach]
    alone = np.minimum(left_error.sum(axis=1), right_error.sum(axis=1))
    gain = 1 - total.min(axis=1) / np.maximum(alone, 1e-9)
    step_px = (shifts_px[right] - shifts_px[left])[:, np.newaxis]
    band_px = np.clip(np.abs(step_px), 1, _MAX_BAND_PX).round()
    from_split = offsets - split[:, np.newaxis]
    hidden_right, hidden_left = (
        (inside * (errors[0] - errors[1])).sum(axis=1) / np.maximum(inside.sum(axis=1), 1)
        for inside, errors in (
            ((from_split >= 0) & (from_split < band_px), by_right),
            ((from_split < 0) & (from_split >= -band_px), by_left),
        )
    )
    # Once for which of the views is blind, once for the side of larger disparity, the sign of the step cancels out
    edges = np.column_stack([rows, columns, hidden_right - hidden_left, gain])
    return np.asarray(edges[gain > _LEAST_GAIN], np.float64)
