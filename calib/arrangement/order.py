"""Test whether neighbours by name fit one another better than other pictures of the set do in their places."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.arrangement.axes import Axes, direction
from faintfield.calib.arrangement.matching import Table, block_table, neighbour
from faintfield.calib.arrangement.pictures import Node, Picture, spread

# Views that are tested, other pictures that may take the places of their neighbours, and exchanges that are tried.
_VIEWS, _OTHERS, _EXCHANGES = 9, 12, 40

# Side of a block, px of the coarse pictures.
_BLOCK_PX = 16

# Scores of both halves of the blocks must agree by this correlation, in so many standard errors: then pictures, not
# noise, make them differ.
_REPEATS, _SURE = 0.6, 3.0

# Share of the exchanges that must make the match worse, over that correlation: in light fields nearly all do unless
# noise decides, in random order half of them.
_FITS = 0.85

# Exchanges that differ which that correlation needs: four views in a square have too few.
_LEAST = 10

# Seed of the exchanges, so that a set always gets the same answer.
_SEED = 0

# A neighbour's place: the number of the names that changes, and by how much.
type _Place = tuple[int, int]

type Verdict = Literal["fits", "denied", "open", "few"]


@dataclass(frozen=True)
class Order:
    """Test of the names by exchanging neighbours for other pictures.

    Attributes
    ----------
    verdict : {"fits", "denied", "open", "few"}
        The neighbours fit better than others; no better, although pictures differ in how they fit; all pictures fit
        equally well, as copies and too dark ones do; there are too few to exchange any.
    share : float
        Share of the exchanges that make the match worse, along the number for which it is least.
    """

    verdict: Verdict
    share: float


def check_order(pictures: Mapping[Node, Picture], axes: Axes, largest_px: float) -> Order:
    """Exchange the neighbours of views for other pictures, along each number by itself.

    In a light field the blocks of a view are found in all its neighbours at one disparity, and in no other pictures
    that take their places. Copies fit in every place; pictures in random order fit as badly in their own.

    Parameters
    ----------
    pictures : mapping of node to array (row, column)
        Coarse pictures by the numbers of their names, without their brightness.
    axes : Axes
        How points move along both numbers.
    largest_px : float
        Largest disparity.
    """
    generator = np.random.default_rng(_SEED)
    reach = int(np.ceil(largest_px))
    shifts_px = np.arange(-reach, reach + 1.0)
    found = {0: _Exchanges(), 1: _Exchanges()}
    for node in spread(list(pictures), _VIEWS):
        _exchange(found, _View(pictures, node, axes, shifts_px), generator)
    told = [
        (float(np.mean(exchanges.worse)), repeats)
        for exchanges in found.values()
        if (repeats := exchanges.repeats()) > 0
    ]
    if not told:
        return Order("open" if max(exchanges.free for exchanges in found.values()) >= _LEAST else "few", 1.0)
    fits = all(share > _FITS * repeats for share, repeats in told)
    return Order("fits" if fits else "denied", min(share for share, _ in told))


@dataclass
class _Exchanges:
    """Exchanges along one number: the share that was worse, by view, and scores (exchange, half) about their mean."""

    worse: list[float] = field(default_factory=list)
    scores: list[NDArray[np.float64]] = field(default_factory=list)

    @property
    def free(self) -> int:
        """Number of scores that may differ."""
        return sum(len(line) - 1 for line in self.scores)

    def repeats(self) -> float:
        """Return the correlation of the scores of both halves of the blocks, 0 if it may be chance."""
        if self.free < _LEAST:
            return 0.0
        one, other = np.concatenate(self.scores).T
        power = float(np.sqrt((one**2).sum() * (other**2).sum()))
        found = min(float((one * other).sum()) / power, 1 - 1e-9) if power else 0.0
        return found if found > _REPEATS and np.arctanh(found) * np.sqrt(self.free - 1) > _SURE else 0.0


class _View:
    """A view, and how well its blocks are found in other pictures in the places of its neighbours."""

    def __init__(
        self, pictures: Mapping[Node, Picture], node: Node, axes: Axes, shifts_px: NDArray[np.float64]
    ) -> None:
        self.pictures, self.node, self.axes, self.shifts_px = pictures, node, axes, shifts_px
        places = ((number, sign) for number in (0, 1) for sign in (-1, 1))
        self.named: dict[_Place, Node] = {
            (number, sign): other for number, sign in places if (other := neighbour(node, number, sign)) in pictures
        }
        self._tables: dict[tuple[Node, int], Table] = {}

    def score(self, others: Mapping[_Place, Node]) -> NDArray[np.float64]:
        """Return the mean correlation of blocks at their best disparity, for both halves of the blocks."""
        best = np.mean([self._table(other, place) for place, other in others.items()], axis=0).max(axis=1)
        return np.array([best[::2].mean(), best[1::2].mean()], np.float64)

    def _table(self, other: Node, place: _Place) -> Table:
        """Return the correlation (block, shift) with another picture in a neighbour's place."""
        number, sign = place
        axis, scale = direction(self.axes.transposed, self.axes.opposed, self.axes.ratio, number)
        if (other, axis) not in self._tables:
            pair = self.pictures[self.node], self.pictures[other]
            self._tables[other, axis] = block_table(*pair, abs(scale) * self.shifts_px, axis, _BLOCK_PX)
        table = self._tables[other, axis]
        return table if sign * scale > 0 else table[:, ::-1]


def _exchange(found: Mapping[int, _Exchanges], view: _View, generator: np.random.Generator) -> None:
    """Exchange the neighbours of a view along each number for others, and keep what is worse."""
    named = view.named
    rest = [node for node in view.pictures if node != view.node and node not in named.values()]
    pool = [*named.values(), *(rest[index] for index in generator.permutation(len(rest))[:_OTHERS])]
    # A block is found anywhere in a single picture
    if len(named) < 2:
        return
    own = view.score(named).sum()
    for number, exchanges in found.items():
        places = [place for place in named if place[0] == number]
        named_there = [named[place] for place in places]
        scores = [
            view.score(named | dict(zip(places, chosen, strict=True)))
            for chosen in _choices(pool, named_there, generator)
        ]
        if scores:
            table = np.array(scores)
            exchanges.worse.append(float(np.mean(table.sum(axis=1) < own)))
            exchanges.scores.append(table - table.mean(axis=0))


def _choices(pool: Sequence[Node], named: Sequence[Node], generator: np.random.Generator) -> list[tuple[Node, ...]]:
    """Return different random pictures for the places of neighbours, but not these exchanged: the mirrored order."""
    if not named:
        return []
    draws = [tuple(pool[index] for index in generator.permutation(len(pool))[: len(named)]) for _ in range(_EXCHANGES)]
    return [draw for draw in dict.fromkeys(draws) if set(draw) != set(named)]
