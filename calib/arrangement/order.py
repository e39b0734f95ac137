"""Test whether neighbours by name fit one another better than other pictures of the set do in their places."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.arrangement.axes import Axes
from faintfield.calib.arrangement.matching import Table, correlate_blocks
from faintfield.calib.arrangement.nodes import Node, neighbour, spread
from faintfield.calib.arrangement.pictures import Picture

# Views that are tested, other pictures that may take the places of their neighbours, and exchanges that are tried.
_VIEWS, _OTHERS, _EXCHANGES = 9, 12, 40

# Scores of both halves of the blocks must agree by this correlation, in so many standard errors: then pictures, not
# noise, make them differ.
_MIN_REPEATABILITY, _MIN_REPEATABILITY_Z = 0.6, 3.0

# Share of the exchanges that must make the match worse, over that correlation: in light fields nearly all do unless
# noise decides, in random order half of them.
_FITS = 0.85

# Exchanges that differ which that correlation needs: four views in a square have too few.
_LEAST = 10

# Seed of the exchanges, so that a set always gets the same answer.
_SEED = 0


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


def check_order(pictures: Mapping[Node, Picture], axes: Axes, largest_px: float) -> OrderTest:
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
    fits = all(share > _FITS * repeats for share, repeats in shares)
    return OrderTest("fits" if fits else "denied", min(share for share, _ in shares))


def _repeatability(deviations: NDArray[np.float64], free: int) -> float:
    """Return the correlation of the scores (exchange, half) of both halves of the blocks, 0 if it may be chance."""
    first, second = deviations.T
    power = float(np.sqrt((first**2).sum() * (second**2).sum()))
    correlation = min(float((first * second).sum()) / power, 1 - 1e-9) if power else 0.0
    return (
        correlation
        if correlation > _MIN_REPEATABILITY and np.arctanh(correlation) * np.sqrt(free - 1) > _MIN_REPEATABILITY_Z
        else 0.0
    )


def _exchange(
    pictures: Mapping[Node, Picture],
    node: Node,
    axes: Axes,
    shifts_px: NDArray[np.float64],
    generator: np.random.Generator,
) -> Iterator[tuple[int, float, NDArray[np.float64]]]:
    """Exchange the neighbours of a view along each number for other pictures.

    Yield the number, the score of the neighbours, and the scores (exchange, half) of other pictures in their places:
    mean correlations of blocks at their best disparity, for both halves of the blocks.
    """

    @cache
    def table(other: Node, axis: int, unit: float) -> Table:
        return correlate_blocks(pictures[node], pictures[other], unit * shifts_px, axis)

    def score(chosen: Mapping[tuple[int, int], Node]) -> NDArray[np.float64]:
        tables = []
        for (number, sign), other in chosen.items():
            axis, scale = axes.movement(number)
            tables.append(table(other, axis, abs(scale))[:, :: 1 if sign * scale > 0 else -1])
        best = np.mean(tables, axis=0).max(axis=1)
        return np.array([best[::2].mean(), best[1::2].mean()], np.float64)

    named = {
        (number, sign): other
        for number in (0, 1)
        for sign in (-1, 1)
        if (other := neighbour(node, number, sign)) in pictures
    }
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
        scores = [
            score(named | dict(zip(places, draw, strict=True)))
            for draw in draws
            if set(draw) != {named[place] for place in places}
        ]
        if scores:
            yield number, own, np.array(scores)
