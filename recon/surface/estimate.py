"""Depth and light of a surface by turns, each given the other, among depths whose range may be unknown."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.errors import NothingInFocus
from faintfield.recon.likelihood.images import Image
from faintfield.recon.numba_tools import compiled
from faintfield.recon.solver.penalty_weight import MIN_VIEWS, validation_views
from faintfield.recon.surface.confidence import confidence, spacing_needed
from faintfield.recon.surface.edges import moved_edges
from faintfield.recon.surface.evidence import DepthEvidence, Explained, Halves
from faintfield.recon.surface.goodness import (
    Prediction,
    explained_share,
    lit_samples,
    predicted,
    seen_of,
    squared_errors,
)
from faintfield.recon.surface.pinhole_views import PinholeViews, gaussian
from faintfield.recon.surface.regularization import PiecewisePlane, lowest, sum_over_paths

# Rounds of depth and light without the views that judge them, before one more with all views; fewest views of which
# some are left out to judge: both halves of the others must find depths.
_ROUNDS, _MIN_JUDGED = 2, 2 * MIN_VIEWS

# Scales of windows in samples: the small one, the one that its votes are gathered over, and that of the first round.
_WINDOW, _GATHERED, _GATHERED_AT_FIRST = 1.5, 4.0, 6.0

# Probability that a small window has another depth than its neighbours; share of its evidence that is independent, as
# samples of a denoised picture are not.
_OUTLIERS, _INDEPENDENT = 0.3, 0.3

# Costs of paths: one step, any step; and those of the first round.
_STEP_COSTS, _STEP_COSTS_AT_FIRST = (0.5, 4.0), (1.0, 10.0)

# α₁ and α₀ of total generalised variation, per step of depth; scale of its window; its stages and steps.
_BEND, _REFINED, _STEPS = (0.05, 0.3), 3.0, 60
_STAGES = (100.0, 50.0, 25.0, 12.0, 6.0, 3.0)

# The highest confidence at the ends of the range, as a better depth may lie beyond, and where there is no light.
_DOUBTFUL = 0.5

# Quantile of 1/depth that stands for the nearest depths: few samples may be nearer by mistake.
_NEAREST = 0.99

# Movement of the outermost view from one depth to the next, in samples; fewest and most depths.
_SAMPLES_PER_STEP, _MIN_DEPTHS, _MAX_DEPTHS = 1.6, 64, 128

# Bins in which a range is sought, on top of those of the views, to save time where these have more samples than the
# second; searches, each in the range that the last found.
_BINS, _FEW_SAMPLES, _SEARCHES = 2, 20_000, 2

# Samples that tell the range are right with this probability; there are at least so many.
_LIKELY, _MIN_SAMPLES = 0.5, 64

# Quantiles of their depths, and what is added on either side: a share of the range, and steps.
_QUANTILES, _MARGIN, _MARGIN_STEPS = (0.003, 0.997), 0.05, 2.0

# Search again if the range shrinks to less than this share of the last one.
_SHRUNK_ENOUGH = 0.6


@dataclass(frozen=True)
class SurfaceEstimate:
    """The depth of each sample.

    Attributes
    ----------
    inverse_depth, confidence : float array (row, column)
        1/depth, and the probability that it is right within 2 %.
    rounds : int
        Rounds of depth and light that the result needed.
    prediction : Prediction, optional
        Of views that were left out; None if there are too few views to leave some out.
    lit_share : float
        Share of the samples whose light stands out of the noise.
    spacing_needed : float, optional
        Factor by which views must be farther apart for the nearest depths to be sure; None without light.
    """

    inverse_depth: NDArray[np.float64]
    confidence: NDArray[np.float32]
    rounds: int
    prediction: Prediction | None
    lit_share: float
    spacing_needed: float | None


def estimate_surface(
    views: PinholeViews, inverse_depths: NDArray[np.float64], shared_sigma: float = 0.0
) -> SurfaceEstimate:
    """Return the surface that explains the views best.

    All rounds but the last are done without some of the views; the last starts from the one that predicts these best.

    `inverse_depths` (depth,) are the 1/depth to choose from, ascending in equal steps. `shared_sigma` is the standard
    deviation that all of them have in common, by errors of the poses.
    """
    nodes = views.nodes
    left_out = validation_views(len(nodes)) if len(nodes) >= _MIN_JUDGED else np.zeros(0, np.intp)
    kept = np.setdiff1d(np.arange(len(nodes)), left_out)
    evidence = DepthEvidence(views, inverse_depths, halves(nodes, kept))
    candidates = [first_depths(evidence)]
    known = evidence.explained(candidates[0])
    best, least = 0, _errors(evidence, known, left_out)
    for number in range(1, _ROUNDS + 1):
        candidates.append(next_depths(evidence, known)[0])
        known = evidence.explained(candidates[-1])
        errors = _errors(evidence, known, left_out)
        if np.nansum(errors - least, dtype=np.float64) <= 0:  # where both surfaces are seen
            best, least = number, errors
    prediction = None
    if left_out.size:
        beside = [kept[np.abs(nodes[kept] - nodes[view]).sum(axis=1) == 1] for view in left_out]
        prediction = predicted(evidence, candidates[best], left_out, beside)
    final = DepthEvidence(views, inverse_depths, halves(nodes))
    index, costs = next_depths(final, final.explained(candidates[best]))
    parallax = float(np.linalg.norm(views.reach))
    sure = confidence(index, costs, inverse_depths, explained_share(final, index), parallax, shared_sigma)
    depths = np.interp(index, np.arange(len(inverse_depths)), inverse_depths)
    lit = lit_samples(views, depths)
    doubtful = (index <= 1) | (index >= len(inverse_depths) - 2) | ~lit
    sure[doubtful] = np.minimum(sure[doubtful], _DOUBTFUL)
    nearest = float(np.quantile(depths[lit], _NEAREST)) if lit.any() else 0.0
    spacing = spacing_needed(nearest, parallax) if nearest > 0 else None
    return SurfaceEstimate(depths, sure, best + 1, prediction, float(lit.mean()), spacing)


def _errors(evidence: DepthEvidence, known: Explained, views: NDArray[np.intp]) -> NDArray[np.float32]:
    """Return the squared errors over variance of views (view, row, column), NaN where they do not see the surface."""
    squares = squared_errors(evidence, known.operator.forward(known.light(), views), views)
    return np.where(seen_of(evidence, known, views), squares, np.float32(np.nan))


def first_depths(evidence: DepthEvidence) -> NDArray[np.float32]:
    """Return depths to start from (row, column), as fractional index."""
    return lowest(sum_over_paths(_votes(evidence.at_first(), _GATHERED_AT_FIRST), *_STEP_COSTS_AT_FIRST))


def halves(nodes: NDArray[np.intp], views: NDArray[np.intp] | None = None) -> Halves:
    """Return two halves of the views, all by default: by a checkerboard of nodes, unless nearly all have one colour."""
    views = np.arange(len(nodes)) if views is None else views
    odd = nodes[views].sum(axis=1) % 2 == 1
    if not len(views) <= 4 * np.count_nonzero(odd) <= 3 * len(views):
        odd = np.arange(len(views)) % 2 == 1
    return Halves(views[~odd], views[odd])


def next_depths(evidence: DepthEvidence, known: Explained) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the depths given a surface's light, as fractional index, and the costs (row, column, depth) by paths."""
    ratios = evidence.against(known)
    costs = sum_over_paths(_votes(ratios.both, _GATHERED), *_STEP_COSTS)
    index = _refined(gaussian(ratios.both, _REFINED), lowest(costs))
    return moved_edges(index, ratios.own, known.light()), costs


def _votes(evidence: Image, scale: float) -> NDArray[np.float32]:
    """Return costs (row, column, depth): the votes of small windows for depths, gathered.

    A vote is `−ln( ε/n + (1 − ε) P )`, with P the probability of each of n depths by the window's evidence: no window
    outvotes its neighbours.
    """
    votes = gaussian(evidence, _WINDOW)
    votes *= np.float32(4 * np.pi * _WINDOW**2 * _INDEPENDENT)
    votes -= votes.max(axis=2, keepdims=True)
    np.exp(votes, out=votes)
    votes /= votes.sum(axis=2, keepdims=True)
    votes *= 1 - _OUTLIERS
    votes += _OUTLIERS / votes.shape[2]
    np.log(votes, out=votes)
    votes -= votes.mean(axis=2, keepdims=True)
    np.negative(votes, out=votes)
    return gaussian(votes, scale)


def _refined(evidence: Image, start: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return piecewise plane depths near the evidence: a search of each sample and a smoothing of all by turns."""
    surface = PiecewisePlane(start)
    target = np.empty_like(start)
    for distance in _STAGES:
        _search(evidence, surface.values, np.float32(0.5 / distance), target)
        surface.approach(target, 1 / distance, _BEND, _STEPS)
    return np.clip(surface.values, 0, evidence.shape[2] - 1)


@compiled
def _search(evidence, values, stiffness, target):  # type: ignore[no-untyped-def]
    """Set `target` to the depth of most evidence less `stiffness` times its squared distance from `values`."""
    rows, columns, depths = evidence.shape
    for i in range(rows):
        for j in range(columns):
            best, at = np.float32(-1e30), 0
            for z in range(depths):
                value = evidence[i, j, z] - stiffness * (np.float32(z) - values[i, j]) ** 2
                if value > best:
                    best, at = value, z
            at = min(max(at, 1), depths - 2)
            before = evidence[i, j, at - 1] - stiffness * (np.float32(at - 1) - values[i, j]) ** 2
            here = evidence[i, j, at] - stiffness * (np.float32(at) - values[i, j]) ** 2
            after = evidence[i, j, at + 1] - stiffness * (np.float32(at + 1) - values[i, j]) ** 2
            bend, offset = before - 2 * here + after, np.float32(0)
            if bend < 0:
                offset = min(max(np.float32(0.5) * (before - after) / bend, np.float32(-0.5)), np.float32(0.5))
            target[i, j] = np.float32(at) + offset


def equal_steps(views: PinholeViews, far: float, near: float) -> NDArray[np.float64]:
    """Return the 1/depth (depth,) to compare, ascending from `far` to `near`."""
    moved = (near - far) * float(views.reach.max())
    count = int(np.clip(np.ceil(moved / _SAMPLES_PER_STEP) + 1, _MIN_DEPTHS, _MAX_DEPTHS))
    return np.linspace(far, near, count)


def found_range(views: PinholeViews, far: float, near: float) -> tuple[float, float]:
    """Return the range of 1/depth between far and near in which the views show anything.

    Raises
    ------
    NothingInFocus
        The views agree on nothing.
    """
    coarse = views.binned(_BINS if np.prod(views.grid.shape) > _FEW_SAMPLES else 1)
    limits = (far, near)
    for _ in range(_SEARCHES):
        depths = equal_steps(coarse, far, near)
        evidence = DepthEvidence(coarse, depths, halves(coarse.nodes))
        index, costs = next_depths(evidence, evidence.explained(first_depths(evidence)))
        likely = confidence(index, costs, depths, explained_share(evidence, index), None) >= _LIKELY
        if np.count_nonzero(likely) < _MIN_SAMPLES:
            needed = _MIN_SAMPLES / likely.size
            raise NothingInFocus(
                f"depths are clear in {likely.mean():.1%} of the picture, and must be in {needed:.1%}; "
                "use more light or views"
            )
        first, last = np.quantile(index[likely], _QUANTILES)
        margin = _MARGIN * (last - first) + _MARGIN_STEPS
        before, step = near - far, depths[1] - depths[0]
        far, near = depths[0] + step * (first - margin), depths[0] + step * (last + margin)
        far, near = max(far, limits[0]), min(near, limits[1])
        if near - far > _SHRUNK_ENOUGH * before:
            break
    return far, near
