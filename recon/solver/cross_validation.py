"""A weight for the penalty from the data: the one under which some views best predict the others."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.pmlem import PmlemIterate, pmlem
from faintfield.recon.solver.problem import Posed

# One view in so many is held out.
_HELD_OUT = 7

# So many numbers are predicted at least, by several folds if need be: the score of a few is mostly chance.
_LEAST_PREDICTED = 6e5

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
        Negative log-likelihood of the views held out, under the plane of the others; the sum over the folds.
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
    folds = _folds(views)
    index = np.arange(views)
    stride = 1 if folds % 3 == 0 else 3
    return np.flatnonzero(index % folds == (stride * (index // folds) + fold) % folds)


def _folds(views: int) -> int:
    """Return into how many folds views are divided."""
    return max(2, min(_HELD_OUT, views // 2))


def chosen_weight(posed: Posed, guess: float, penalty: Penalty) -> ChosenWeight:
    """Return the penalty weight under which the views that are kept best predict those held out.

    Candidates are tried from a larger weight to smaller ones, each starting from the solution of the one before, until
    predictions have become worse on both sides of the best.

    Parameters
    ----------
    posed : Posed
        The plane, or the planes together.
    guess : float
        A weight to start from, for all views.

    Raises
    ------
    ValueError
        Fewer than `LEAST_VIEWS` views see anything.

    Notes
    -----
    The data's part of the objective grows with the number of views n and its noise with √n; a weight that balances
    that noise belongs to n views, and is carried over to all of them by the ratio of the roots.
    """
    count = len(posed.views)
    if count < LEAST_VIEWS:
        raise ValueError(f"need at least {LEAST_VIEWS} views that see anything to hold some out, got {count}")
    pixels_of_fold = posed.images.electrons[0].size * count / _folds(count)
    needed = min(int(np.ceil(_LEAST_PREDICTED / pixels_of_fold)), _folds(count))
    outs = [posed.views[held_out_views(count, fold)] for fold in range(needed)]
    search = _Search([_Fold(posed, penalty, out) for out in outs], guess)
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


class _Fold:
    """The views that are kept, those held out, and the solutions so far."""

    def __init__(self, posed: Posed, penalty: Penalty, out: NDArray[np.intp]) -> None:
        kept = np.setdiff1d(posed.views, out)
        self._start = posed.start(kept)
        self._fit = posed.fit(posed.level_e(self._start), kept)
        self._posed, self._out, self._penalty = posed, out, penalty
        self._share = len(kept) / len(posed.views)
        self.passes = self._share
        self.solutions: dict[int, PmlemIterate] = {}

    def score(self, step: int, weight: float) -> float:
        """Return how well the candidate of a step predicts, solving from its neighbour's solution."""
        near = self.solutions.get(step + 1) or self.solutions.get(step - 1)
        iterates = pmlem(
            self._fit,
            self._start if near is None else np.maximum(near.plane, 1e-3 * self._start),
            penalty_weight=weight * self._share**0.5,
            penalty=self._penalty,
            tolerance=_TOLERANCE,
            dual=self._posed.dual() if near is None else near.dual,
        )
        for done, iterate in enumerate(iterates, 1):
            if iterate.certificate.distance <= _TOLERANCE or max(done, iterate.passes) >= _PASSES:
                break
        self.solutions[step] = iterate
        self.passes += iterate.passes * self._share + (1 - self._share)
        return self._posed.value(iterate.plane, self._out)


class _Search:
    """Candidates β = guess · factorⁿ, and how they score."""

    def __init__(self, folds: list[_Fold], guess: float) -> None:
        self._folds, self._guess = folds, guess
        self.scores: dict[int, float] = {}

    def score(self, step: int) -> None:
        """Try the candidate of a step."""
        weight = self._guess * _FACTOR**step
        self.scores[step] = sum(fold.score(step, weight) for fold in self._folds)
        # Others start from this one, or from the best when there are none beyond it
        for fold in self._folds:
            fold.solutions = {kept: fold.solutions[kept] for kept in {step, self.best()}}

    def best(self) -> int:
        """Return the step of the candidate that predicts best."""
        return min(self.scores, key=lambda step: self.scores[step])

    def result(self) -> ChosenWeight:
        """Return the weight at the least of a parabola through the best candidate and its neighbours."""
        best = self.best()
        offset = _lowest_offset([self.scores.get(best + n) for n in (-1, 0, 1)])
        tried = tuple(Scored(self._guess * _FACTOR**step, score) for step, score in sorted(self.scores.items()))
        weight = self._guess * _FACTOR ** (best + offset)
        return ChosenWeight(weight, tried, sum(fold.passes for fold in self._folds), self._folds[0].solutions[best])


def _lowest_offset(scores: Sequence[float | None]) -> float:
    """Return where the parabola through scores at −1, 0 and 1 is lowest; 0 where one of them is missing."""
    before, here, after = scores
    if before is None or here is None or after is None or not before + after > 2 * here:
        return 0.0
    return float(np.clip(0.5 * (before - after) / (before - 2 * here + after), -0.5, 0.5))
