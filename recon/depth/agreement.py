"""The depth of each sample, by the agreement of the views at every depth of a sweep, and a test against chance."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.blur import blurred
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.solver.initialization import back_projection

# Smallest ratio of the light's power to the variance of a bin's noise, and smallest and largest bins in pixels.
_MIN_POWER_RATIO, _MIN_BINS, _MAX_BINS = 2.0, 2, 32

# Relative difference between views of one point beyond noise (shine, interpolation, poses), and largest squared
# deviation of one number, in variances: an object that hides a point in a few views must not decide.
_MODEL_ERROR, _MAX_SQUARES = 0.04, 16.0

# Spacings of the blur that gathers evidence, of standard deviation σ of about 1.6 samples, and its effective 4π σ².
_WINDOW = (1, 2)
_WINDOW_SAMPLES = 4 * np.pi * 2.5

# Cost of a change of depth between neighbours in units of log-likelihood: of one step, and of any larger change.
_ONE_STEP, _ANY_STEP = 2.0, 12.0

# Smallest number of views relative to that of the best seen samples, or to all views in a test of significance: fewer
# views agree by chance.
_MIN_SEEN = 0.3

# Smallest fraction of the depths that must be comparable: the best of a few depths says little.
_MIN_COMPARED = 2 / 3

# Smallest light, in standard deviations of its noise and relative to the picture's level: less may be stray light.
_MIN_LIGHT_SIGMAS, _MIN_LIGHT = 4.0, 0.03

# Statistics closer than this, relative to their size, are equal: sums of the same numbers in another order.
_EQUAL = 1e-5


class Agreement(NamedTuple):
    """Agreement of the views on each sample of a plane (row, column), their number, and the light.

    `squares` is `Hᵀ[(g − b − H f)²/v]`, whose mean is s − 1 if the views differ by noise alone, like that of χ²;
    `light` and `light_variance` are the mean of the views, f, and its variance, in e⁻ and (e⁻)².
    """

    squares: Image
    sensitivity: Image
    light: Image
    light_variance: Image


@dataclass(frozen=True)
class DepthEstimate:
    """Depth of each sample, as a fractional index of the sweep's planes.

    Attributes
    ----------
    index, confidence : float array (row, column)
        The plane, interpolated by a parabola, even where nothing is known; and the probability that the depth is right
        within a step or 2 % of the depth, from the likelihood of the views alone: zero where no light stands out of the
        noise, and where the depth is the first or last of the sweep.
    lit_share : float
        Share of the samples whose light stands out of the noise.
    """

    index: Image
    confidence: Image
    lit_share: float


def bins_for(operator: SceneOperator, images: ElementalImages) -> int:
    """Return the size of bins of pixels, a power of two, that makes single views comparable.

    Sums of k × k pixels have k² times a pixel's ratio of power to variance; the bins make it 2 at a typical lit sample.
    They are at least two pixels wide: single pixels differ by their positions between samples.
    """
    light = np.maximum(blurred(back_projection(operator, images), _WINDOW), 0)
    lit_e = float(np.sum(np.square(light, dtype=np.float64)) / max(float(light.sum(dtype=np.float64)), 1e-12))
    variance_e2 = lit_e + float(np.mean(images.background_e)) + float(np.mean(images.read_variance_e2))
    ratio = lit_e**2 / max(variance_e2, 1e-12)
    wanted = np.sqrt(_MIN_POWER_RATIO / max(ratio, 1e-12))
    return int(np.clip(2 ** np.ceil(np.log2(max(wanted, 1.0))), _MIN_BINS, _MAX_BINS))


def agreement(operator: SceneOperator, images: ElementalImages) -> Agreement:
    """Return how much the views of each sample differ from a common brightness.

    The variance v follows from a smoothed f, so that no view counts more because it is dark by chance.
    """
    sensitivity, coverage = operator.sensitivity(), operator.coverage()
    f = back_projection(operator, images, coverage=coverage)
    seen, smooth = operator.forward(f), operator.forward(np.maximum(blurred(f, _WINDOW), 0))
    background_e, read_variance_e2 = (
        operator.map_of_views(value, operator.all_views) for value in (images.background_e, images.read_variance_e2)
    )
    variance = smooth + (background_e + read_variance_e2) + (_MODEL_ERROR * smooth) ** 2
    np.maximum(variance, 1e-6, out=variance)
    squares = images.electrons - seen
    squares -= background_e
    np.square(squares, out=squares)
    squares /= variance
    np.minimum(squares, _MAX_SQUARES, out=squares)
    light_variance = operator.adjoint(variance) / np.maximum(coverage, 1e-6) ** 2
    return Agreement(operator.adjoint(squares), sensitivity, f, light_variance)


def depth_map(planes: list[Agreement], depths_mm: Image) -> DepthEstimate:
    """Return the depths that make the views most likely, regularised (`depths_mm` are those of the planes).

    If the brightness of views differs with variance τ² in units of the noise, the log-likelihood ratio of "each its
    own" to "one common brightness" is `½ χ² τ²/(1 + τ²)`, up to terms equal at all depths. τ² is taken from the worst
    depth: where views agree at every depth it is zero. Evidence is averaged over a small window; `_regularised` then
    chooses consistent depths of neighbours.
    """
    evidence, comparable = _evidence(planes)
    best = _regularised(evidence).argmax(axis=0)
    posterior = np.exp(evidence - evidence.max(axis=0))
    posterior /= posterior.sum(axis=0)
    chosen = depths_mm[best]
    step = np.abs(np.gradient(depths_mm))[best]
    near = np.abs(depths_mm[:, np.newaxis, np.newaxis] - chosen) <= np.maximum(1.01 * step, 0.02 * chosen)
    confidence = np.where(near, posterior, 0).sum(axis=0)
    # The depth may lie beyond the sweep, unless that ends less than half a step of 1/depth before infinity
    before, last = 1 / depths_mm[-2:]
    within = (best > 0) & ((best < len(planes) - 1) | (last < 0.5 * (before - last)))
    lit = _lit(planes, best)
    confidence[~(within & comparable & lit)] = 0
    return DepthEstimate(_refined(evidence, best).astype(np.float32), confidence.astype(np.float32), float(lit.mean()))


def _evidence(planes: list[Agreement]) -> tuple[Image, NDArray[np.bool_]]:
    """Return the log-likelihood (plane, row, column) of each depth, and which samples are seen at most depths."""
    squares = np.stack([blurred(plane.squares, _WINDOW) for plane in planes])
    sensitivity = np.stack([blurred(plane.sensitivity, _WINDOW) for plane in planes])
    highest = sensitivity.max(axis=0)
    seen = (sensitivity > _MIN_SEEN * sensitivity.max()) & (highest > 2)
    # Per view, or depths that more views see would be penalised for it
    reduced = np.divide(squares, sensitivity - 1, out=np.full_like(squares, np.nan), where=seen & (sensitivity > 1.5))
    worst = np.nanmax(np.where(np.isnan(reduced), 0, reduced), axis=0)
    spread = np.maximum(worst - 1, 0)
    evidence = -0.5 * reduced * highest * spread / (1 + spread) * _WINDOW_SAMPLES
    # A depth that too few views see gets the average likelihood
    mean = np.nan_to_num(np.nansum(evidence, axis=0) / np.maximum(np.sum(~np.isnan(evidence), axis=0), 1))
    return np.where(np.isnan(evidence), mean, evidence).astype(np.float32), seen.mean(axis=0) > _MIN_COMPARED


def _regularised(evidence: Image) -> Image:
    """Return the evidence summed over four straight paths to each sample, as in semi-global matching.

    Along a path, the best evidence of the samples up to this one is `L(p, z) = e(p, z) + max(L(q, z), L(q, z ± 1) − P₁,
    max L(q) − P₂)`, with q the sample before p (Hirschmüller 2008).
    """
    total = np.zeros_like(evidence)
    for axis in (1, 2):
        along = np.moveaxis(evidence, axis, 0)
        for direction in (1, -1):
            paths = np.empty_like(along)
            before = np.zeros_like(along[0])
            for index in range(len(along))[::direction]:
                top = before.max(axis=0)
                reached = np.maximum(before, top - _ANY_STEP)
                reached[1:] = np.maximum(reached[1:], before[:-1] - _ONE_STEP)
                reached[:-1] = np.maximum(reached[:-1], before[1:] - _ONE_STEP)
                before = along[index] + reached - top
                paths[index] = before
            total += np.moveaxis(paths, 0, axis)
    return total


def _refined(evidence: Image, best: NDArray[np.intp]) -> Image:
    inner = np.clip(best, 1, len(evidence) - 2)
    before, at, after = (np.take_along_axis(evidence, (inner + k)[np.newaxis], 0)[0] for k in (-1, 0, 1))
    bend = before - 2 * at + after
    top = np.divide(before - after, 2 * bend, out=np.zeros_like(bend), where=bend < 0)
    return np.where(inner == best, best + np.clip(top, -0.5, 0.5), best)


def _lit(planes: list[Agreement], best: NDArray[np.intp]) -> NDArray[np.bool_]:
    light, variance = (
        np.take_along_axis(np.stack([getattr(plane, name) for plane in planes]), best[np.newaxis], 0)[0]
        for name in ("light", "light_variance")
    )
    level = np.sqrt(np.mean(np.square(np.maximum(light, 0), dtype=np.float64)))
    return np.asarray((light > _MIN_LIGHT_SIGMAS * np.sqrt(variance)) & (light > _MIN_LIGHT * level))


@dataclass(frozen=True)
class Significance:
    """Share of shuffled orders that agree at least as well as the true one.

    Attributes
    ----------
    p_value : float
        (1 + the number of shuffles that agree at least as well) / (1 + shuffles). If places meant nothing, it would be
        α or less in at most a share α of all sets.
    z : float
        By how many standard deviations of the shuffled orders the true one is better than their mean; 0 if it is
        infinite, since views that see nothing together cannot be compared.
    shuffles : int
        Number of shuffles.
    """

    p_value: float
    z: float
    shuffles: int


def disagreement(
    light_e: Image, visible: NDArray[np.bool_], places: NDArray[np.intp], known_variance_e2: float
) -> float:
    """Return the mean over samples of how much the views disagree at the best depth of each.

    It is the least, over the depths, of the squared deviations from the mean of the views per degree of freedom, in
    variances. Of shuffled views the best depth is taken, too.

    Parameters
    ----------
    light_e, visible : float array (place, view, depth, sample), bool array (place, depth, sample)
        Light of each sample in each view if it was taken from each place, and whether the sample is in view from there.
    places : int array (view,)
        The place of each view.
    known_variance_e2 : float
        Variance of a number without that of the light.
    """
    weight = visible[places].astype(np.float32)
    light = light_e[places, np.arange(len(places))]
    views = weight.sum(axis=0)
    mean = np.einsum("vds,vds->ds", light, weight) / np.maximum(views, 1)
    level = np.maximum(mean, 0)
    variance = np.maximum(level + known_variance_e2 + (_MODEL_ERROR * level) ** 2, 1e-6)
    light -= mean
    np.square(light, out=light)
    light /= variance
    np.minimum(light, _MAX_SQUARES, out=light)
    reduced = np.einsum("vds,vds->ds", light, weight) / np.maximum(views - 1, 1)
    least = np.where(views >= max(_MIN_SEEN * len(places), 2), reduced, np.inf).min(axis=0)
    known = np.isfinite(least)
    return float(least[known].mean(dtype=np.float64)) if known.any() else float("inf")


def significance(statistic: float, shuffled: Sequence[float]) -> Significance:
    """Return how a statistic that is small where views agree compares with those of shuffled views.

    Equal values count as agreeing as well: where shuffling changes nothing, p is 1.

    >>> significance(1.0, [2.0, 3.0, 1.0]).p_value
    0.5
    """
    if not np.isfinite(statistic):  # nothing is seen by enough views
        return Significance(1.0, 0.0, len(shuffled))
    values = np.asarray(shuffled, float)
    as_good = int(np.count_nonzero(values <= statistic + _EQUAL * abs(statistic)))
    known = values[np.isfinite(values)]
    z = 0.0
    if known.size:
        z = float((known.mean() - statistic) / max(float(known.std()), _EQUAL * abs(statistic), 1e-30))
    return Significance((1 + as_good) / (1 + len(values)), z, len(values))
