"""Axes of a grid: which number of a name is the row, and whether both run the same way.

Every point has one disparity.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.arrangement.matching import Correlations, Table

# Pitch along columns over pitch along rows that are tried; others are found by interpolation.
_RATIOS = 2.0 ** np.arange(-1.25, 1.3, 0.25)

# Standard errors by which one hypothesis must be better than all others.
SURE = 5.0


@dataclass(frozen=True)
class Axes:
    """Movement of points along both numbers of the names.

    Attributes
    ----------
    transposed : bool
        The first number is the column.
    opposed : bool
        The numbers run opposite ways: one of them is reversed.
    ratio : float
        Disparity along x over disparity along y, roughly.
    transposed_z, opposed_z : float
        Standard errors by which this is better than its contrary; 0 where there is nothing to compare.
    match_z : float
        Standard errors by which the views agree better than with pictures turned by 180°.
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

    def combine(self, tables: dict[tuple[int, int], Table], shifts_px: NDArray[np.floating]) -> Table:
        """Return the correlation (view, block, shift) along both numbers together, by disparity along the second.

        The disparity along the first is the same, reversed if the numbers are opposed, over the ratio of pitches.
        """
        parts = []
        for number in sorted({number for number, _ in tables}):
            axis, scale = self.movement(number)
            parts.append(_resample(tables[number, axis], shifts_px, scale))
        return np.asarray(np.mean(parts, axis=0), np.float32)


def find_axes(correlations: Correlations) -> Axes:
    """Compare the four arrangements that differ in more than near and far.

    Along columns points move along x, along rows along y, by the same disparity. A block's score is the best mean of
    both correlations over all disparities; in pictures so dark that no block shows anything, the mean correlation of
    all blocks at one disparity is compared instead.
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

    def better_than(alternatives: list[Axes], tables: dict[Axes, NDArray[np.float64]] = scores) -> float:
        """Return the standard errors by which the best one is better than the best alternative."""
        highest = max(alternatives, key=lambda axes: float(tables[axes].mean()), default=best)
        return _z(scores[best], tables[highest])

    return replace(
        best,
        transposed_z=better_than([axes for axes in trials if axes.transposed != best.transposed]),
        opposed_z=better_than(
            [axes for axes in trials if axes.transposed == best.transposed and axes.opposed != best.opposed]
        ),
        match_z=better_than(trials, chance),
        level=float(scores[best].mean()),
    )


def _scores(table: Table, pooled: bool) -> NDArray[np.float64]:
    """Return the score of each block (block,), the mean over the views that have one."""
    table = table[np.isfinite(table).all(axis=(1, 2))]
    if pooled:
        return np.asarray(table.mean(axis=0)[:, int(np.argmax(table.mean(axis=(0, 1))))], np.float64)
    return np.asarray(table.max(axis=2).mean(axis=0), np.float64)


def _z(score: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Return the mean difference in units of its standard error, blocks being the samples."""
    difference = score - other
    if len(difference) < 2 or not difference.std():
        return 0.0
    return float(difference.mean() / (difference.std(ddof=1) / np.sqrt(len(difference))))


def _resample(table: Table, shifts_px: NDArray[np.floating], scale: float) -> Table:
    """Return a table (view, block, shift) whose shift s is the given one's at `scale` times s."""
    places = np.clip((scale * shifts_px - shifts_px[0]) / (shifts_px[1] - shifts_px[0]), 0, len(shifts_px) - 1)
    low = np.minimum(places.astype(int), len(shifts_px) - 2)
    share = (places - low).astype(np.float32)
    return np.asarray(table[:, :, low] * (1 - share) + table[:, :, low + 1] * share, np.float32)
