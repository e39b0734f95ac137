"""Neighbouring views compared in pairs: turns, scales and shifts between views, and views that fit no neighbour."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from faintfield.calib.arrangement.matching import neighbour
from faintfield.calib.arrangement.pictures import Node, Picture

# Side of a matched block, blocks along the longer side of a picture, and the search across the expected movement, px.
_BLOCK_PX, _BLOCKS, _ACROSS_PX = 28, 7, 5

# A pair fits if its score is above this share of the way from chance to the typical pair; a smaller way tells nothing.
_FITS, _LEAST_WAY = 0.4, 0.12

# Steps to the next view that is there; where one or two are missing, those beside the gap are compared.
_MOST_STEPS = 3

# Every so many blocks the match by chance is measured, too.
_CHANCE_BLOCKS = 8

# Rounds of reweighting, in which pairs and blocks that disagree lose their weight.
_ROUNDS = 8


@dataclass(frozen=True)
class Fits:
    """Agreement of each view with its neighbours.

    Attributes
    ----------
    odd : list of (int, int)
        Views that fit none of the others.
    turn_rad, scale : dict of node to float
        Rotation and magnification of each view against the typical one.
    shift_px : dict of node to (float, float)
        Displacement x, y of each view against its neighbours, beyond what disparities explain.
    """

    odd: list[Node]
    turn_rad: dict[Node, float]
    scale: dict[Node, float]
    shift_px: dict[Node, tuple[float, float]]


@dataclass(frozen=True)
class Pair:
    """Two neighbours: the median correlation of their blocks, and how displacements across the step run."""

    first: Node
    second: Node
    axis: int
    score: float
    chance: float
    offset_px: float
    turn_rad: float
    scale: float


def compare_neighbours(pictures: Mapping[Node, Picture], range_px: tuple[float, float], ratio: float) -> Fits:
    """Match blocks of all neighbours.

    Along a row every point moves along x by its disparity; what it moves along y comes from the cameras: a constant
    shift, a turn (growing along x), a magnification (growing along y). Along columns it is the other way round.

    Parameters
    ----------
    pictures : mapping of node to array (row, column)
        Views by row and column, without their brightness.
    range_px : (float, float)
        Least and largest disparity along x.
    ratio : float
        Disparity along x over disparity along y.
    """
    pairs = []
    for node in pictures:
        for axis, number in ((0, 1), (1, 0)):
            steps = _steps_to_next(pictures, node, number)
            if steps is not None:
                scale = steps * (1.0 if axis == 0 else 1.0 / ratio)
                other = neighbour(node, number, steps)
                pairs.append(compare_pair(pictures, node, other, axis, (scale * range_px[0], scale * range_px[1])))
    if not pairs:
        return Fits([], {}, {}, {})
    nodes = list(pictures)
    good, odd = _odd(nodes, pairs)
    turn = _per_view(nodes, good, [pair.turn_rad for pair in good])
    scales = _per_view(nodes, good, [pair.scale for pair in good])
    shifts = []
    for axis in (1, 0):  # pairs of a column tell of x
        of_axis = [pair for pair in good if pair.axis == axis]
        shifts.append(_per_view(nodes, of_axis, [pair.offset_px for pair in of_axis]))
    return Fits(
        odd,
        dict(zip(nodes, turn.tolist(), strict=True)),
        {node: 1 + value for node, value in zip(nodes, scales.tolist(), strict=True)},
        {node: (float(x), float(y)) for node, x, y in zip(nodes, *shifts, strict=True)},
    )


def _steps_to_next(pictures: Mapping[Node, Picture], node: Node, number: int) -> int | None:
    """Return the steps along a number to the next view that is there, None if none is near."""
    return next((steps for steps in range(1, _MOST_STEPS + 1) if neighbour(node, number, steps) in pictures), None)


def compare_pair(
    pictures: Mapping[Node, Picture], node: Node, other: Node, axis: int, range_px: tuple[float, float]
) -> Pair:
    """Match the blocks of one view in another."""
    view, seen_by = pictures[node], pictures[other]
    least, largest = int(np.floor(range_px[0])) - 2, int(np.ceil(range_px[1])) + 2
    turned = np.ascontiguousarray(seen_by[::-1, ::-1])
    found: list[tuple[float, float, float, float]] = []
    chance: list[float] = []
    for top, left in _corners(view.shape):
        block = view[top : top + _BLOCK_PX, left : left + _BLOCK_PX]
        across, along = ((top, _ACROSS_PX, _ACROSS_PX), (left, -least, largest))
        if axis == 1:
            across, along = (left, _ACROSS_PX, _ACROSS_PX), (top, -least, largest)
        rows, columns = (across, along) if axis == 0 else (along, across)
        area = tuple(
            slice(max(start - back, 0), max(start + _BLOCK_PX + ahead, 0)) for start, back, ahead in (rows, columns)
        )
        searched = seen_by[area]
        if block.std() < 1e-3 or min(searched.shape) < _BLOCK_PX or min(searched.shape[1 - axis : 2 - axis]) < 1:
            continue
        response = cv2.matchTemplate(searched, block, cv2.TM_CCOEFF_NORMED)
        peak = np.unravel_index(int(np.argmax(response)), response.shape)
        if len(found) % _CHANCE_BLOCKS == 0:
            chance.append(float(cv2.matchTemplate(turned[area], block, cv2.TM_CCOEFF_NORMED).max()))
        start = (area[0].start, area[1].start)[axis] - (top, left)[axis]
        offset = start + _sub_pixel(response, (int(peak[0]), int(peak[1])), axis)
        x, y = left + _BLOCK_PX / 2 - view.shape[1] / 2, top + _BLOCK_PX / 2 - view.shape[0] / 2
        found.append((float(response[peak]), offset, x, y))
    if len(found) < 3:
        return Pair(node, other, axis, np.nan, np.nan, 0.0, 0.0, 0.0)
    score, offset_px, x_px, y_px = np.array(found).T
    constant, along_x, along_y = _plane(x_px, y_px, offset_px, np.maximum(score, 0.0))
    turn, scale = (along_x, along_y) if axis == 0 else (-along_y, along_x)
    return Pair(node, other, axis, float(np.median(score)), float(np.median(chance)), constant, turn, scale)


def _corners(shape: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return row and column of the first pixel of the matched blocks, spread evenly."""
    step = max((max(shape) - _BLOCK_PX) // _BLOCKS, _BLOCK_PX // 2)
    tops = range((shape[0] - _BLOCK_PX) % step // 2, shape[0] - _BLOCK_PX + 1, step)
    lefts = range((shape[1] - _BLOCK_PX) % step // 2, shape[1] - _BLOCK_PX + 1, step)
    return [(top, left) for top in tops for left in lefts]


def _sub_pixel(response: NDArray[np.float32], peak: tuple[int, int], axis: int) -> float:
    """Return the place of a peak across the step: along y (array axis 0) for pairs of a row, by a parabola."""
    line = response[:, peak[1]] if axis == 0 else response[peak[0]]
    at = peak[0] if axis == 0 else peak[1]
    if not 0 < at < len(line) - 1:
        return float(at)
    before, here, after = (float(score) for score in line[at - 1 : at + 2])
    bend = before - 2 * here + after
    return at + (0.5 * (before - after) / bend if bend < 0 else 0.0)


def _plane(
    x: NDArray[np.float64], y: NDArray[np.float64], value: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Return constant and slopes of the plane through most values."""
    design = np.column_stack([np.ones_like(x), x, y])
    solution = _robust(design, value, weight)
    return float(solution[0]), float(solution[1]), float(solution[2])


def _robust(
    design: NDArray[np.float64], value: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the least absolute deviations solution, by reweighted least squares; of least norm where free."""
    weights = weight.copy()
    solution = np.zeros(design.shape[1])
    for _ in range(_ROUNDS):
        normal = design.T @ (design * weights[:, np.newaxis])
        # The small addition leaves free what no value holds
        normal += 1e-9 * float(np.trace(normal)) * np.eye(len(normal))
        solution = np.linalg.solve(normal, design.T @ (value * weights)) if normal.any() else solution
        residual = np.abs(value - design @ solution)
        weights = weight / np.maximum(residual, 1e-3 + 0.1 * float(np.median(residual)))
    return solution


def _odd(nodes: Sequence[Node], pairs: Sequence[Pair]) -> tuple[list[Pair], list[Node]]:
    """Return the pairs that fit, and the views that are not linked with most others by such pairs."""
    known = [pair for pair in pairs if np.isfinite(pair.score)]
    if not known:
        return [], []
    chance = float(np.median([pair.chance for pair in known]))
    typical = float(np.quantile([pair.score for pair in known], 0.75))
    if typical - chance < _LEAST_WAY:
        return [], []
    good = [pair for pair in known if pair.score > chance + _FITS * (typical - chance)]
    places = {node: index for index, node in enumerate(nodes)}
    ends = np.array([(places[pair.first], places[pair.second]) for pair in good]).reshape(-1, 2)
    links = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(nodes), len(nodes)))
    _, part = connected_components(links, directed=False)
    largest = int(np.argmax(np.bincount(part)))
    compared = {node for pair in known for node in (pair.first, pair.second)}
    odd = [node for node in nodes if part[places[node]] != largest and node in compared]
    return [pair for pair in good if pair.first not in odd and pair.second not in odd], odd


def _per_view(nodes: Sequence[Node], pairs: Sequence[Pair], values: Sequence[float]) -> NDArray[np.float64]:
    """Return a value (view,) for each view from the differences of pairs; the median is zero."""
    if not pairs:
        return np.zeros(len(nodes))
    places = {node: index for index, node in enumerate(nodes)}
    design = np.zeros((len(pairs), len(nodes)))
    for index, pair in enumerate(pairs):
        design[index, places[pair.second]], design[index, places[pair.first]] = 1.0, -1.0
    found = _robust(design, np.array(values), np.ones(len(pairs)))
    return np.asarray(found - np.median(found), np.float64)
