"""The standard deviation of each sample of a penalised plane."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator.occlusion import opacity
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.smoothing import blurred
from faintfield.recon.solver.data_fit import DataFit
from faintfield.recon.solver.initialization import well_seen_samples
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.pmlem import norm
from faintfield.recon.solver.proximal import DualField

# Draws of the noise as it is, and size of the small change that gives the derivative.
_DRAWS, _SMALL_CHANGE = 4, 0.2

# Proximal steps of each answer; error of a step relative to its change and to the plane, and limit on its inner steps.
_STEPS, _OF_CHANGE, _OF_PLANE, _MAX_INNER_STEPS = 3, 0.1, 3e-3, 300

# What is known of the squared error relative to the mean square answer before it is measured, and its least value.
_USUAL_RATIO, _DOUBT, _LEAST_RATIO = 1.1, 0.6, 1.0

# Deviations of the ratio that are added to it.
_CAUTION = 0.5

# What is added to the usual ratio of small objects: the weight that predicts best suits their dark surroundings.
_FOR_SMALL_OBJECTS = 0.9

# Blurs of the square answer, and weights of the two and of its mean over the region.
_NARROW, _WIDE = (1, 2, 4), (1, 2, 4, 8, 8, 16)
_OF_NARROW, _OF_WIDE, _OF_MEAN = 0.3, 0.5, 0.2

# Least variance, relative to that of a sample without penalty.
_LEAST_VARIANCE = 1e-4

# Keeps quotients finite.
_TINY = 1e-30

# Least part of alternating samples that HᵀH is taken to leave.
_LEAST_ALTERNATION = 0.01


@dataclass(frozen=True)
class LocalFit:
    """What the views say of a plane near its optimum: all that σ needs of them.

    Attributes
    ----------
    plane, metric, gradient : float array (row, column)
        f at its optimum, W > 0 and ∇L there.
    noise_share : float array (row, column)
        Variance of the gradient by the noise of the data, divided by W; zero where hardly a view sees anything.
    alternation : (float, float)
        What HᵀH leaves of samples that alternate in sign along rows (down) and columns (right), relative to constant
        ones.
    """

    plane: Image
    metric: Image
    gradient: Image
    noise_share: Image
    alternation: tuple[float, float]


def local_fits(operator: SceneOperator, fit: DataFit, samples: Image) -> list[LocalFit]:
    """Return the local fit of each plane as if the others were known, in one pass over the data and some without them.

    Samples are coupled with their eight neighbours only. The signs `z` of four patterns, constant or alternating along
    rows and columns, therefore give the diagonal of HᵀH exactly, as the mean of `z · HᵀH z`.

    Parameters
    ----------
    operator : SceneOperator
        H.
    fit : DataFit
        L of all views.
    samples : float array (samples)
        f at its optimum, in electrons.
    """
    gradients = operator.planes_of(fit.value_and_gradient(samples)[1])
    found = []
    for index, (plane, metric) in enumerate(zip(operator.planes_of(samples), fit.metric_of_each(samples), strict=True)):
        constant, *others = _coupling(operator, index)
        seen = well_seen_samples(constant)
        share = np.zeros_like(plane)
        np.divide(constant + sum(others), 4 * constant, out=share, where=seen)
        down, right, _ = (float(other[seen].sum() / constant[seen].sum()) for other in others)
        found.append(LocalFit(plane, metric, gradients[index], share, (down, right)))
    return found


def standard_deviation(local: LocalFit, weight: float, penalty: Penalty, generator: np.random.Generator) -> Image:
    """Return the standard deviation (row, column) of a plane in electrons: the root of its expected squared error.

    The plane is solved again from data with added noise of the size that they have already, on the quadratic that L is
    near the optimum. Where the weight predicts best, the mean square of these answers V is about the squared error,
    what the penalty removed included. How much they differ is measured: Stein's unbiased estimate of
    `|K(f − truth)|²` is compared with `|K answer|²`, where K is HᵀH divided by its row sums, on opaque samples and
    beside them, and weighted against the usual ratio. What the error has beyond the usual ratio is the contrast that
    the penalty removed; it is spread evenly, because it is not where the answers are.

    Without a penalty, the variance is 1/W.

    Parameters
    ----------
    local : LocalFit
        The plane, and what the views say of it.
    weight, penalty : float, Penalty
        β ≥ 0 of the optimum, and φ.
    generator : Generator
        Random generator of the noise.
    """
    if weight == 0 or penalty.name == "none":
        return np.asarray(1 / np.sqrt(local.metric), local.plane.dtype)
    problem = _LocalProblem(local, weight, penalty)
    answers = [problem.answer(problem.noise(generator)) for _ in range(_DRAWS)]
    squares = _mean([np.square(answer) for answer in answers])
    seen_squares = _mean([np.square(problem.as_seen(answer)) for answer in answers])
    errors = _stein_errors(problem, local, generator)
    variance = np.zeros_like(squares)
    local_part = np.zeros_like(squares)
    for region, seen, usual in _regions(local):
        noise_variance = local.noise_share[seen] / local.metric[seen]
        ratio, excess = _ratio_and_excess(errors[seen], seen_squares[seen], noise_variance, local.alternation, usual)
        local_part[region] = ratio * squares[region]
        mean = float(squares[seen if seen.any() else region].mean(dtype=np.float64))
        level = float(seen_squares[seen].mean(dtype=np.float64)) if seen.any() else 0.0
        variance[region] = _OF_MEAN * ratio * mean + excess * (mean / level if level > 0 else 1.0)
    variance += np.float32(_OF_NARROW) * blurred(local_part, _NARROW)
    variance += np.float32(_OF_WIDE) * blurred(local_part, _WIDE)
    return np.asarray(np.sqrt(np.maximum(variance, _LEAST_VARIANCE / local.metric)), local.plane.dtype)


class _LocalProblem:
    """The optimum for changed data, from the quadratic of L near f: no pass over the data.

    L is taken for `½ (x − f)ᵀ √W K √W (x − f) + ∇L(f)·(x − f)`, and K for a blur of three samples along rows and
    columns that leaves of alternating samples what HᵀH leaves.
    """

    def __init__(self, local: LocalFit, weight: float, penalty: Penalty) -> None:
        self._plane, self._metric, self._gradient = (
            np.ascontiguousarray(array, np.float32) for array in (local.plane, local.metric, local.gradient)
        )
        self._weight, self._penalty = weight, penalty
        self._alternation = np.clip(local.alternation, _LEAST_ALTERNATION, 1)
        self._root, self._size = np.sqrt(self._metric), norm(self._plane, self._metric)
        start = DualField.zero([self._plane.shape], self._plane.dtype)
        self._optimum, self._dual = self._solved(np.zeros_like(self._plane), self._plane, start)

    def as_seen(self, x: Image) -> Image:
        """Return K x."""
        return _three_sample_blur(x, self._alternation)

    def noise(self, generator: np.random.Generator) -> Image:
        """Return a draw of the noise of −∇L, of covariance `√W K √W`."""
        white = generator.standard_normal(self._plane.shape, np.float32)
        return self._root * _three_sample_blur(white, np.sqrt(self._alternation))

    def answer(self, change: Image) -> Image:
        """Return by how much the optimum changes if −∇L changes."""
        return self._solved(change, self._optimum, self._dual)[0] - self._optimum

    def _solved(self, change: Image, x: Image, dual: DualField) -> tuple[Image, DualField]:
        """Return the optimum and its dual field, starting from x and another field, by proximal steps."""
        dual = dual.copy()
        for _ in range(_STEPS):
            slope = self._root * self.as_seen(self._root * (x - self._plane)) + self._gradient - change
            x = self._step(x, x - slope / self._metric, dual)
        return x, dual

    def _step(self, before: Image, point: Image, dual: DualField) -> Image:
        """Return the plane nearest to a point under the penalty; the dual field becomes its own."""

        def gap_tolerance(x: Image) -> float:
            moved = norm(x - before, self._metric)
            return 0.5 * max(_OF_CHANGE * moved, _OF_PLANE * self._size) ** 2

        return dual.prox(point, self._metric, self._weight, self._penalty, gap_tolerance, _MAX_INNER_STEPS).plane


def _stein_errors(problem: _LocalProblem, local: LocalFit, generator: np.random.Generator) -> Image:
    """Return an unbiased estimate (row, column) of `|K(f − truth)|²`, of much noise: it counts on average only.

    With the residual `q = −∇L/W = K(truth − f) + ν`, it is `q² − Var ν + 2 ν · K(∂f/∂ν) ν` (Stein 1981), the derivative
    by a small change along one draw of ν (Ramani, Blu and Unser 2008).
    """
    noise = problem.noise(generator)
    derivative = problem.answer(np.float32(_SMALL_CHANGE) * noise) / np.float32(_SMALL_CHANGE)
    covariance = noise / local.metric * problem.as_seen(derivative)
    return np.asarray(np.square(local.gradient / local.metric) - local.noise_share / local.metric + 2 * covariance)


def _ratio_and_excess(
    errors: Image, squares: Image, noise_variance: Image, alternation: tuple[float, float], usual: float
) -> tuple[float, float]:
    """Return the squared error of a region relative to its answers, up to 1.1, and what it has beyond that.

    The squared error is the mean of the measured and of the usual, by their variances, plus half the deviation of that
    mean, since a σ that is too small does more harm. It is no less than the measured surely is: if the penalty leaves
    nothing, there are no answers either. The variance of the measured is nearly that of the mean of q², of correlated
    noise.
    """
    if not errors.size:
        return _USUAL_RATIO, 0.0
    level, measured, of_noise = (float(x.mean(dtype=np.float64)) for x in (squares, errors, noise_variance))
    correlation = np.prod([1 + 2 * ((1 - k) / (2 + 2 * k)) ** 2 for k in alternation])
    deviation = float(np.sqrt(2 * correlation / errors.size)) * of_noise
    trust = (_DOUBT * level) ** 2 / max((_DOUBT * level) ** 2 + deviation**2, _TINY)
    weighted = trust * measured + (1 - trust) * usual * level + _CAUTION * np.sqrt(trust) * deviation
    expected = max(_LEAST_RATIO * level, float(weighted), measured - 2 * deviation)
    ratio = min(expected / max(level, _TINY), _USUAL_RATIO)
    return ratio, max(expected - _USUAL_RATIO * level, 0.0)


def _regions(local: LocalFit) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.bool_], float]]:
    """Yield the opaque samples and those beside them, each with those that views see, and the usual ratio there."""
    opaque, visible = opacity(local.plane) > 0.5, local.noise_share > 0
    beside = float(np.mean(~opaque[visible])) if visible.any() else 0.0
    for region, usual in ((opaque, _USUAL_RATIO + _FOR_SMALL_OBJECTS * beside), (~opaque, _USUAL_RATIO)):
        if region.any():
            yield region, region & visible, usual


def _coupling(operator: SceneOperator, index: int) -> Iterator[Image]:
    """Yield `z · HᵀH z` (row, column) of one plane, for z constant, alternating down, right, and both."""
    for down, right in ((1, 1), (-1, 1), (1, -1), (-1, -1)):
        samples = np.zeros(operator.samples_shape, operator.dtype)
        z = operator.planes_of(samples)[index]
        rows, columns = (np.arange(length) % 2 == 0 for length in z.shape)
        z[:] = np.where(rows, 1, down)[:, np.newaxis] * np.where(columns, 1, right)
        yield z * operator.planes_of(operator.adjoint_of_forward(samples))[index]


def _three_sample_blur(image: Image, alternation: NDArray[np.floating]) -> Image:
    """Return an image blurred by (t, 1, t)/(1 + 2t) along both axes; leaves `alternation` of alternating samples."""
    for axis, left in enumerate(alternation.tolist()):
        t = (1 - left) / (2 + 2 * left)
        along = np.moveaxis(image, axis, 0)
        ends = np.pad(along, [(1, 1), (0, 0)], "edge")
        mean = (along + image.dtype.type(t) * (ends[:-2] + ends[2:])) * image.dtype.type(1 / (1 + 2 * t))
        image = np.moveaxis(mean, 0, axis)
    return np.ascontiguousarray(image)


def _mean(planes: list[Image]) -> Image:
    """Return the mean of planes."""
    return np.asarray(sum(planes) / np.float32(len(planes)))
