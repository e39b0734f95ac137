"""Depth and light of a surface by turns: the depth given the light, then the light given the depth."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.numba_tools import compiled
from faintfield.recon.solver.cross_validation import MIN_VIEWS, validation_views
from faintfield.recon.surface.confidence import confidence
from faintfield.recon.surface.edges import moved_edges
from faintfield.recon.surface.evidence import DepthEvidence, Explained, Halves
from faintfield.recon.surface.generalized_variation import PiecewisePlane
from faintfield.recon.surface.paths import lowest, sum_over_paths
from faintfield.recon.surface.pinhole_views import UNKNOWN, PinholeViews

# Rounds of depth and light at most; the last is one more, with all views.
_MAX_ROUNDS = 3

# Fewest views of which some are left out to judge the rounds: both halves of the others must find depths.
_MIN_JUDGED = 2 * MIN_VIEWS

# The depth of a small window is that of its neighbours with this probability of being another one.
_OUTLIERS = 0.3

# Scales of windows in samples: the small one, the one that its votes are gathered over, and that of the first round.
_WINDOW, _GATHERED, _GATHERED_AT_FIRST = 1.5, 4.0, 6.0

# Share of the evidence of a window that is independent: samples of a denoised picture are not.
_INDEPENDENT = 0.3

# Costs of paths: one step, any step; and those of the first round.
_STEP_COSTS, _STEP_COSTS_AT_FIRST = (0.5, 4.0), (1.0, 10.0)

# α₁ and α₀ of total generalised variation, per step of depth; scale of its window; its stages and steps.
_BEND, _REFINED, _STEPS = (0.05, 0.3), 3.0, 60
_STAGES = (100.0, 50.0, 25.0, 12.0, 6.0, 3.0)


@dataclass(frozen=True)
class SurfaceEstimate:
    """The depth of each sample.

    Attributes
    ----------
    inverse_depth : float array (row, column)
        1/depth.
    confidence : float array (row, column)
        Probability that the depth is right within 2 %.
    rounds : int
        Rounds of depth and light that the views left out asked for, and one with all views.
    left_out : int array (view,)
        The views that judged the rounds.
    deviances : list of float
        Deviance per pixel of these views after each round.
    """

    inverse_depth: NDArray[np.float64]
    confidence: NDArray[np.float32]
    rounds: int
    left_out: NDArray[np.intp]
    deviances: list[float]


def estimate_surface(views: PinholeViews, inverse_depths: NDArray[np.float64], odd: NDArray[np.bool_]) -> SurfaceEstimate:
    """Return the surface that explains the views best.

    The rounds are done without some of the views, and end when these are no longer predicted better.

    Parameters
    ----------
    views : PinholeViews
        The views.
    inverse_depths : float array (depth,)
        The 1/depth to choose from, ascending in equal steps.
    odd : bool array (view,)
        One of two halves of the views that look from all over the aperture: a checkerboard of the nodes.
    """
    everything = np.arange(len(odd))
    left_out = validation_views(len(odd)) if len(odd) >= _MIN_JUDGED else everything[:0]
    evidence = DepthEvidence(views, inverse_depths, _halves(np.setdiff1d(everything, left_out), odd))
    first = sum_over_paths(_votes(evidence.at_first(), _GATHERED_AT_FIRST), *_STEP_COSTS_AT_FIRST)
    best, index, deviances = lowest(first), lowest(first), list[float]()
    for _ in range(_MAX_ROUNDS):
        known = evidence.explained(index)
        if left_out.size:
            deviances.append(prediction_deviance(evidence, known, left_out))
            if deviances[-1] > min(deviances):
                break
        best = index
        index = _next(evidence, known)[0]
    final = DepthEvidence(views, inverse_depths, _halves(everything, odd))
    index, costs = _next(final, final.explained(best if left_out.size else index))
    sure = confidence(index, costs, inverse_depths)
    depths = np.interp(index, np.arange(len(inverse_depths)), inverse_depths)
    return SurfaceEstimate(depths, sure, len(deviances) + 1, left_out, deviances)


def prediction_deviance(evidence: DepthEvidence, known: Explained, views: NDArray[np.intp]) -> float:
    """Return the mean squared error of the pixels of views under a surface and its light, over their variance."""
    expected = known.operator.forward(known.light(), views)
    pictures = evidence.views.light_e[views]
    seen = (known.operator.inverse_depth_of_pixels()[views] > 0) & (pictures > UNKNOWN)
    variance = np.maximum(expected, 0) + np.float32(evidence.views.variance_e2)
    return float(np.mean((np.square(pictures - expected) / np.maximum(variance, 1e-6))[seen], dtype=np.float64))


def _halves(views: NDArray[np.intp], odd: NDArray[np.bool_]) -> Halves:
    """Return the two halves of some views."""
    return Halves(views[~odd[views]], views[odd[views]])


def _next(evidence: DepthEvidence, known: Explained) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the depths given a surface's light, as fractional index, and the costs (row, column, depth) by paths."""
    ratios = evidence.against(known)
    costs = sum_over_paths(_votes(ratios.both, _GATHERED), *_STEP_COSTS)
    index = _refined(_gathered(ratios.both, _REFINED), lowest(costs))
    return moved_edges(index, ratios.own, known.light()), costs


def _gathered(volume: Image, scale: float) -> NDArray[np.float32]:
    """Return a volume (row, column, depth) blurred over rows and columns."""
    return np.asarray(cv2.GaussianBlur(volume, (0, 0), scale), np.float32)


def _votes(evidence: Image, scale: float) -> NDArray[np.float32]:
    """Return costs (row, column, depth): the votes of small windows for depths, gathered.

    A vote is `−ln( ε/n + (1 − ε) P )`, with P the probability of each of n depths by the window's evidence: no window,
    however bright its detail, outvotes its neighbours.
    """
    votes = _gathered(evidence, _WINDOW)
    votes *= np.float32(4 * np.pi * _WINDOW**2 * _INDEPENDENT)
    votes -= votes.max(axis=2, keepdims=True)
    np.exp(votes, out=votes)
    votes /= votes.sum(axis=2, keepdims=True)
    votes *= 1 - _OUTLIERS
    votes += _OUTLIERS / votes.shape[2]
    np.log(votes, out=votes)
    votes -= votes.mean(axis=2, keepdims=True)
    np.negative(votes, out=votes)
    return _gathered(votes, scale)


def _refined(evidence: Image, start: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return piecewise plane depths near the evidence: a search of each sample and a smoothing of all by turns."""
    surface = PiecewisePlane.start(start)
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
