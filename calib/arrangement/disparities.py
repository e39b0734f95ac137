"""The range of disparities of a scene, from the blocks of several views whose match is sure."""

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.arrangement.matching import Table

# Quantile of what chance finds, above which a block is sure; a block's match must also be at least this good.
_CHANCE_QUANTILE, _LEAST_MATCH = 0.99, 0.3

# Sure blocks that a range needs, and the quantiles of their disparities that it spans.
MIN_BLOCKS = 12
_SPAN = (0.005, 0.995)


def block_disparities(table: Table, chance: Table, shifts_px: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the disparity (view · block,) of each block, NaN where its match may be chance.

    Parameters
    ----------
    table, chance : array (view, block, shift)
        Correlation with the neighbours, and with neighbours turned by 180°; NaN where there are none.
    shifts_px : array (shift,)
        Disparities.
    """
    rows, by_chance = (scores.reshape(-1, scores.shape[2]) for scores in (table, chance))
    by_chance = by_chance[np.isfinite(by_chance).all(axis=1)]
    found = np.full(len(rows), np.nan)
    if not len(by_chance):
        return found
    limit = max(float(np.quantile(by_chance.max(axis=1), _CHANCE_QUANTILE)), _LEAST_MATCH)
    known = np.isfinite(rows).all(axis=1)
    rows = np.where(known[:, np.newaxis], rows, -1.0)
    peak = np.argmax(rows, axis=1)
    inside = (peak > 0) & (peak < len(shifts_px) - 1)
    sure = np.flatnonzero(known & (rows.max(axis=1) > limit) & inside)
    at = peak[sure]
    before, here, after = rows[sure, at - 1], rows[sure, at], rows[sure, at + 1]
    bend = before - 2 * here + after
    part = np.where(bend < -1e-9, 0.5 * (before - after) / np.minimum(bend, -1e-9), 0.0)
    found[sure] = shifts_px[at] + np.clip(part, -0.5, 0.5) * (shifts_px[1] - shifts_px[0])
    return found


def sure_disparities(table: Table, chance: Table, shifts_px: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the disparities (block,) of the blocks that match beyond chance."""
    found = block_disparities(table, chance, shifts_px)
    return found[np.isfinite(found)]


def span_px(disparities_px: NDArray[np.float64]) -> tuple[float, float]:
    """Return the robust least and largest disparity of blocks."""
    least, largest = np.quantile(disparities_px, _SPAN)
    return float(least), float(largest)


def pooled_span_px(table: Table, chance: Table, shifts_px: NDArray[np.floating]) -> tuple[float, float] | None:
    """Return least and largest disparity at which all blocks together agree beyond chance; None if there is none."""
    usable, by_chance = (scores[np.isfinite(scores).all(axis=(1, 2))] for scores in (table, chance))
    level = usable.mean(axis=(0, 1))
    limit = float(by_chance.mean(axis=(0, 1)).max())
    above = np.flatnonzero(level > max(limit, 0.25 * float(level.max())))
    return (float(shifts_px[above[0]]), float(shifts_px[above[-1]])) if len(above) else None
