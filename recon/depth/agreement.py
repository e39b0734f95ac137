"""How far away each sample is: how well the views agree on it at every depth of a sweep, and what follows from that."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.plane import PlaneOperator
from faintfield.recon.smoothing import blurred
from faintfield.recon.solver.starts import back_projection

# Bins are made so large that the light's power is so many times the variance of a bin's noise.
_LEAST_POWER_RATIO = 2.0
_LEAST_BINS, _MOST_BINS = 2, 32

# What views of one point differ by beside noise (shine, interpolation, poses), as part of the light.
_MODEL_ERROR = 0.04

# One number can contradict the others by so many variances: what hides a point in some views must not decide.
_MOST_SQUARES = 16.0

# Evidence is gathered over a neighbourhood of a standard deviation of about 1.6 samples: 4π σ² of them in effect.
_WINDOW = (1, 2)
_WINDOW_SAMPLES = 4 * np.pi * 2.5

# What a change of depth between neighbours costs, in units of log-likelihood: one step, and any larger change.
_ONE_STEP, _ANY_STEP = 2.0, 12.0

# Fewer views than this part of the best seen agree by chance.
_LEAST_SEEN = 0.3

# Nor is a depth the best that few others were compared with.
_LEAST_COMPARED = 2 / 3

# What is darker than its noise allows to tell, or than a thirtieth of the picture, is as dark as stray light.
_LEAST_LIGHT_SIGMAS, _LEAST_LIGHT = 4.0, 0.03


class Agreement(NamedTuple):
    """What the views say of each sample of a plane (row, column): how they differ, how many see it, and its light.

    `squares` is `Hᵀ[(g − b − H f)²/v]`, which for views that differ by noise alone has the mean s − 1, as χ² has;
    `light` and `light_variance` are those of f, the mean of the views, in e⁻ and e⁻².
    """

    squares: Image
    sensitivity: Image
    light: Image
    light_variance: Image


@dataclass(frozen=True)
class DepthMap:
    """Depths by sample, as fractional numbers of the sweep's planes.

    Attributes
    ----------
    index : float array (row, column)
        The plane, between planes by a parabola; everywhere, also where nothing is known of it.
    confidence : float array (row, column)
        Probability of that depth within a step, or 2 % of the depth, by the likelihood of the views alone; zero where
        no light stands out of the noise, and where the depth is the first or the last of the sweep.
    """

    index: Image
    confidence: Image


def bins_for(operator: PlaneOperator, images: ElementalImages) -> int:
    """Return how many pixels across are to be added up, a power of two, for views to be comparable one by one.

    Where a pixel has less light than noise, no two views can be told to differ, whatever their number; sums of k × k
    pixels have k² times the ratio of power to variance. Chosen such that it is 2 at the typical lit sample. At least
    two pixels: bins of one differ by how they lie between samples.
    """
    light = np.maximum(blurred(back_projection(operator, images), _WINDOW), 0)
    lit_e = float(np.sum(np.square(light, dtype=np.float64)) / max(float(light.sum(dtype=np.float64)), 1e-12))
    variance_e2 = lit_e + float(np.mean(images.background_e)) + float(np.mean(images.read_variance_e2))
    ratio = lit_e**2 / max(variance_e2, 1e-12)
    least = np.sqrt(_LEAST_POWER_RATIO / max(ratio, 1e-12))
    return int(np.clip(2 ** np.ceil(np.log2(max(least, 1.0))), _LEAST_BINS, _MOST_BINS))


def agreement(operator: PlaneOperator, images: ElementalImages) -> Agreement:
    """Return how far the views of a plane's samples are from one common brightness, against each having its own.

    The light that sets the variance v is a smoothed f, the same for all views, so that no view is trusted for being
    dark by chance.
    """
    f = back_projection(operator, images)
    seen, smooth = operator.forward(f), operator.forward(np.maximum(blurred(f, _WINDOW), 0))
    known_e2 = _of_views(operator, images.background_e) + _of_views(operator, images.read_variance_e2)
    variance = smooth + known_e2 + (_MODEL_ERROR * smooth) ** 2
    np.maximum(variance, 1e-6, out=variance)
    squares = images.electrons - seen
    squares -= _of_views(operator, images.background_e)
    np.square(squares, out=squares)
    squares /= variance
    np.minimum(squares, _MOST_SQUARES, out=squares)
    sensitivity = operator.sensitivity()
    light_variance = operator.adjoint(variance) / np.maximum(operator.coverage(), 1e-6) ** 2
    return Agreement(operator.adjoint(squares), sensitivity, f, light_variance)


def depth_map(planes: list[Agreement], depths_mm: NDArray[np.floating]) -> DepthMap:
    """Return the depths of which the views are most likely, regularised.

    With differences between views of variance τ² in units of the noise, the log-likelihood of "each its own" against
    "one common brightness" is `½ χ² τ²/(1 + τ²)` but for terms that are alike at all depths. τ² is what the worst depth
    shows: where views agree at every depth it is zero, and nothing is said. Neighbours are gathered with a small
    window; `_regularised` then chooses among neighbours' depths.
    """
    evidence, comparable = _evidence(planes)
    best = _regularised(evidence).argmax(axis=0)
    posterior = np.exp(evidence - evidence.max(axis=0))
    posterior /= posterior.sum(axis=0)
    chosen = depths_mm[best]
    step = np.abs(np.gradient(depths_mm))[best]
    near = np.abs(depths_mm[:, np.newaxis, np.newaxis] - chosen) <= np.maximum(1.01 * step, 0.02 * chosen)
    confidence = np.where(near, posterior, 0).sum(axis=0)
    within = (best > 0) & (best < len(planes) - 1)  # what is likeliest at an end may lie beyond it
    confidence[~(within & comparable & _lit(planes, best))] = 0
    return DepthMap(_refined(evidence, best).astype(np.float32), confidence.astype(np.float32))


def _of_views(operator: PlaneOperator, value: float | Image) -> float | Image:
    """Return a number, or a map (lattice, row, column), for all views."""
    if np.ndim(value) == 0:
        return float(value)
    return np.asarray(np.broadcast_to(value, operator.maps_shape))[operator.lattice_of_view]


def _evidence(planes: list[Agreement]) -> tuple[Image, NDArray[np.bool_]]:
    """Return the log-likelihood (plane, row, column) of each depth, and which samples are seen at most depths."""
    squares = np.stack([blurred(plane.squares, _WINDOW) for plane in planes])
    sensitivity = np.stack([blurred(plane.sensitivity, _WINDOW) for plane in planes])
    most = sensitivity.max(axis=0)
    seen = (sensitivity > _LEAST_SEEN * sensitivity.max()) & (most > 2)
    # Per view, or the depths that more views see would be blamed for all that these see
    reduced = np.divide(squares, sensitivity - 1, out=np.full_like(squares, np.nan), where=seen & (sensitivity > 1.5))
    worst = np.nanmax(np.where(np.isnan(reduced), 0, reduced), axis=0)
    spread = np.maximum(worst - 1, 0)
    evidence = -0.5 * reduced * most * spread / (1 + spread) * _WINDOW_SAMPLES
    # A depth that too few views see is as likely as it would be on average
    mean = np.nan_to_num(np.nansum(evidence, axis=0) / np.maximum(np.sum(~np.isnan(evidence), axis=0), 1))
    return np.where(np.isnan(evidence), mean, evidence).astype(np.float32), seen.mean(axis=0) > _LEAST_COMPARED


def _regularised(evidence: Image) -> Image:
    """Return the evidence with that of all samples along four straight ways to each, as in semi-global matching.

    Along a way, the best that samples up to this one can do is `L(p, z) = e(p, z) + max(L(q, z), L(q, z ± 1) − P₁,
    max L(q) − P₂)`, with q the sample before p (Hirschmüller 2008).
    """
    total = np.zeros_like(evidence)
    for axis in (1, 2):
        along = np.moveaxis(evidence, axis, 0)
        for direction in (1, -1):
            ways = np.empty_like(along)
            before = np.zeros_like(along[0])
            for index in range(len(along))[::direction]:
                top = before.max(axis=0)
                reached = np.maximum(before, top - _ANY_STEP)
                reached[1:] = np.maximum(reached[1:], before[:-1] - _ONE_STEP)
                reached[:-1] = np.maximum(reached[:-1], before[1:] - _ONE_STEP)
                before = along[index] + reached - top
                ways[index] = before
            total += np.moveaxis(ways, 0, axis)
    return total


def _refined(evidence: Image, best: NDArray[np.intp]) -> Image:
    """Return the top of the parabola through each best plane and its neighbours, in planes."""
    inner = np.clip(best, 1, len(evidence) - 2)
    before, at, after = (np.take_along_axis(evidence, (inner + k)[np.newaxis], 0)[0] for k in (-1, 0, 1))
    bend = before - 2 * at + after
    top = np.divide(before - after, 2 * bend, out=np.zeros_like(bend), where=bend < 0)
    return np.where(inner == best, best + np.clip(top, -0.5, 0.5), best)


def _lit(planes: list[Agreement], best: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which samples have light that stands out of the noise at their depth."""
    light, variance = (
        np.take_along_axis(np.stack([getattr(plane, name) for plane in planes]), best[np.newaxis], 0)[0]
        for name in ("light", "light_variance")
    )
    level = np.sqrt(np.mean(np.square(np.maximum(light, 0), dtype=np.float64)))
    return np.asarray((light > _LEAST_LIGHT_SIGMAS * np.sqrt(variance)) & (light > _LEAST_LIGHT * level))
