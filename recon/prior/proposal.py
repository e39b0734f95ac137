"""A proposal for the planes of a scene: candidate pictures, mixed such that they best predict held-out views.

Its response to noise in the data gives the standard deviation of planes made with it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image, blurred
from faintfield.recon.operator.occlusion import opacity
from faintfield.recon.prior.evidence import Evidence, evidence_of_planes
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.solver.penalties import Penalty, differences
from faintfield.recon.solver.penalty_weight import Fold, folds_to_predict
from faintfield.recon.solver.proximal import DualField
from faintfield.recon.solver.uncertainty import Answers, Expected, LocalProblem, UsualErrors, Weights

# Fewest folds: the choice by one is noisy.
_MIN_FOLDS = 2

# Spacings of the blur of the border between what is lit and what is dark.
_BORDER_BLUR = (1, 1, 2)

# A sample is in detail where the pilot changes by this share of the noise's deviation from sample to sample; blurs of
# the change and of the detail. Chosen on photographs.
_DETAIL_SHARE, _CHANGE_BLUR, _DETAIL_BLUR = 0.15, (1, 1), (1, 1, 2)

# What a plane has beyond its blurred self counts where its square exceeds this share of the noise's variance. Chosen on
# the scenes of `CHOSEN_ON` in benchmarks/imaging/uncertainty.py; the blur of that square.
_SHARP_SHARE, _SHARP_BLUR = 0.1, (1,)

# The penalty weight about a proposal over that of total variation. With 1, the data bring back single bright samples of
# noise where the proposal is right. Chosen on the scenes of `CHOSEN_ON` in benchmarks/imaging/uncertainty.py.
WEIGHT_ABOUT_PROPOSAL = 1.2

# Candidates of one plane by name, all as blurred as the evidence.
type Candidates = Callable[[Evidence], dict[str, Image]]

# Shares (row, column) of each sample that belong to a region, by the region's name; they sum to one.
type Regions = dict[str, Image]


@dataclass(frozen=True)
class Scores:
    """Squared error of any mixture `Σ aₖ xₖ` of candidates against a picture, up to a constant: `aᵀG a − 2 tᵀa`.

    G, `gram` (candidate, candidate), are the weighted sums of products of two candidates, and t, `towards`, those of
    each candidate with the picture.
    """

    gram: NDArray[np.float64]
    towards: NDArray[np.float64]

    def __add__(self, other: "Scores") -> "Scores":
        return Scores(self.gram + other.gram, self.towards + other.towards)

    def loss(self, weights: NDArray[np.float64]) -> float:
        """Return the squared error of a mixture, up to a constant."""
        return float(weights @ self.gram @ weights - 2 * self.towards @ weights)


def scores(candidates: Sequence[Image], picture: Image, weight: Image) -> Scores:
    """Return the scores of candidates against a picture, given a weight of each sample, all (row, column)."""
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

    Every set of candidates with positive weight is tried. Where the error falls no further, fewer are preferred.
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
    # The first of them takes the rest: so the sum is one whatever the scale of the errors
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


@dataclass(frozen=True)
class PlaneProposal:
    """The proposal for one plane.

    Attributes
    ----------
    picture, sigma : float array (row, column)
        x̂ ≥ 0 and the standard deviation of the back-projection, in electrons; σ is infinite where no view sees.
    mixture : dict of str to dict of str to float
        Weight of each candidate, by region: "light" or "dark", "detail" or "smooth".
    evidence, again : Evidence, callable
        Its evidence; a function that makes the picture of other evidence and total variation's plane by this mixture.
    """

    picture: Image
    sigma: Image
    mixture: dict[str, dict[str, float]]
    evidence: Evidence
    again: Callable[[Evidence, Image], Image]


def propose(
    problem: SceneProblem,
    samples: Image,
    evidences: Sequence[Evidence],
    penalty_weight: float,
    candidates: Candidates,
    *,
    drafts: Candidates | None = None,
    other_colours: Image | None = None,
) -> list[PlaneProposal]:
    """Return a proposal for each plane of a scene: a mixture of candidates, with weights from held-out views.

    The mixture best predicts the back-projections of held-out views, in the mean over folds. It differs from region to
    region: with and without light, with and without detail.

    Parameters
    ----------
    problem, samples, penalty_weight : SceneProblem, float array (samples), float
        Operator and images, of at least `MIN_VIEWS` views that see anything; f, the planes of total variation; their β.
    evidences : sequence of Evidence
        Evidence of all views for each plane.
    candidates : callable
        Returns the candidates for one plane by name, given its evidence: always the same names. The first is chosen
        where all predict alike.
    drafts : callable, optional
        Returns candidates that are nearly those, but made faster: good enough to find the weights.
    other_colours : float array (samples), optional
        The planes in other colours, for the evidence of the folds.
    """
    operator = problem.operator
    regions = [regions_of(*of_plane) for of_plane in zip(operator.planes_of(samples), evidences, strict=True)]
    totals: list[list[Scores]] = [[] for _ in evidences]
    for number in range(max(_MIN_FOLDS, folds_to_predict(problem))):
        found = _fold_scores(problem, samples, penalty_weight, number, drafts or candidates, regions, other_colours)
        totals = [
            [a + b for a, b in zip(total, more, strict=True)] if total else more
            for total, more in zip(totals, found, strict=True)
        ]
    mixtures = [[best_mixture(of_region) for of_region in of_plane] for of_plane in totals]
    pictures = operator.planes_of(samples)
    return [_proposal(candidates, *of_plane) for of_plane in zip(pictures, evidences, regions, mixtures, strict=True)]


def regions_of(plane: Image, evidence: Evidence) -> Regions:
    """Return the regions of a plane: with light or without, with detail or without."""
    lit = blurred((opacity(plane) > 0.5).astype(np.float32), _BORDER_BLUR)
    seen = np.isfinite(evidence.noise.variance)
    change = np.hypot(*differences(evidence.pilot))
    noise = np.sqrt(np.where(seen, evidence.noise.variance, 1))
    np.divide(change, noise, out=change, where=noise > 0)
    detail = blurred((blurred(change, _CHANGE_BLUR) > _DETAIL_SHARE).astype(np.float32), _DETAIL_BLUR)
    return {
        "light, detail": lit * detail,
        "light, smooth": lit * (1 - detail),
        "dark, detail": (1 - lit) * detail,
        "dark, smooth": (1 - lit) * (1 - detail),
    }


def _fold_scores(
    problem: SceneProblem,
    samples: Image,
    penalty_weight: float,
    number: int,
    candidates: Candidates,
    regions: list[Regions],
    other_colours: Image | None,
) -> list[list[Scores]]:
    """Return the scores of each plane's candidates from the training views of a fold, by region."""
    operator, fold = problem.operator, Fold(problem, Penalty(), number)
    planes = fold.solve(penalty_weight, samples, problem.dual()).plane
    training, validation = fold.training, fold.validation
    del fold  # which holds as much as the candidates take
    known = evidence_of_planes(operator, problem.images, planes, training, other_colours=other_colours)
    made = [list(candidates(evidence).values()) for evidence in known]
    truths = evidence_of_planes(operator, problem.images, planes, validation)
    return [
        [scores(pictures, truth.picture, truth.coverage * share) for share in shares.values()]
        for pictures, truth, shares in zip(made, truths, regions, strict=True)
    ]


def _proposal(
    candidates: Candidates, plane: Image, evidence: Evidence, regions: Regions, mixture: list[NDArray[np.float64]]
) -> PlaneProposal:
    made = candidates(evidence)
    named = {name: dict(zip(made, a.tolist(), strict=True)) for name, a in zip(regions, mixture, strict=True)}

    def again(other: Evidence, other_plane: Image) -> Image:
        return _sharpened(_mixed(candidates(other), regions, mixture), other_plane, other)

    picture = _sharpened(_mixed(made, regions, mixture), plane, evidence)
    return PlaneProposal(picture, np.sqrt(evidence.noise.variance), named, evidence, again)


def _sharpened(mixed: Image, plane: Image, evidence: Evidence) -> Image:
    """Return x̂ ≥ 0: a mixture, which is as blurred as the evidence, with the edges that the plane f has beyond that.

    They are `s (f − u)` with `s = d / (d + c v)`, d the mean of (f − u)² nearby and v the noise's variance, because
    large noise does more harm than the blur. Where no view sees the plane, f is all there is.
    """
    edges = plane - evidence.pilot
    variance = evidence.noise.variance
    seen = np.isfinite(variance)
    squares = blurred(np.square(edges).astype(np.float32), _SHARP_BLUR)
    noise = np.float32(_SHARP_SHARE) * np.where(seen, variance, 0)
    share = np.ones_like(squares)
    np.divide(squares, squares + noise, out=share, where=noise > 0)
    return np.asarray(np.maximum(mixed + share * edges, 0), mixed.dtype)


def _mixed(made: dict[str, Image], regions: Regions, mixture: list[NDArray[np.float64]]) -> Image:
    picture = np.zeros_like(next(iter(made.values())))
    for weights, share in zip(mixture, regions.values(), strict=True):
        for weight, candidate in zip(weights, made.values(), strict=True):
            if weight > 0:
                picture += np.float32(weight) * share * candidate
    return picture


class ProposalAnswers(Answers):
    """The answers of the certified optimum about a proposal, with `pilot` total variation's plane in electrons.

    For each change of the data total variation's plane, the proposal from it, by the same mixture, and the optimum
    about that are found again, on the quadratic that L is near the optimum: no pass over the data.
    """

    # A filter that is told the noise of its data answers to more of it as to a picture: the noise added is small.
    # Chosen on the scenes of `CHOSEN_ON` in benchmarks/imaging/uncertainty.py.
    usual = UsualErrors(0.2, Expected(1.7, 1.7, 1.0), Expected(0.7, 0.7, 0.4), Weights(0.5, 0.2, 0.1, 0.6))

    def __init__(self, problem: LocalProblem, proposal: PlaneProposal, pilot: Image) -> None:
        self.problem, self._proposal = problem, proposal
        nothing = DualField.zero([pilot.shape], np.dtype(np.float32))
        self._pilot_dual = nothing.copy()
        self._pilot = problem.optimum(None, np.asarray(pilot, np.float32), self._pilot_dual)
        self._dual = replace(nothing, proposal=np.asarray(proposal.picture, np.float32))
        self._optimum = problem.optimum(None, problem.plane, self._dual)

    def __call__(self, change: Image) -> Image:
        """Return the change of the optimum (row, column) for a change of −∇L."""
        problem, evidence = self.problem, self._proposal.evidence
        plane = problem.optimum(change, self._pilot, self._pilot_dual.copy())
        seen = np.isfinite(evidence.noise.variance)
        picture = evidence.picture + np.where(seen, change / problem.local.metric, 0).astype(np.float32)
        pilot = evidence.pilot + np.where(seen, problem.as_seen(plane - self._pilot), 0).astype(np.float32)
        proposed = self._proposal.again(evidence._replace(picture=picture, pilot=pilot), plane)
        dual = replace(self._dual.copy(), proposal=proposed)
        return problem.optimum(change, self._optimum, dual) - self._optimum
