"""A mixture of candidate pictures: the weights with which they best predict views that were held out."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image


@dataclass(frozen=True)
class Scores:
    """The squared error of any mixture `Σ aₖ xₖ` of candidates against a picture, up to a constant: `aᵀG a − 2 tᵀa`.

    Attributes
    ----------
    gram : float array (candidate, candidate)
        G, the weighted sums of products of two candidates.
    towards : float array (candidate,)
        t, those of each candidate with the picture.
    """

    gram: NDArray[np.float64]
    towards: NDArray[np.float64]

    def __add__(self, other: "Scores") -> "Scores":
        return Scores(self.gram + other.gram, self.towards + other.towards)

    def loss(self, weights: NDArray[np.float64]) -> float:
        """Return the squared error of a mixture, up to a constant."""
        return float(weights @ self.gram @ weights - 2 * self.towards @ weights)


def scores(candidates: Sequence[Image], picture: Image, weight: Image) -> Scores:
    """Return the scores of candidates against a picture, all (row, column), each sample with a weight."""
    count = len(candidates)
    gram, towards = np.zeros((count, count)), np.zeros(count)
    for k, one in enumerate(candidates):
        weighted = one * weight
        towards[k] = np.einsum("ij,ij", weighted, picture, dtype=np.float64)
        for other in range(k + 1):
            gram[k, other] = gram[other, k] = np.einsum("ij,ij", weighted, candidates[other], dtype=np.float64)
    return Scores(gram, towards)


def best_mixture(scores: Scores) -> NDArray[np.float64]:
    """Return the weights a ≥ 0, Σ a = 1 of least error: (candidate,).

    Convex with few unknowns, so every set of candidates with positive weight is tried. Where the error falls no
    further, fewer candidates are preferred.
    """
    count = scores.towards.size
    best: NDArray[np.float64] = np.eye(count)[0]
    least = scores.loss(best)
    scale = max(float(np.trace(scores.gram)), 1e-300)
    for size in range(1, count + 1):
        for chosen in combinations(range(count), size):
            weights = _mixture_of(scores, list(chosen))
            if weights is not None and scores.loss(weights) < least - 1e-12 * scale:
                best, least = weights, scores.loss(weights)
    return best


def _mixture_of(scores: Scores, chosen: list[int]) -> NDArray[np.float64] | None:
    """Return the weights of least error with sum one of some candidates; None if one of them is negative."""
    # The first of them takes what the others leave of one: so the sum is exact whatever the scale of the errors
    first, *others = chosen
    differences = np.eye(scores.towards.size)[others] - np.eye(scores.towards.size)[first]
    curvature = differences @ scores.gram @ differences.T
    slope = differences @ (scores.towards - scores.gram[first])
    shares = np.linalg.lstsq(curvature, slope, rcond=None)[0]
    if (shares < 0).any() or shares.sum() > 1:
        return None
    weights: NDArray[np.float64] = np.zeros(scores.towards.size)
    weights[others], weights[first] = shares, 1 - shares.sum()
    return weights
