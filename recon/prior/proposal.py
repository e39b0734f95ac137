"""A proposal for the planes of a scene: candidate pictures, mixed such that they best predict held-out views.

Its response to noise in the data gives the standard deviation of planes made with it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.blur import blurred
from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator.occlusion import opacity
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.prior.evidence import Evidence, evidence_of_planes
from faintfield.recon.prior.scales import Candidates, is_of_samples
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.solver.initialization import mean_light_e
from faintfield.recon.solver.penalties import Penalty, differences
from faintfield.recon.solver.penalty_weight import (
    MIN_VIEWS,
    WINDOW_SAMPLES,
    Fold,
    fold_count,
    folds_to_predict,
    windows_of,
)
from faintfield.recon.solver.proximal import DualField
from faintfield.recon.solver.uncertainty import Answers, Expected, LocalProblem, UsualErrors, Weights
from faintfield.recon.threads import elementwise, map_in_threads

# Fewest folds of a plane that is no larger than this: the choice by one is noisy.
_MIN_FOLDS, _SMALL_PLANE = 2, 3 * 2**18

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

# Samples along the edges of a window that do not count: filters do not know what lies beyond.
_EDGE = 16

# A candidate is left out if the mixture predicts nearly as well without it: this share of its gain over the first
# candidate is lost at most for each; and for all those of the samples of a large plane, which take three times as long
# as all those of means of samples.
_NEGLIGIBLE, _SMALL = 0.001, 0.1

# Losses that differ by less than this share of the largest product of candidates differ by rounding.
_ROUNDING = 1e-12

# Rows that a thread mixes at a time: they stay in the cache.
_STRIP = 32

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


def best_mixture(scores: Scores, allowed: Sequence[int] | None = None) -> NDArray[np.float64]:
    """Return the weights a ≥ 0, Σ a = 1 of least error: (candidate,).

    Only candidates whose numbers are `allowed`, among them the first, have any. Where all predict alike, it is the
    first.
    """
    from scipy.optimize import nnls  # it takes 40 MB and half a second, and without a prior it is not needed

    chosen = np.arange(scores.towards.size) if allowed is None else np.asarray(allowed)
    # The errors of the candidates as columns, up to a part that all have in common: the error of a mixture of sum one
    # is the mixture of the errors. And min |E a|² + (1 − Σ a)² over a ≥ 0 has the direction of the best of those.
    values, vectors = np.linalg.eigh(scores.gram[np.ix_(chosen, chosen)])
    some = values > 1e-12 * max(values[-1], 0)
    roots, axes = np.sqrt(values[some])[:, np.newaxis], vectors[:, some].T
    errors = roots * axes - axes @ scores.towards[chosen, np.newaxis] / roots
    scale = np.abs(errors).max(initial=1e-300)
    sum_is_one = np.append(np.zeros(len(errors)), 1.0)
    shares, _ = nnls(np.vstack([errors / scale, np.ones(chosen.size)]), sum_is_one, maxiter=1000)
    weights, first = np.zeros((2, scores.towards.size))
    weights[chosen] = shares / shares.sum()
    first[chosen[0]] = 1.0
    alike = scores.loss(first) - scores.loss(weights) <= _ROUNDING * np.abs(scores.gram).max()
    return first if alike else weights


def mixtures_of(
    names: Sequence[str], totals: dict[str, Scores], *, is_slow: Callable[[str], bool] | None = None
) -> dict[str, dict[str, float]]:
    """Return the weights of candidates by region and name; those that hardly help anywhere need not be made.

    `is_slow` tells candidates that are to be made only if together they help more than a little.
    """

    def of(allowed: Sequence[int]) -> tuple[float, dict[str, NDArray[np.float64]]]:
        weights = {region: best_mixture(scores, allowed) for region, scores in totals.items()}
        return sum(scores.loss(weights[region]) for region, scores in totals.items()), weights

    (of_first, _), (least, weights) = of([0]), of(range(len(names)))
    allowed = list(range(len(names)))
    gain = of_first - least
    slow = {number for number in allowed[1:] if is_slow is not None and is_slow(names[number])}
    for left_out, most in [(slow, _SMALL), *(({number}, _NEGLIGIBLE) for number in reversed(allowed[1:]))]:
        fewer = [number for number in allowed if number not in left_out]
        loss, without = of(fewer)
        if loss - least <= most * gain:
            allowed, weights, least = fewer, without, loss
    return {region: dict(zip(names, of_region.tolist(), strict=True)) for region, of_region in weights.items()}


class ProposalSource(NamedTuple):
    """The evidence of a proposal, what makes candidates of evidence, and the regions of their weights."""

    evidence: Evidence
    candidates: Candidates
    regions: Regions


@dataclass(frozen=True)
class PlaneProposal:
    """The proposal for one plane.

    Attributes
    ----------
    picture, sigma : float array (row, column)
        x̂ ≥ 0 and the standard deviation of the back-projection, in electrons; σ is infinite where no view sees.
    mixture : dict of str to dict of str to float
        Weight of each candidate, by region: "light" or "dark", "detail" or "smooth".
    source : ProposalSource, optional
        What the picture is mixed of: as large as ten planes, and needed to make it again.
    """

    picture: Image
    sigma: Image
    mixture: dict[str, dict[str, float]]
    source: ProposalSource | None

    def again(self, evidence: Evidence, plane: Image) -> Image:
        """Return the picture of other evidence and total variation's plane by the same mixture."""
        assert self.source is not None
        return _mixed(self.source.candidates, evidence, plane, self.source.regions, self.mixture)


def propose(
    problem: SceneProblem,
    samples: Image,
    evidences: Sequence[Evidence],
    penalty_weight: float,
    candidates: Candidates,
    *,
    other_colours: Image | None = None,
    regions: Sequence[Regions] | None = None,
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
    other_colours : float array (samples), optional
        The planes in other colours, for the evidence of the folds.
    regions : sequence of dict, optional
        Their `regions_of_planes`, where they are known.
    """
    operator = problem.operator
    regions = regions or regions_of_planes(operator, samples, evidences)
    parts = _parts(problem, samples, evidences, regions, other_colours)
    names, totals = _judged(parts, penalty_weight, mean_light_e(operator, samples), candidates)
    is_slow = is_of_samples if len(parts) > 1 else None
    mixtures = [mixtures_of(*of_plane, is_slow=is_slow) for of_plane in zip(names, totals, strict=True)]
    planes = zip(operator.planes_of(samples), evidences, regions, mixtures, strict=True)
    return [
        PlaneProposal(
            _mixed(candidates, evidence, plane, shares, mixture),
            np.sqrt(evidence.noise.variance),
            mixture,
            ProposalSource(evidence, candidates, shares),
        )
        for plane, evidence, shares, mixture in planes
    ]


class _Part(NamedTuple):
    """A window of a large plane, or all planes of a scene; `regions` are zero where samples do not count."""

    problem: SceneProblem
    samples: Image
    evidences: Sequence[Evidence]
    regions: Sequence[Regions]
    other_colours: Image | None


def _parts(
    problem: SceneProblem,
    samples: Image,
    evidences: Sequence[Evidence],
    regions: Sequence[Regions],
    other_colours: Image | None,
) -> list[_Part]:
    """Return the parts by which candidates are judged: windows of a large plane, else all."""
    windows = windows_of(problem, MIN_VIEWS, WINDOW_SAMPLES, workers=1)
    if not windows:
        return [_Part(problem, samples, evidences, regions, other_colours)]
    parts = []
    for window in windows:
        (evidence,), (shares,) = evidences, regions
        inside = np.zeros(window.problem.operator.samples_shape, np.float32)
        inside[_EDGE:-_EDGE, _EDGE:-_EDGE] = 1
        variance, others = window.of(evidence.noise.variance), evidence.other_colours
        known = Evidence(
            window.of(evidence.picture),
            window.of(evidence.pilot),
            evidence.noise._replace(variance=variance),
            window.of(evidence.coverage),
            None if others is None else window.of(others),
        )
        shares = {name: inside * window.of(share) for name, share in shares.items()}
        light = None if other_colours is None else window.of(other_colours)
        parts.append(_Part(window.problem, window.of(samples), [known], [shares], light))
    return parts


def regions_of_planes(operator: SceneOperator, samples: Image, evidences: Sequence[Evidence]) -> list[Regions]:
    """Return the regions of each plane of a scene."""
    return [regions_of(*of_plane) for of_plane in zip(operator.planes_of(samples), evidences, strict=True)]


def regions_of(plane: Image, evidence: Evidence) -> Regions:
    """Return the regions of a plane: with light or without, with detail or without."""
    lit = blurred((opacity(plane) > 0.5).astype(np.float32), _BORDER_BLUR)
    change = elementwise(_in_units_of_noise, *differences(evidence.pilot), evidence.noise.variance)
    detail = blurred((blurred(change, _CHANGE_BLUR) > _DETAIL_SHARE).astype(np.float32), _DETAIL_BLUR)
    dark, smooth = (elementwise(lambda share: 1 - share, share) for share in (lit, detail))
    return {
        "light, detail": elementwise(np.multiply, lit, detail),
        "light, smooth": elementwise(np.multiply, lit, smooth),
        "dark, detail": elementwise(np.multiply, dark, detail, out=detail),
        "dark, smooth": elementwise(np.multiply, dark, smooth, out=smooth),
    }


def _in_units_of_noise(down: Image, right: Image, variance: Image) -> Image:
    """Return the length of differences over the deviation of the noise, in electrons where there is none."""
    change, noise = np.hypot(down, right), np.sqrt(np.where(np.isfinite(variance), variance, 1))
    return np.divide(change, noise, out=change, where=noise > 0)


def _judged(
    parts: Sequence[_Part], penalty_weight: float, level_e: float, candidates: Candidates
) -> tuple[list[list[str]], list[dict[str, Scores]]]:
    """Return the names of each plane's candidates, and their scores by region, in some folds of all parts."""

    def judge(job: tuple[_Part, int]) -> tuple[list[list[str]], list[dict[str, Scores]]]:
        return _fold_scores(*job, penalty_weight, level_e, candidates)

    if len(parts) > 1:  # each window in a fold of its own
        views = [len(part.problem.operator.seeing_views) for part in parts]
        folds = [number % fold_count(count) for number, count in enumerate(views)]
        found = map_in_threads(judge, list(zip(parts, folds, strict=True)))
    else:
        problem = parts[0].problem
        is_small = int(np.prod(problem.operator.samples_shape)) <= _SMALL_PLANE
        count = max(_MIN_FOLDS if is_small else 1, folds_to_predict(problem))
        found = [judge((parts[0], fold)) for fold in range(count)]
    totals: list[dict[str, Scores]] = [{} for _ in parts[0].evidences]
    for _, of_planes in found:
        for total, more in zip(totals, of_planes, strict=True):
            total.update({name: total[name] + new if name in total else new for name, new in more.items()})
    return found[0][0], totals


def _fold_scores(
    part: _Part, number: int, penalty_weight: float, level_e: float, candidates: Candidates
) -> tuple[list[list[str]], list[dict[str, Scores]]]:
    """Return the names of each plane's candidates, and their scores from the training views of a fold, by region."""
    problem, fold = part.problem, Fold(part.problem, Penalty(), number, level_e)
    planes = fold.solve(penalty_weight, part.samples, problem.dual()).plane
    training, validation = fold.training, fold.validation
    del fold  # which holds as much as the candidates take
    known, truths = (
        evidence_of_planes(
            problem.operator, problem.images, planes, views, other_colours=others, of_all_views=part.evidences
        )
        for views, others in ((training, part.other_colours), (validation, None))
    )
    names, found = [], []
    for evidence, truth, regions in zip(known, truths, part.regions, strict=True):
        made = candidates(evidence)
        pictures = list(made.values())
        names.append(list(made))
        found.append({n: scores(pictures, truth.picture, truth.coverage * share) for n, share in regions.items()})
    return names, found


def _sharpened(mixed: Image, plane: Image, evidence: Evidence) -> Image:
    """Return x̂ ≥ 0: a mixture, which is as blurred as the evidence, with the edges that the plane f has beyond that.

    They are `s (f − u)` with `s = d / (d + c v)`, d the mean of (f − u)² nearby and v the noise's variance, because
    large noise does more harm than the blur. Where no view sees the plane, f is all there is.
    """
    squares = blurred(elementwise(lambda f, u: np.square(f - u), plane, evidence.pilot), _SHARP_BLUR)
    return elementwise(_with_edges, mixed, plane, evidence.pilot, squares, evidence.noise.variance)


def _with_edges(mixed: Image, plane: Image, pilot: Image, squares: Image, variance: Image) -> Image:
    noise = np.float32(_SHARP_SHARE) * np.where(np.isfinite(variance), variance, 0)
    share = np.ones_like(squares)
    np.divide(squares, squares + noise, out=share, where=noise > 0)
    return np.maximum(mixed + share * (plane - pilot), 0)


def _mixed(
    candidates: Candidates,
    evidence: Evidence,
    plane: Image,
    regions: Regions,
    mixture: dict[str, dict[str, float]],
) -> Image:
    """Return x̂ ≥ 0: the mixture of candidates, with the edges that total variation's plane has beyond it."""
    used = {name for weights in mixture.values() for name, weight in weights.items() if weight > 0}
    made = candidates(evidence, used)
    picture = np.empty_like(evidence.pilot)

    def mix(strip: slice) -> None:
        picture[strip] = sum(
            regions[region][strip]
            * sum(np.float32(weight) * made[name][strip] for name, weight in weights.items() if weight > 0)
            for region, weights in mixture.items()
        )

    map_in_threads(mix, [slice(first, first + _STRIP) for first in range(0, len(picture), _STRIP)])
    return _sharpened(picture, plane, evidence)


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
        assert self._proposal.source is not None
        problem, evidence = self.problem, self._proposal.source.evidence
        plane = problem.optimum(change, self._pilot, self._pilot_dual.copy())
        seen = np.isfinite(evidence.noise.variance)
        picture = evidence.picture + np.where(seen, change / problem.local.metric, 0).astype(np.float32)
        pilot = evidence.pilot + np.where(seen, problem.as_seen(plane - self._pilot), 0).astype(np.float32)
        proposed = self._proposal.again(evidence._replace(picture=picture, pilot=pilot), plane)
        dual = replace(self._dual.copy(), proposal=proposed)
        return problem.optimum(change, self._optimum, dual) - self._optimum
