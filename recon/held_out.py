"""A weight for the penalty from the data: the one under which some views best predict the others."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.data_fit import DataFit
from recon.images import ElementalImages
from recon.operator import PlaneOperator
from recon.penalties import Penalty
from recon.pmlem import PmlemIterate, pmlem
from recon.solvers import smooth_start

# One view in so many is held out.
_HELD_OUT = 7

# With fewer views than this there is too little to predict, and too little to predict it from.
LEAST_VIEWS = 4

# Candidates are this factor apart, and so many steps to either side of the first at most.
_FACTOR, _STEPS = 2**0.5, 8

# Candidates need not be exact: their differences are what tells.
_TOLERANCE, _PASSES = 0.02, 4


@dataclass(frozen=True)
class Scored:
    """A weight that was tried.

    Attributes
    ----------
    weight : float
        β for all views.
    held_out : float
        Negative log-likelihood of the views held out, under the plane of the others.
    """

    weight: float
    held_out: float


@dataclass(frozen=True)
class ChosenWeight:
    """The weight that predicts best.

    Attributes
    ----------
    weight : float
        β for all views: where a parabola through the best candidates has its least.
    tried : tuple of Scored
        The candidates, by weight.
    passes : int
        Sweeps over all the data that the choice took, those over some of the views in proportion.
    nearest : PmlemIterate
        The plane of the best candidate, from most of the views: a start for the reconstruction.
    """

    weight: float
    tried: tuple[Scored, ...]
    passes: float
    nearest: PmlemIterate


def held_out_views(views: int, fold: int = 0) -> NDArray[np.intp]:
    """Return the views that one fold holds out: about a seventh, spread over the grid; folds are disjoint.

    In every seven views one is held out, three places further on each time: on a grid of seven columns, one in each row
    and one in each column.
    """
    folds = max(2, min(_HELD_OUT, views // 2))
    index = np.arange(views)
    stride = 1 if folds % 3 == 0 else 3
    return np.flatnonzero(index % folds == (stride * (index // folds) + fold) % folds)


def chosen_weight(operator: PlaneOperator, images: ElementalImages, guess: float, penalty: Penalty) -> ChosenWeight:
    """Return the penalty weight under which the views that are kept best predict those held out.

    Candidates are tried from a larger weight to smaller ones, each starting from the solution of the one before, until
    predictions have become worse on both sides of the best.

    Parameters
    ----------
    guess : float
        A weight to start from, for all views.

    Raises
    ------
    ValueError
        There are fewer than `LEAST_VIEWS` views.

    Notes
    -----
    The data's part of the objective grows with the number of views n and its noise with √n; a weight that balances
    that noise belongs to n views, and is carried over to all of them by the ratio of the roots.
    """
    count = len(operator.all_views)
    if count < LEAST_VIEWS:
        raise ValueError(f"need at least {LEAST_VIEWS} views to hold some out, got {count}")
    out = held_out_views(count)
    search = _Search(operator, images, guess, penalty, np.setdiff1d(operator.all_views, out), out)
    step = 1
    search.score(step)
    while step > -_STEPS and search.best() <= step + 1:
        step -= 1
        search.score(step)
    step = max(search.scores)
    while step < _STEPS and search.best() == step:
        step += 1
        search.score(step)
    return search.result()


class _Search:
    """Candidates β = guess · factorⁿ, and how they score."""

    def __init__(
        self,
        operator: PlaneOperator,
        images: ElementalImages,
        guess: float,
        penalty: Penalty,
        kept: NDArray[np.intp],
        out: NDArray[np.intp],
    ) -> None:
        start = smooth_start(operator, images, kept)
        level_e = float(start.mean(dtype=np.float64))
        self._kept, self._out = (DataFit(operator, images, level_e, views) for views in (kept, out))
        self._share = len(kept) / (len(kept) + len(out))
        self._guess, self._penalty = guess, penalty
        self._passes = self._share
        self._solutions: dict[int, PmlemIterate] = {}
        self._start = start
        self.scores: dict[int, float] = {}

    def score(self, step: int) -> None:
        """Try the candidate of a step."""
        weight = self._guess * _FACTOR**step * self._share**0.5
        near = self._solutions.get(step + 1) or self._solutions.get(step - 1)
        start = self._start if near is None else np.maximum(near.plane, 1e-3 * self._start)
        dual = None if near is None else near.dual
        iterates = pmlem(
            self._kept, start, penalty_weight=weight, penalty=self._penalty, tolerance=_TOLERANCE, dual=dual
        )
        for iterate in iterates:
            if iterate.certificate.distance <= _TOLERANCE or iterate.passes >= _PASSES:
                break
        self._solutions[step] = iterate
        self.scores[step] = self._out.value(iterate.plane)
        self._passes += iterate.passes * self._share + (1 - self._share)

    def best(self) -> int:
        """Return the step of the candidate that predicts best."""
        return min(self.scores, key=lambda step: self.scores[step])

    def result(self) -> ChosenWeight:
        """Return the weight at the least of a parabola through the best candidate and its neighbours."""
        best = self.best()
        offset = _lowest_offset([self.scores.get(best + n) for n in (-1, 0, 1)])
        tried = tuple(Scored(self._guess * _FACTOR**step, score) for step, score in sorted(self.scores.items()))
        weight = self._guess * _FACTOR ** (best + offset)
        return ChosenWeight(weight, tried, self._passes, self._solutions[best])


def _lowest_offset(scores: Sequence[float | None]) -> float:
    """Return where the parabola through scores at −1, 0 and 1 is lowest; 0 where one of them is missing."""
    before, here, after = scores
    if before is None or here is None or after is None or not before + after > 2 * here:
        return 0.0
    return float(np.clip(0.5 * (before - after) / (before - 2 * here + after), -0.5, 0.5))
