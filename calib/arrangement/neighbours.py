"""Neighbouring views compared in pairs: turns, scales and shifts between views, and views that fit no neighbour."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from faintfield.calib.arrangement.matching import parabola_peak
from faintfield.calib.arrangement.nodes import Node, neighbour
from faintfield.calib.arrangement.pictures import Picture

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
class NeighbourFits:
    """Agreement of each view with its neighbours; by default nothing is odd, turned or shifted.

    Attributes
    ----------
    odd : list of int
        Views that fit none of the others.
    turn_rad, magnification : array (view,)
        Rotation and magnification of each view against the typical one.
    shift_px : array (view, 2)
        Displacement x, y of each view against its neighbours, beyond what disparities explain.
    """

    odd: list[int] = field(default_factory=list)
    turn_rad: NDArray[np.float64] = field(default_factory=lambda: np.zeros(1))
    magnification: NDArray[np.float64] = field(default_factory=lambda: np.ones(1))
    shift_px: NDArray[np.float64] = field(default_factory=lambda: np.zeros((1, 2)))

    @property
    def shift_rms_px(self) -> float:
        """Root mean square of the displacements."""
        return float(np.sqrt(np.mean(self.shift_px**2)))


class PairFit(NamedTuple):
    """Median correlation of the blocks of two neighbours, and how displacements across the step run."""

    score: float
    chance: float
    offset_px: float
    turn_rad: float
    magnification: float


def compare_neighbours(pictures: Mapping[Node, Picture], range_px: tuple[float, float], ratio: float) -> NeighbourFits:
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
    places = {node: index for index, node in enumerate(pictures)}
    pairs = []
    for node, view in pictures.items():
        for axis, unit in ((0, 1.0), (1, 1.0 / ratio)):
            for steps in range(1, _MOST_STEPS + 1):
                other = neighbour(node, 1 - axis, steps)
                if other in pictures:
                    limits_px = steps * unit * range_px[0], steps * unit * range_px[1]
                    fit = compare_pair(view, pictures[other], axis, limits_px)
                    pairs += [(places[node], places[other], axis, *fit)] if fit is not None else []
                    break
    table = np.array(pairs).reshape(-1, 3 + len(PairFit._fields))
    good, odd = _find_odd(len(pictures), table)
    _, _, axes, _, _, offset_px, turn_rad, magnification = table.T

    def per_view(values: NDArray[np.float64], chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return a value (view,) for each view from the differences of pairs; the median is zero."""
        first, second = table[chosen, :2].astype(int).T
        views = np.arange(len(pictures))
        design = (second[:, np.newaxis] == views) * 1.0 - (first[:, np.newaxis] == views)
        solution = _fit_robustly(design, values[chosen], np.ones(len(design)))
        return np.asarray(solution - np.median(solution), np.float64)

    # Pairs of a column tell of x, pairs of a row of y
    shift_px = np.column_stack([per_view(offset_px, good & (axes == axis)) for axis in (1, 0)])
    return NeighbourFits(odd, per_view(turn_rad, good), 1 + per_view(magnification, good), shift_px)


def compare_pair(view: Picture, other: Picture, axis: int, range_px: tuple[float, float]) -> PairFit | None:
    """Match the blocks of one view in another that is displaced along an axis; None if these are too few."""
    if axis == 1:
        view, other = (np.ascontiguousarray(picture.T) for picture in (view, other))
    least, largest = int(np.floor(range_px[0])) - 2, int(np.ceil(range_px[1])) + 2
    turned = np.ascontiguousarray(other[::-1, ::-1])
    matches: list[tuple[float, float, float, float]] = []
    chance: list[float] = []
    height, width = view.shape
    step = max((max(view.shape) - _BLOCK_PX) // _BLOCKS, _BLOCK_PX // 2)
    for top in range((height - _BLOCK_PX) % step // 2, height - _BLOCK_PX + 1, step):
        for left in range((width - _BLOCK_PX) % step // 2, width - _BLOCK_PX + 1, step):
            block = view[top : top + _BLOCK_PX, left : left + _BLOCK_PX]
            rows = slice(max(top - _ACROSS_PX, 0), top + _BLOCK_PX + _ACROSS_PX)
            columns = slice(max(left + least, 0), max(left + _BLOCK_PX + largest, 0))
            searched = other[rows, columns]
            if block.std() < 1e-3 or min(searched.shape) < _BLOCK_PX:
                continue
            if len(matches) % _CHANCE_BLOCKS == 0:
                chance.append(float(cv2.matchTemplate(turned[rows, columns], block, cv2.TM_CCOEFF_NORMED).max()))
            response = cv2.matchTemplate(searched, block, cv2.TM_CCOEFF_NORMED)
            row, column = np.unravel_index(int(np.argmax(response)), response.shape)
            offset = float(rows.start - top + row)
            if 0 < row < len(response) - 1:
                offset += float(parabola_peak(*response[row - 1 : row + 2, column]))
            centre = left + (_BLOCK_PX - width) / 2, top + (_BLOCK_PX - height) / 2
            matches.append((float(response[row, column]), offset, *centre))
    if len(matches) < 3:
        return None
    score, offset_px, along_px, across_px = np.array(matches).T
    design = np.column_stack([np.ones_like(along_px), along_px, across_px])
    constant, turn, magnification = map(float, _fit_robustly(design, offset_px, np.maximum(score, 0.0)))
    turn = turn if axis == 0 else -turn
    return PairFit(float(np.median(score)), float(np.median(chance)), constant, turn, magnification)


def _fit_robustly(
    design: NDArray[np.float64], value: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the least absolute deviations solution, by reweighted least squares; of least norm where free."""
    weights = weight
    solution = np.zeros(design.shape[1])
    for _ in range(_ROUNDS):
        normal = design.T @ (design * weights[:, np.newaxis])
        if not normal.any():
            break
        # The small addition leaves free what no value holds
        normal += 1e-9 * float(np.trace(normal)) * np.eye(len(normal))
        solution = np.linalg.solve(normal, design.T @ (value * weights))
        residual = np.abs(value - design @ solution)
        weights = weight / np.maximum(residual, 1e-3 + 0.1 * float(np.median(residual)))
    return solution


def _find_odd(count: int, pairs: NDArray[np.float64]) -> tuple[NDArray[np.bool_], list[int]]:
    """Return a mask of the pairs that fit, and the views that are not linked with most others by such pairs."""
    good, odd = np.zeros(len(pairs), bool), list[int]()
    ends, score, chance = pairs[:, :2].astype(int), pairs[:, 3], pairs[:, 4]
    if len(pairs) and np.quantile(score, 0.75) - np.median(chance) >= _LEAST_WAY:
        good = score > (1 - _FITS) * np.median(chance) + _FITS * np.quantile(score, 0.75)
        links = coo_matrix((np.ones(good.sum()), ends[good].T), shape=(count, count))
        part = connected_components(links, directed=False)[1]
        largest = int(np.argmax(np.bincount(part)))
        odd = [int(view) for view in np.unique(ends) if part[view] != largest]
        good &= part[ends[:, 0]] == largest
    return good, odd
