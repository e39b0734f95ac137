"""Agreement of blocks of a view with its neighbours, displaced along x and along y."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.arrangement.nodes import Node, neighbour
from faintfield.calib.arrangement.pictures import Picture

# Side of a block, px of the prepared pictures.
_BLOCK_PX = 16

# Quantile of chance above which a block's match is sure; its correlation must also be at least this.
_CHANCE_QUANTILE, _LEAST_MATCH = 0.99, 0.3

# Sure blocks that a range needs, and the quantiles of their disparities that it spans.
MIN_BLOCKS = 12
_SPAN = (0.005, 0.995)

type Table = NDArray[np.float32]


@dataclass(frozen=True)
class Correlations:
    """Correlation of the blocks of several views with their neighbours.

    Attributes
    ----------
    shifts_px : array (shift,)
        Displacements from one node to the next, symmetric about zero.
    along, chance : dict of (number, axis) to array (view, block, shift)
        Correlation with the neighbours, and with neighbours turned by 180°. `number` 0 or 1 is the number of the names
        that steps by one, `axis` 0 displacement along x, 1 along y. NaN for views without neighbours.
    """

    shifts_px: NDArray[np.floating]
    along: dict[tuple[int, int], Table]
    chance: dict[tuple[int, int], Table]


def correlate(
    pictures: Mapping[Node, Picture],
    nodes: Sequence[Node],
    shifts_px: NDArray[np.floating],
    distance: int,
) -> Correlations:
    """Correlate the blocks of some views with the views `distance` nodes before and after them.

    Parameters
    ----------
    pictures : mapping of node to array (row, column)
        Pictures without their brightness.
    nodes : sequence of (int, int)
        Views whose blocks are matched.
    shifts_px : array (shift,)
        Displacements from node to node, symmetric about zero; the view before shows the opposite ones.
    distance : int
        Nodes between the two views of a pair.
    """
    turned = {node: np.ascontiguousarray(picture[::-1, ::-1]) for node, picture in pictures.items()}
    along: dict[tuple[int, int], Table] = {}
    chance: dict[tuple[int, int], Table] = {}
    for tables, candidates in ((along, pictures), (chance, turned)):
        for number, axis in product((0, 1), repeat=2):
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
    return Correlations(shifts_px, along, chance)


def correlate_blocks(view: Picture, other: Picture, shifts_px: NDArray[np.floating], axis: int) -> NDArray[np.float32]:
    """Return the correlation (block, shift) of the blocks of a view with another, displaced along an axis."""
    blocks = max(view.shape[1] // _BLOCK_PX, 1), max(view.shape[0] // _BLOCK_PX, 1)
    height, width = (min(count * _BLOCK_PX, side) for count, side in zip(blocks[::-1], view.shape, strict=True))

    def means(picture: Picture) -> NDArray[np.float32]:
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


def block_disparities(table: Table, chance: Table, shifts_px: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the disparity (view · block,) of each block, NaN where its match may be chance.

    Parameters
    ----------
    table, chance : array (view, block, shift)
        Correlation with the neighbours, and with neighbours turned by 180°; NaN where there are none.
    shifts_px : array (shift,)
        Disparities.
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


def disparity_range(table: Table, chance: Table, shifts_px: NDArray[np.floating]) -> tuple[float, float] | None:
    """Return a robust least and largest disparity of the blocks that match beyond chance.

    Where these are few, as in the dark: the least and largest at which all blocks together agree beyond chance; None if
    there is none.
    """
    disparities_px = block_disparities(table, chance, shifts_px)
    if np.isfinite(disparities_px).sum() >= MIN_BLOCKS:
        least, largest = np.nanquantile(disparities_px, _SPAN)
        return float(least), float(largest)
    level, by_chance = (scores[np.isfinite(scores).all(axis=(1, 2))].mean(axis=(0, 1)) for scores in (table, chance))
    above = np.flatnonzero(level > max(float(by_chance.max()), 0.25 * float(level.max())))
    return (float(shifts_px[above[0]]), float(shifts_px[above[-1]])) if len(above) else None


def parabola_peak(
    before: NDArray[np.floating], peak: NDArray[np.floating], after: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return the place, -0.5 … 0.5 from the middle one, of the peak of a parabola through three values."""
    bend = np.minimum(before - 2 * peak + after, -1e-9)
    return np.asarray(np.clip(0.5 * (before - after) / bend, -0.5, 0.5), np.float64)
