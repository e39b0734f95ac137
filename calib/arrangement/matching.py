"""Agreement of blocks of a view with its neighbours, and what it says of the axes: which number of a name is the row.

Along columns points move along x, along rows along y, by the same disparity.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.arrangement.views import Node, Picture, neighbour

type Floats = NDArray[np.floating]
type Array = NDArray[np.float64]
type Table = NDArray[np.float32]

# Side of a block, px of the prepared pictures.
_BLOCK_PX = 16

# Quantile of chance above which a block's match is sure; its correlation must also be at least this.
_CHANCE_QUANTILE, _LEAST_MATCH = 0.99, 0.3

# Sure blocks that a range needs, and the quantiles of their disparities that it spans: up to one in a hundred is wrong.
MIN_BLOCKS = 12
_SPAN = (0.01, 0.99)

# Pitch along columns over pitch along rows that are tried; others are found by interpolation.
_RATIOS = 2.0 ** np.arange(-1.25, 1.3, 0.25)

# Standard errors by which one hypothesis must be better than all others.
SURE = 5.0


@dataclass(frozen=True)
class Correlations:
    """Correlation of the blocks of several views with their neighbours, and by chance: with turned neighbours.

    Displacements (shift,) are from one node to the next. Tables (view, block, shift) are NaN for views without
    neighbours; their keys are the number of the names that steps by one, 0 or 1, and the axis of displacement, 0 for x.
    """

    shifts_px: Floats
    along: dict[tuple[int, int], Table]
    chance: dict[tuple[int, int], Table]


def correlate(
    pictures: Mapping[Node, Picture], nodes: Sequence[Node], shifts_px: Floats, distance: int
) -> Correlations:
    """Correlate the blocks of the views at some nodes with the views `distance` nodes before and after them.

    Pictures (row, column) have no brightness. Displacements (shift,) are from node to node and symmetric about zero,
    since the view before shows the opposite ones.
    """
    turned = {node: np.ascontiguousarray(picture[::-1, ::-1]) for node, picture in pictures.items()}
    correlations = Correlations(shifts_px, {}, {})
    for number, axis in product((0, 1), repeat=2):
        for tables, candidates in ((correlations.along, pictures), (correlations.chance, turned)):
            rows = [
                [
                    correlate_blocks(pictures[node], candidates[other], sign * distance * shifts_px, axis)
                    for sign in (1, -1)
                    if (other := neighbour(node, number, sign * distance)) in pictures
                ]
                for node in nodes
            ]
            if any(rows):
                empty = [np.full_like(next(filter(None, rows))[0], np.nan)]
                tables[number, axis] = np.stack([np.mean(sides or empty, axis=0, dtype=np.float32) for sides in rows])
    return correlations


def correlate_blocks(view: Picture, other: Picture, shifts_px: Floats, axis: int) -> Table:
    """Return the correlation (block, shift) of the blocks of a view with another, displaced along an axis."""
    blocks = max(view.shape[1] // _BLOCK_PX, 1), max(view.shape[0] // _BLOCK_PX, 1)
    height, width = (min(count * _BLOCK_PX, side) for count, side in zip(blocks[::-1], view.shape, strict=True))

    def means(picture: Picture) -> Picture:
        return np.asarray(cv2.resize(picture[:height, :width], blocks, interpolation=cv2.INTER_AREA)).ravel()

    power = means(view * view)
    columns = []
    for shift_px in shifts_px:
        moved = displace(other, shift_px, axis)
        columns.append(means(view * moved) / np.sqrt(power * means(moved * moved) + 1e-4))
    return np.stack(columns, axis=1)


def displace(picture: Picture, shift_px: float, axis: int) -> Picture:
    """Return a picture whose pixel p shows what the given one shows at p + shift along an axis; 0 beyond its edge."""
    matrix = np.eye(2, 3)
    matrix[axis, 2] = shift_px
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(picture, matrix, picture.shape[::-1], flags=flags), np.float32)


def block_disparities(table: Table, chance: Table, shifts_px: Floats) -> Array:
    """Return the disparity (view · block,) of each block, NaN where its match may be chance.

    `table` and `chance` (view, block, shift) are correlations as in `Correlations`, `shifts_px` (shift,) disparities.
    """
    scores = table.reshape(-1, len(shifts_px))
    by_chance = chance[np.isfinite(chance).all(axis=(1, 2))].max(axis=2)
    disparities_px = np.full(len(scores), np.nan)
    if not len(by_chance):
        return disparities_px
    # The median, since neighbours may really be turned
    limit = max(float(np.median(np.quantile(by_chance, _CHANCE_QUANTILE, axis=1))), _LEAST_MATCH)
    scores = np.where(np.isfinite(scores).all(axis=1, keepdims=True), scores, -1.0)
    peak = np.argmax(scores, axis=1)
    sure = np.flatnonzero((scores.max(axis=1) > limit) & (peak > 0) & (peak < len(shifts_px) - 1))
    at = peak[sure]
    offset = parabola_peak(scores[sure, at - 1], scores[sure, at], scores[sure, at + 1])
    disparities_px[sure] = shifts_px[at] + offset * (shifts_px[1] - shifts_px[0])
    return disparities_px


def parabola_peak(before: Floats, peak: Floats, after: Floats) -> Array:
    """Return the place, -0.5 … 0.5 from the middle one, of the peak of a parabola through three values."""
    bend = np.minimum(before - 2 * peak + after, -1e-9)
    return np.asarray(np.clip(0.5 * (before - after) / bend, -0.5, 0.5), np.float64)


@dataclass(frozen=True)
class Axes:
    """Movement of points along both numbers of the names.

    Attributes
    ----------
    transposed, opposed : bool
        The first number is the column; one of the numbers is reversed.
    ratio : float
        Disparity along x over disparity along y, roughly.
    transposed_z, opposed_z, match_z : float
        Standard errors by which this is better than its contrary, 0 where there is nothing to compare, and by which the
        views agree better than with pictures turned by 180°.
    level : float
        Mean correlation of the blocks at their best disparities.
    """

    transposed: bool = False
    opposed: bool = False
    ratio: float = 1.0
    transposed_z: float = 0.0
    opposed_z: float = 0.0
    match_z: float = 0.0
    level: float = 0.0

    @property
    def certainty(self) -> float:
        """Standard errors by which views agree, and either answer is better than its contrary."""
        return min(self.match_z, max(self.transposed_z, self.opposed_z))

    def movement(self, number: int) -> tuple[int, float]:
        """Return the axis along which points move with a number, and by how much for a disparity of 1 along x."""
        axis = number if self.transposed else 1 - number
        scale = 1.0 if axis == 0 else 1.0 / self.ratio
        return axis, -scale if number == 0 and self.opposed else scale

    def combine(self, tables: dict[tuple[int, int], Table], shifts_px: Floats) -> Table:
        """Return the correlation (view, block, shift) along both numbers together, by disparity along the second.

        The disparity along the first is the same, reversed if the numbers are opposed, over the ratio of pitches.
        """
        parts = []
        for number in sorted({number for number, _ in tables}):
            axis, scale = self.movement(number)
            parts.append(_resample(tables[number, axis], shifts_px, scale))
        return np.asarray(np.mean(parts, axis=0), np.float32)


def disparity_range(correlations: Correlations, axes: Axes) -> tuple[float, float] | None:
    """Return a robust least and largest disparity along x of the blocks that match beyond chance.

    Where these are few, as in the dark: the least and largest at which all blocks together agree beyond chance; None if
    there is none.
    """
    shifts_px = correlations.shifts_px
    along, chance = (axes.combine(tables, shifts_px) for tables in (correlations.along, correlations.chance))
    disparities_px = block_disparities(along, chance, shifts_px)
    if np.isfinite(disparities_px).sum() >= MIN_BLOCKS:
        least, largest = np.nanquantile(disparities_px, _SPAN)
        return float(least), float(largest)
    level, by_chance = (scores[np.isfinite(scores).all(axis=(1, 2))].mean(axis=(0, 1)) for scores in (along, chance))
    above = np.flatnonzero(level > max(float(by_chance.max()), 0.25 * float(level.max())))
    return (float(shifts_px[above[0]]), float(shifts_px[above[-1]])) if len(above) else None


def find_axes(correlations: Correlations) -> Axes:
    """Compare the four arrangements that differ in more than near and far.

    A block's score is the best mean of its correlations along both numbers over all disparities; in pictures so dark
    that no block shows anything, the mean correlation of all blocks at one disparity is compared instead.
    """
    axes = _compare(correlations, pooled=False)
    return axes if axes.certainty > SURE else max(axes, _compare(correlations, pooled=True), key=lambda a: a.certainty)


def _compare(correlations: Correlations, pooled: bool) -> Axes:
    """Return the best arrangement, with its distance from its contraries."""
    both = {number for number, _ in correlations.along} == {0, 1}
    trials = [
        Axes(transposed, opposed, float(ratio))
        for transposed in (False, True)
        for opposed in ((False, True) if both else (False,))
        for ratio in (_RATIOS if both else (1.0,))
    ]
    scores, chance = (
        {axes: _scores(axes.combine(tables, correlations.shifts_px), pooled) for axes in trials}
        for tables in (correlations.along, correlations.chance)
    )
    best = max(trials, key=lambda axes: float(scores[axes].mean()))
    # A ratio other than 1 needs a reason
    square = replace(best, ratio=1.0)
    best = best if _z(scores[best], scores[square]) > SURE else square

    def better_than(alternatives: list[Axes], tables: dict[Axes, Array] = scores) -> float:
        """Return the standard errors by which the best one is better than the best alternative."""
        highest = max(alternatives, key=lambda axes: float(tables[axes].mean()), default=best)
        return _z(scores[best], tables[highest])

    alike = [axes for axes in trials if axes.transposed == best.transposed]
    return replace(
        best,
        transposed_z=better_than([axes for axes in trials if axes.transposed != best.transposed]),
        opposed_z=better_than([axes for axes in alike if axes.opposed != best.opposed]),
        match_z=better_than(trials, chance),
        level=float(scores[best].mean()),
    )


def _scores(table: Table, pooled: bool) -> Array:
    """Return the score of each block (block,), the mean over the views that have one."""
    table = table[np.isfinite(table).all(axis=(1, 2))]
    if pooled:
        return np.asarray(table.mean(axis=0)[:, int(np.argmax(table.mean(axis=(0, 1))))], np.float64)
    return np.asarray(table.max(axis=2).mean(axis=0), np.float64)


def _z(score: Array, other: Array) -> float:
    """Return the mean difference in units of its standard error, blocks being the samples."""
    difference = score - other
    if len(difference) < 2 or not difference.std():
        return 0.0
    return float(difference.mean() / (difference.std(ddof=1) / np.sqrt(len(difference))))


def _resample(table: Table, shifts_px: Floats, scale: float) -> Table:
    """Return a table (view, block, shift) whose shift s is the given one's at `scale` times s."""
    places = np.clip((scale * shifts_px - shifts_px[0]) / (shifts_px[1] - shifts_px[0]), 0, len(shifts_px) - 1)
    low = np.minimum(places.astype(int), len(shifts_px) - 2)
    share = (places - low).astype(np.float32)
    return np.asarray(table[:, :, low] * (1 - share) + table[:, :, low + 1] * share, np.float32)
