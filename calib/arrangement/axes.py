"""Axes of a grid: which number of a name is the row, and whether both run the same way.

Every point has one disparity.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.arrangement.matching import Table, Tables

# Pitch along columns over pitch along rows that are tried; others are found by interpolation.
_RATIOS = 2.0 ** np.arange(-1.25, 1.3, 0.25)

# Standard errors by which one answer must be better than all others.
SURE = 5.0


@dataclass(frozen=True)
class Axes:
    """Disparities along both numbers of the names.

    Attributes
    ----------
    transposed : bool
        The first number is the column.
    opposed : bool
        The numbers run opposite ways: one of them is reversed.
    transposed_z, opposed_z : float
        Standard errors by which this is better than its contrary; 0 where there is nothing to compare.
    match_z : float
        Standard errors by which the views agree better than with pictures turned by 180°.
    ratio : float
        Disparity along x over disparity along y, roughly.
    level : float
        Mean correlation of the blocks at their best disparities.
    """

    transposed: bool
    opposed: bool
    transposed_z: float
    opposed_z: float
    match_z: float
    ratio: float
    level: float


@dataclass(frozen=True)
class _Answer:
    """One hypothesis: which table is of which axis, whether one is reversed, with the score of each block."""

    transposed: bool
    opposed: bool
    ratio: float
    score: NDArray[np.float64]


def find_axes(tables: Tables, chance: Tables) -> Axes:
    """Compare the four arrangements that differ in more than near and far.

    Along columns points move along x, along rows along y, by the same disparity. A block's score is the best mean of
    both correlations over all disparities; in pictures so dark that no block shows anything, the mean correlation of
    all blocks at one disparity is compared instead. `chance` are tables of the same pictures, compared with pictures
    turned by 180°.
    """
    best: Axes | None = None
    for pooled in (False, True):
        found = _compare(tables, chance, pooled)
        if best is None or min(found.match_z, _clearest(found)) > min(best.match_z, _clearest(best)):
            best = found
        if best.match_z > SURE and _clearest(best) > SURE:
            break
    assert best is not None
    return best


def _clearest(axes: Axes) -> float:
    """Return the larger of the two significances."""
    return max(axes.transposed_z, axes.opposed_z)


def combined(tables: Tables, transposed: bool, opposed: bool, ratio: float) -> Table:
    """Return the correlation (view, block, shift) of both numbers together, by disparity along the second number.

    The shift is that along the second number; the first one's is the same, reversed if the numbers are opposed, and
    divided by the ratio of pitches.
    """
    parts = []
    for number in tables.numbers:
        axis, scale = direction(transposed, opposed, ratio, number)
        parts.append(_resampled(tables.along[number, axis], tables.shifts_px, scale))
    with np.errstate(invalid="ignore"):
        return np.asarray(np.mean(parts, axis=0), np.float32)


def direction(transposed: bool, opposed: bool, ratio: float, number: int) -> tuple[int, float]:
    """Return the axis along which points move with a number, and by how much for a disparity of 1 along x."""
    axis = number if transposed else 1 - number
    scale = 1.0 if axis == 0 else 1.0 / ratio
    return axis, -scale if number == 0 and opposed else scale


def _compare(tables: Tables, chance: Tables, pooled: bool) -> Axes:
    """Return the best answer, with its distance from its contraries."""
    both = len(tables.numbers) == 2
    answers = [
        _answer(tables, transposed, opposed, pooled)
        for transposed, opposed in product((False, True), (False, True) if both else (False,))
    ]
    best = max(answers, key=lambda answer: float(answer.score.mean()))
    others = [answer for answer in answers if answer.transposed != best.transposed]
    contrary = [answer for answer in answers if answer.transposed == best.transposed and answer.opposed != best.opposed]
    by_chance = max(
        (_answer(chance, transposed, opposed, pooled) for transposed, opposed in product((False, True), repeat=2)),
        key=lambda answer: float(answer.score.mean()),
    )
    return Axes(
        best.transposed,
        best.opposed,
        _z(best.score, others),
        _z(best.score, contrary) if both else 0.0,
        _z(best.score, [by_chance]),
        best.ratio,
        float(best.score.mean()),
    )


def _answer(tables: Tables, transposed: bool, opposed: bool, pooled: bool) -> _Answer:
    """Return a hypothesis with its best ratio of pitches."""
    ratios = _RATIOS if len(tables.numbers) == 2 else np.ones(1)
    tried = [
        _Answer(transposed, opposed, float(ratio), _scores(combined(tables, transposed, opposed, float(ratio)), pooled))
        for ratio in ratios
    ]
    best = max(tried, key=lambda answer: float(answer.score.mean()))
    square = min(tried, key=lambda answer: abs(np.log(answer.ratio)))
    # Another ratio needs a reason
    return best if _z(best.score, [square]) > SURE else square


def _scores(table: Table, pooled: bool) -> NDArray[np.float64]:
    """Return the score of each block (block,), the mean over the views that have one."""
    with np.errstate(invalid="ignore"):
        usable = np.isfinite(table).all(axis=(1, 2))
    table = table[usable]
    if pooled:
        return np.asarray(table.mean(axis=0)[:, int(np.argmax(table.mean(axis=(0, 1))))], np.float64)
    return np.asarray(table.max(axis=2).mean(axis=0), np.float64)


def _z(score: NDArray[np.float64], others: list[_Answer]) -> float:
    """Return by how many standard errors a score is better than the best of others, blocks being the samples."""
    return min((_z_of(score - other.score) for other in others), default=0.0)


def _z_of(differences: NDArray[np.float64]) -> float:
    """Return a mean in units of its standard error."""
    if len(differences) < 2 or not differences.std():
        return 0.0
    return float(differences.mean() / (differences.std(ddof=1) / np.sqrt(len(differences))))


def _resampled(table: Table, shifts_px: NDArray[np.floating], scale: float) -> Table:
    """Return a table (view, block, shift) whose shift s is the given one's at `scale` times s."""
    places = np.clip((scale * shifts_px - shifts_px[0]) / (shifts_px[1] - shifts_px[0]), 0, len(shifts_px) - 1)
    low = np.minimum(places.astype(int), len(shifts_px) - 2)
    share = (places - low).astype(np.float32)
    return np.asarray(table[:, :, low] * (1 - share) + table[:, :, low + 1] * share, np.float32)
