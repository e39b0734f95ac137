"""Neighbouring views compared: turns, shifts, views that fit no neighbour, and a test of the order of names."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from itertools import product
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from faintfield.calib.arrangement.matching import Array, Axes, Table, correlate_blocks, parabola_peak
from faintfield.calib.arrangement.views import Node, Picture, neighbour, spread

# Side of a matched block, blocks along the longer side of a picture, and the search across the expected movement, px.
_BLOCK_PX, _BLOCKS, _ACROSS_PX = 28, 7, 5

# A pair fits if its score is above this share of the way from chance to the typical pair; a smaller way tells nothing.
_FITS, _LEAST_WAY = 0.4, 0.12

# Steps to the next view that is there; where one or two are missing, those beside the gap are compared.
_MOST_STEPS = 3

# Every so many blocks the match by chance is measured, too.
_CHANCE_BLOCKS = 8

# Least mean error of a block's displacement, px: interpolated peaks are no better.
_LEAST_ERROR_PX = 0.02

# Blocks beyond the number of parameters from which their residuals tell the error, which else is the whole search;
# least number of them, counted without overlap, by which the sum of the residuals is divided.
_MIN_FREE_BLOCKS, _LEAST_FREE = 3, 1.0

# Standard deviation of normal errors over the mean of their absolute values, and of a median over that of a mean.
_SIGMA_OF_MEAN, _SIGMA_OF_MEDIAN = 1.25, 1.25

# Largest standard error of a pair over that of the typical pair, below which no error is taken to be: beyond it, the
# pair tells nothing, and rounding would spoil the errors of the views behind it.
_MAX_SIGMA_RATIO = 1e3

# Rounds of reweighting, in which pairs and blocks that disagree lose their weight.
_ROUNDS = 8

# Views whose order is tested, other pictures that may take the places of their neighbours, and exchanges that are
# tried; their seed, so that a set always gets the same answer.
_VIEWS, _OTHERS, _EXCHANGES, _SEED = 9, 12, 40, 0

# Scores of both halves of the blocks must agree by this correlation, in so many standard errors: then pictures, not
# noise, make them differ.
_MIN_REPEATABILITY, _MIN_REPEATABILITY_Z = 0.6, 3.0

# Share of the exchanges that must make the match worse, over that correlation: in light fields nearly all do unless
# noise decides, in random order half of them.
_WORSE_SHARE = 0.85

# Share of other pictures that neighbours fit better than, from which no other order is tried in place of a square.
_CERTAIN_SHARE = 0.95

# Exchanges that differ which that correlation needs: four views in a square have too few.
_LEAST = 10


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
    turn_sigma_rad, magnification_sigma, shift_sigma_px : array (view,), array (view,), array (view, 2)
        Their standard errors; large if few blocks have detail.
    """

    odd: list[int] = field(default_factory=list)
    turn_rad: Array = field(default_factory=lambda: np.zeros(1))
    magnification: Array = field(default_factory=lambda: np.ones(1))
    shift_px: Array = field(default_factory=lambda: np.zeros((1, 2)))
    turn_sigma_rad: Array = field(default_factory=lambda: np.zeros(1))
    magnification_sigma: Array = field(default_factory=lambda: np.zeros(1))
    shift_sigma_px: Array = field(default_factory=lambda: np.zeros((1, 2)))

    @property
    def shift_rms_px(self) -> float:
        """Root mean square of the displacements."""
        return float(np.sqrt(np.mean(self.shift_px**2)))


class PairFit(NamedTuple):
    """Median correlation of the blocks of two neighbours; fit of the displacements across the step, with errors."""

    score: float
    chance: float
    offset_px: float
    turn_rad: float
    magnification: float
    offset_sigma_px: float
    turn_sigma_rad: float
    magnification_sigma: float


def compare_neighbours(pictures: Mapping[Node, Picture], range_px: tuple[float, float], ratio: float) -> NeighbourFits:
    """Match blocks of all neighbours.

    Along a row every point moves along x by its disparity; what it moves along y comes from the cameras: a constant
    shift, a turn (growing along x), a magnification (growing along y). Along columns it is the other way round.
    Pictures have no brightness, disparities along x are within `range_px`, those along y less by `ratio`.
    """
    places = {node: index for index, node in enumerate(pictures)}
    pairs = []
    for node, (axis, unit) in product(pictures, ((0, 1.0), (1, 1.0 / ratio))):
        ahead = ((steps, neighbour(node, 1 - axis, steps)) for steps in range(1, _MOST_STEPS + 1))
        steps, other = next((pair for pair in ahead if pair[1] in pictures), (0, node))
        limits_px = steps * unit * range_px[0], steps * unit * range_px[1]
        if steps and (fit := compare_pair(pictures[node], pictures[other], axis, limits_px)) is not None:
            pairs.append((places[node], places[other], axis, *fit))
    table = np.array(pairs).reshape(-1, 3 + len(PairFit._fields))
    good, odd = _find_odd(len(pictures), table)
    _, _, axes, _, _, *quantities = table.T
    offset, turn, magnification = zip(quantities[:3], quantities[3:], strict=True)

    def per_view(quantity: tuple[Array, Array], chosen: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return a value (view,) for each view, and its error, from those of pairs.

        Pairs tell nothing of the typical value of views that they link: its median is zero.
        """
        first, second = table[chosen, :2].astype(int).T
        views = np.arange(len(pictures))
        design = (second[:, np.newaxis] == views) * 1.0 - (first[:, np.newaxis] == views)
        value, sigma = (column[chosen] for column in quantity)
        if len(sigma):
            sigma = np.clip(sigma, np.median(sigma), _MAX_SIGMA_RATIO * np.median(sigma))
        solution = _fit_robustly(design, value, 1 / sigma)
        normal = (design / sigma[:, np.newaxis] ** 2).T @ design
        variance = np.diag(np.linalg.pinv(normal, rcond=1e-9, hermitian=True))
        part = _parts(len(views), first, second)
        # Around closed squares, pairs disagree by their errors
        free = len(value) - len(views) + len(np.unique(part))
        misfit = _SIGMA_OF_MEAN * float(np.sum(np.abs(value - design @ solution) / sigma)) / max(free, 1)
        for linked in part == np.unique(part)[:, np.newaxis]:
            solution[linked] -= np.median(solution[linked])
        return solution, max(misfit, 1.0) * _SIGMA_OF_MEDIAN * np.sqrt(np.maximum(variance, 0.0))

    # Pairs of a column tell of x, pairs of a row of y
    (x_px, x_sigma_px), (y_px, y_sigma_px) = (per_view(offset, good & (axes == axis)) for axis in (1, 0))
    turn_rad, turn_sigma_rad = per_view(turn, good)
    growth, growth_sigma = per_view(magnification, good)
    shift_px, shift_sigma_px = np.column_stack([x_px, y_px]), np.column_stack([x_sigma_px, y_sigma_px])
    return NeighbourFits(odd, turn_rad, 1 + growth, shift_px, turn_sigma_rad, growth_sigma, shift_sigma_px)


def compare_pair(view: Picture, other: Picture, axis: int, range_px: tuple[float, float]) -> PairFit | None:
    """Match the blocks of one view in another that is displaced along an axis; None if these are too few."""
    if axis == 1:
        view, other = (np.ascontiguousarray(picture.T) for picture in (view, other))
    least, largest = int(np.floor(range_px[0])) - 2, int(np.ceil(range_px[1])) + 2
    turned = np.ascontiguousarray(other[::-1, ::-1])
    matches: list[tuple[float, float, float, float]] = []
    chance: list[float] = []
    step = max((max(view.shape) - _BLOCK_PX) // _BLOCKS, _BLOCK_PX // 2)
    corners = [range((side - _BLOCK_PX) % step // 2, side - _BLOCK_PX + 1, step) for side in view.shape]
    for top, left in product(*corners):
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
        centre = left + (_BLOCK_PX - view.shape[1]) / 2, top + (_BLOCK_PX - view.shape[0]) / 2
        matches.append((float(response[row, column]), offset, *centre))
    if len(matches) < 3:
        return None
    score, offset_px, along_px, across_px = np.array(matches).T
    design = np.column_stack([np.ones_like(along_px), along_px, across_px])
    weight = np.maximum(score, 0.0)
    solution = _fit_robustly(design, offset_px, weight)
    constant, turn, magnification = solution.tolist()
    turn = turn if axis == 0 else -turn
    covered_px = [corner[-1] - corner[0] + _BLOCK_PX for corner in corners]
    overlap = max(np.prod([len(corner) for corner in corners]) * _BLOCK_PX**2 / np.prod(covered_px), 1.0)
    sigmas = _standard_errors(design, np.abs(offset_px - design @ solution), weight, overlap)
    return PairFit(float(np.median(score)), float(np.median(chance)), constant, turn, magnification, *sigmas)


def _standard_errors(design: Array, residual: Array, weight: Array, overlap: float = 1.0) -> list[float]:
    """Return the standard errors of the solution by the size of the residuals; large where it is free.

    Each pixel belongs to `overlap` blocks, so that so many equations count as one. A solution of least absolute
    deviations passes through as many points as it has parameters, whose residuals of zero tell nothing.
    """
    count, parameters = design.shape
    relative = weight / (weight.mean() or 1.0)
    free = max(count / overlap - parameters, _LEAST_FREE)
    residual_px = float(np.sum(relative * residual)) / overlap / free
    per_equation = max(residual_px, _LEAST_ERROR_PX) if count - parameters >= _MIN_FREE_BLOCKS else float(_ACROSS_PX)
    normal = design.T @ (design * relative[:, np.newaxis])
    normal += 1e-9 * (float(np.trace(normal)) + 1.0) * np.eye(parameters)
    sigma = np.sqrt(overlap * np.diag(np.linalg.inv(normal)))
    return list((_SIGMA_OF_MEAN * _SIGMA_OF_MEDIAN * per_equation * sigma).tolist())


def _fit_robustly(design: Array, value: Array, weight: Array) -> Array:
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


def _find_odd(count: int, pairs: Array) -> tuple[NDArray[np.bool_], list[int]]:
    """Return a mask of the pairs that fit, and the views that are not linked with most others by such pairs."""
    good, odd = np.zeros(len(pairs), bool), list[int]()
    ends, score, chance = pairs[:, :2].astype(int), pairs[:, 3], pairs[:, 4]
    if len(pairs) and np.quantile(score, 0.75) - np.median(chance) >= _LEAST_WAY:
        good = score > (1 - _FITS) * np.median(chance) + _FITS * np.quantile(score, 0.75)
        part = _parts(count, *ends[good].T)
        largest = int(np.argmax(np.bincount(part)))
        odd = [int(view) for view in np.unique(ends) if part[view] != largest]
        good &= part[ends[:, 0]] == largest
    return good, odd


def _parts(count: int, first: NDArray[np.intp], second: NDArray[np.intp]) -> NDArray[np.int32]:
    """Return the number (view,) of the part to which each view is linked by pairs."""
    links = coo_matrix((np.ones(len(first)), (first, second)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], np.int32)


@dataclass(frozen=True)
class OrderTest:
    """Test of the names by exchanging neighbours for other pictures.

    Attributes
    ----------
    verdict : {"fits", "denied", "open", "few"}
        The neighbours fit better than others; no better, although pictures differ in how they fit; all pictures fit
        equally well, as copies and too dark ones do; there are too few to exchange any.
    share : float
        Share of the exchanges that make the match worse, along the number for which it is least.
    """

    verdict: Literal["fits", "denied", "open", "few"] = "open"
    share: float = 1.0

    @property
    def is_certain(self) -> bool:
        """Neighbours fit so well that no other order needs to be tried."""
        return self.verdict == "fits" and self.share > _CERTAIN_SHARE


def check_order(pictures: Mapping[Node, Picture], axes: Axes, largest_px: float) -> OrderTest:
    """Exchange the neighbours of views for other pictures, along each number by itself.

    In a light field the blocks of a view are found in all its neighbours at one disparity, and in no other pictures
    that take their places. Copies fit in every place; pictures in random order fit as badly in their own. Pictures are
    the coarse ones by the numbers of their names.
    """
    generator = np.random.default_rng(_SEED)
    reach = int(np.ceil(largest_px))
    shifts_px = np.arange(-reach, reach + 1.0)
    trials = [
        trial
        for node in spread(list(pictures), _VIEWS)
        for trial in _exchange(pictures, node, axes, shifts_px, generator)
    ]
    shares, verdict = [], OrderTest("few")
    for number in (0, 1):
        worse = [np.mean(scores.sum(axis=1) < own) for along, own, scores in trials if along == number]
        deviations = [scores - scores.mean(axis=0) for along, _, scores in trials if along == number]
        free = sum(len(scores) - 1 for scores in deviations)
        if free >= _LEAST:
            verdict = OrderTest("open")
            repeats = _repeatability(np.concatenate(deviations), free)
            shares += [(float(np.mean(worse)), repeats)] if repeats else []
    if not shares:
        return verdict
    fits = all(share > _WORSE_SHARE * repeats for share, repeats in shares)
    return OrderTest("fits" if fits else "denied", min(share for share, _ in shares))


def _repeatability(deviations: Array, free: int) -> float:
    """Return the correlation of the scores (exchange, half) of both halves of the blocks, 0 if it may be chance."""
    first, second = deviations.T
    power = float(np.sqrt((first**2).sum() * (second**2).sum()))
    correlation = min(float((first * second).sum()) / power, 1 - 1e-9) if power else 0.0
    sure = correlation > _MIN_REPEATABILITY and np.arctanh(correlation) * np.sqrt(free - 1) > _MIN_REPEATABILITY_Z
    return correlation if sure else 0.0


def _exchange(
    pictures: Mapping[Node, Picture], node: Node, axes: Axes, shifts_px: Array, generator: np.random.Generator
) -> Iterator[tuple[int, float, Array]]:
    """Exchange the neighbours of a view along each number for other pictures.

    Yield the number, the score of the neighbours, and the scores (exchange, half) of other pictures in their places:
    mean correlations of blocks at their best disparity, for both halves of the blocks.
    """

    @cache
    def table(other: Node, axis: int, unit: float) -> Table:
        return correlate_blocks(pictures[node], pictures[other], unit * shifts_px, axis)

    def score(chosen: Mapping[tuple[int, int], Node]) -> Array:
        tables = []
        for (number, sign), other in chosen.items():
            axis, scale = axes.movement(number)
            tables.append(table(other, axis, abs(scale))[:, :: 1 if sign * scale > 0 else -1])
        best = np.mean(tables, axis=0).max(axis=1)
        return np.array([best[::2].mean(), best[1::2].mean()], np.float64)

    sides = {(number, sign): neighbour(node, number, sign) for number in (0, 1) for sign in (-1, 1)}
    named = {place: other for place, other in sides.items() if other in pictures}
    # A block is found anywhere in a single picture
    if len(named) < 2:
        return
    others = [other for other in pictures if other != node and other not in named.values()]
    pool = [*named.values(), *(others[index] for index in generator.permutation(len(others))[:_OTHERS])]
    own = float(score(named).sum())
    for number in (0, 1):
        places = [place for place in named if place[0] == number]
        draws = {
            tuple(pool[index] for index in generator.permutation(len(pool))[: len(places)]): None
            for _ in range(_EXCHANGES if places else 0)
        }
        # Neighbours exchanged for one another are the mirrored order
        own_places = {named[place] for place in places}
        scores = [score(named | dict(zip(places, draw, strict=True))) for draw in draws if set(draw) != own_places]
        if scores:
            yield number, own, np.array(scores)
