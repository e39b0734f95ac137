"""The disparities of a scene: roughly from coarse pictures, then from fine ones in a given orientation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from faintfield.calib.arrangement.axes import SURE, Axes, combined, find_axes
from faintfield.calib.arrangement.disparities import (
    MIN_BLOCKS,
    block_disparities,
    pooled_span_px,
    span_px,
    sure_disparities,
)
from faintfield.calib.arrangement.matching import Tables, correlate, neighbour
from faintfield.calib.arrangement.occlusion import NearAndFar, find_far_side
from faintfield.calib.arrangement.orientation import Orientation
from faintfield.calib.arrangement.pictures import Node, Picture, Views, spread

# Sides of blocks in px of the coarse and the fine pictures.
_COARSE_BLOCK_PX, _FINE_BLOCK_PX = 16, 16

# Largest disparity looked for, as a share of the width; farthest displacement between compared views in fine px.
_LARGEST_SHARE, _FARTHEST_PX = 0.3, 12.0

# Views whose blocks are matched: coarsely at first, coarsely if nothing is seen then, finely; and those with edges.
_FEW, _MANY, _MATCHED_VIEWS, _EDGE_VIEWS = 6, 49, 6, 9

# Step between compared displacements, px of the fine pictures.
_STEP_PX = 0.6

# A range keeps this margin: a share of itself, and a part of a pixel of the files.
_MARGIN_SHARE, _MARGIN_PX = 0.08, 0.1

# Disparities this close to zero, in px of the files, have no sign.
NO_SIGN_PX = 0.25

# Disparities along x and y belong to one point if they differ by less than this share from the rough ratio of pitches;
# a pitch this close to square is called square.
_AGREE, _SQUARE = 0.35, 0.08


def find_roughly(views: Views) -> tuple[Axes | None, float]:
    """Return the axes found in coarse pictures, and the largest disparity there in px of the fine ones."""
    width = next(iter(views.coarse.values())).shape[1]
    reach = int(_LARGEST_SHARE * width)
    shifts_px = np.arange(-reach, reach + 1.0, dtype=np.float64)
    axes, tables, chance = None, None, None
    for count in (_FEW, _MANY):
        use = spread(views.nodes, count)
        tables, chance = (
            correlate(
                views.coarse,
                use[::3] if turned else use,
                shifts_px,
                distance=1,
                block_px=_COARSE_BLOCK_PX,
                turned=turned,
            )
            for turned in (False, True)
        )
        if not tables.along:
            return None, 0.0
        axes = find_axes(tables, chance)
        if axes.match_z > 2 * SURE:
            break
    assert axes is not None
    assert tables is not None
    assert chance is not None
    table, by_chance = (combined(scores, axes.transposed, axes.opposed, axes.ratio) for scores in (tables, chance))
    sure = sure_disparities(table, by_chance, shifts_px)
    if len(sure) >= MIN_BLOCKS:
        span = span_px(sure)
    else:
        span = pooled_span_px(table, by_chance, shifts_px) or (0.0, 0.0)
    return axes, (max(map(abs, span)) + 1.0) * views.coarse_scale / views.fine_scale


class FineMatch:
    """The fine pictures, with the displacements and the distance of views that suit the scene."""

    def __init__(self, views: Views, largest_px: float) -> None:
        self.views = views
        self.largest_px = largest_px
        self.distance = self._distance(views.nodes)
        count = int(np.ceil(largest_px * self.distance / _STEP_PX)) + 2
        self.shifts_px = np.arange(-count, count + 1, dtype=np.float64) * (_STEP_PX / self.distance)
        use = self.inner(views.nodes, _MATCHED_VIEWS)
        self.tables, self.chance = (
            correlate(
                views.fine,
                use[::3] if turned else use,
                self.shifts_px,
                distance=self.distance,
                block_px=_FINE_BLOCK_PX,
                turned=turned,
            )
            for turned in (False, True)
        )

    def inner(self, nodes: Sequence[Node], count: int) -> list[Node]:
        """Return views, evenly spread, that have the most of their four neighbours."""
        links = [sum(self._sides(node, set(nodes), number) for number in (0, 1)) for node in nodes]
        most = max(links)
        return spread([node for node, own in zip(nodes, links, strict=True) if own == most], count)

    def between(self, nodes: Sequence[Node], count: int) -> list[Node]:
        """Return views that have both neighbours along one number or, rather, along both."""
        pairs = [sum(self._sides(node, set(nodes), number) == 2 for number in (0, 1)) for node in nodes]
        best, rest = ([node for node, own in zip(nodes, pairs, strict=True) if own == wanted] for wanted in (2, 1))
        chosen = spread(best, count)
        return chosen + spread(rest, count - len(chosen))

    def _sides(self, node: Node, there: set[Node], number: int) -> int:
        """Return on how many sides along a number a view has a neighbour."""
        return sum(neighbour(node, number, sign * self.distance) in there for sign in (-1, 1))

    def _distance(self, nodes: Sequence[Node]) -> int:
        """Return the distance in nodes at which near points move by a few pixels, and most views have neighbours."""
        there = set(nodes)
        extent = np.ptp(np.array(nodes), axis=0)
        most = max(int(extent[extent > 0].min()) // 2, 1) if (extent > 0).any() else 1
        distance = int(np.clip(_FARTHEST_PX / max(self.largest_px, 1e-9), 1, most))
        while distance > 1 and not any(
            all(
                neighbour(node, number, sign * distance) in there
                for sign in (-1, 1)
                for number in (0, 1)
                if extent[number]
            )
            for node in nodes
        ):
            distance -= 1
        return distance


@dataclass(frozen=True)
class Measured:
    """The views in an orientation, with what their disparities are there; px of the fine pictures."""

    fine: FineMatch
    order: list[Node]
    pictures: dict[Node, Picture]
    raw_px: tuple[float, float]
    ratio: tuple[float, float]

    def side(self) -> NearAndFar:
        """Test which end of the disparities is far."""
        least, largest = self.raw_px
        fine = self.fine
        step_px = _STEP_PX / fine.distance
        shifts_px = np.arange(least - step_px, largest + 1.5 * step_px, step_px)
        light = dict(zip(self.order, fine.views.light.values(), strict=True))
        nodes = fine.between(self.order, _EDGE_VIEWS)
        return find_far_side(light, nodes, shifts_px, distance=fine.distance, ratio=self.ratio[0])

    def bare_px(self) -> tuple[float, float]:
        """Return the range of disparities in px of the files."""
        scale = self.fine.views.fine_scale
        return self.raw_px[0] * scale, self.raw_px[1] * scale

    def range_px(self) -> tuple[float, float]:
        """Return the range of disparities in px of the files, with a margin."""
        least, largest = self.bare_px()
        margin = _MARGIN_SHARE * (largest - least) + _MARGIN_PX
        return least - margin, largest + margin


def measure(fine: FineMatch, orientation: Orientation, rough_ratio: float) -> Measured:
    """Return the views in an orientation, with their disparities measured there."""
    order = orientation.of(fine.views.nodes)
    pictures = dict(zip(order, fine.views.fine.values(), strict=True))
    tables, chance = (_oriented_tables(scores, orientation) for scores in (fine.tables, fine.chance))
    ratio = pitch_ratio(tables, chance, rough_ratio, NO_SIGN_PX / fine.views.fine_scale)
    table, by_chance = (
        combined(scores, transposed=False, opposed=False, ratio=ratio[0]) for scores in (tables, chance)
    )
    if (1, 0) not in tables.along:  # a single column: disparities are those along y
        table, by_chance = tables.along[0, 1], chance.along[0, 1]
    sure = sure_disparities(table, by_chance, fine.shifts_px)
    if len(sure) >= MIN_BLOCKS:
        span = span_px(sure)
    else:
        span = pooled_span_px(table, by_chance, fine.shifts_px) or (-fine.largest_px, fine.largest_px)
    return Measured(fine, order, pictures, span, ratio)


def _oriented_tables(tables: Tables, orientation: Orientation) -> Tables:
    """Return tables by row and column: their numbers swapped and their displacements reversed as the nodes are."""
    along = {}
    for (number, axis), table in tables.along.items():
        to = 1 - number if orientation.transpose else number
        flipped = orientation.flip_columns if to == 1 else orientation.flip_rows
        along[to, axis] = table[:, :, ::-1] if flipped else table
    return Tables(tables.shifts_px, along, tables.blocks)


def pitch_ratio(tables: Tables, chance: Tables, rough: float, no_sign_px: float) -> tuple[float, float]:
    """Return disparities along x over those along y, and its standard error; (1, 0) if the pictures do not tell.

    Disparities within `no_sign_px` are not told from zero.
    """
    if len(tables.numbers) < 2:
        return 1.0, 0.0
    x_px, y_px = (block_disparities(tables.along[key], chance.along[key], tables.shifts_px) for key in ((1, 0), (0, 1)))
    with np.errstate(invalid="ignore"):
        sure = np.abs(x_px - rough * y_px) < _AGREE * (np.abs(x_px) + no_sign_px)
        sure &= np.abs(y_px) > 0.5 * np.nanmax(np.abs(y_px), initial=0.0)
    ratios = x_px[sure] / y_px[sure]
    if len(ratios) < MIN_BLOCKS:
        return 1.0, 0.0
    ratio = float(np.median(ratios))
    sigma = float(1.25 * 1.48 * np.median(np.abs(ratios - ratio)) / np.sqrt(len(ratios)))
    return (ratio, sigma) if abs(ratio - 1) > max(SURE * sigma, _SQUARE) else (1.0, sigma)
