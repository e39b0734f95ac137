"""Depth and light of a surface by turns: the depth given the light, then the light given the depth."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.numba_tools import compiled
from faintfield.recon.surface.evidence import DepthEvidence
from faintfield.recon.surface.generalized_variation import PiecewisePlane
from faintfield.recon.surface.paths import lowest, sum_over_paths

# Rounds of depth and light.
_ROUNDS = 4

# The depth of a small window is that of its neighbours with this probability of being another one.
_OUTLIERS = 0.3

# Scales of windows in samples: the small one, and the one that its votes are gathered over.
_WINDOW, _GATHERED = 1.5, 4.0

# Share of the evidence of a window that is independent: samples of a denoised picture are not.
_INDEPENDENT = 0.3

# Costs of paths: one step, any step.
_ONE_STEP, _ANY_STEP = 0.5, 4.0

# α₁ and α₀ of total generalised variation, per step of depth; scale of its window; its stages and steps.
_BEND, _REFINED, _STEPS = (0.05, 0.3), 3.0, 60
_STAGES = (100.0, 50.0, 25.0, 12.0, 6.0, 3.0)


@dataclass(frozen=True)
class Surface:
    """Depths as fractional index of a sweep (row, column), and the evidence they were chosen by (row, column, depth)."""

    index: NDArray[np.float32]
    evidence: Image


def estimate_surface(evidence: DepthEvidence, rounds: int = _ROUNDS) -> Surface:
    """Return the surface that explains the views best."""
    ratios = evidence.against(None)
    index = lowest(sum_over_paths(_votes(ratios, 6.0), 1.0, 10.0))
    for _ in range(rounds):
        ratios = evidence.against(index)
        chosen = lowest(sum_over_paths(_votes(ratios, _GATHERED), _ONE_STEP, _ANY_STEP))
        index = _refined(_gathered(ratios, _REFINED), chosen)
    return Surface(index, ratios)


def _gathered(volume: Image, scale: float) -> Image:
    """Return a volume (row, column, depth) blurred over rows and columns."""
    return np.stack([cv2.GaussianBlur(np.ascontiguousarray(volume[:, :, z]), (0, 0), scale) for z in range(volume.shape[2])], 2)


def _votes(evidence: Image, scale: float) -> NDArray[np.float32]:
    """Return costs (row, column, depth): the votes of small windows for depths, gathered.

    A vote is `−ln( ε/n + (1 − ε) P )`, with P the probability of each of n depths by the window's evidence: no window,
    however bright its detail, outvotes its neighbours.
    """
    votes = _gathered(evidence, _WINDOW) * np.float32(4 * np.pi * _WINDOW**2 * _INDEPENDENT)
    votes -= votes.max(axis=2, keepdims=True)
    np.exp(votes, out=votes)
    votes /= votes.sum(axis=2, keepdims=True)
    votes *= 1 - _OUTLIERS
    votes += _OUTLIERS / votes.shape[2]
    np.log(votes, out=votes)
    votes -= votes.mean(axis=2, keepdims=True)
    return np.ascontiguousarray(-_gathered(votes, scale))


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
