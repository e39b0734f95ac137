"""The standard deviation of each sample of a penalised plane."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.blur import blurred
from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator.occlusion import opacity
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.solver.data_fit import DataFit
from faintfield.recon.solver.initialization import well_seen_samples
from faintfield.recon.solver.penalties import Penalty, differences
from faintfield.recon.solver.pmlem import norm
from faintfield.recon.solver.proximal import DualField

# Draws of the noise, and size of the small change that gives the derivative.
DRAWS, _SMALL_CHANGE = 4, 0.2

# Proximal steps of each answer; error of a step relative to its change and to the plane, and limit on its inner steps.
_STEPS, _OF_CHANGE, _OF_PLANE, _MAX_INNER_STEPS = 3, 0.1, 3e-3, 300

# Deviation of the ratio of squared error and mean square answer from scene to scene; deviations that are added to it.
_DOUBT, _CAUTION = 0.6, 0.5

# Blurs of the square answer, and of the square gradient.
_NARROW, _WIDE, _OF_GRADIENT = (1, 2, 4), (1, 2, 4, 8, 8, 16), (1,)

# Least variance, relative to that of a sample without penalty; least part of alternating samples that HᵀH is taken to
# leave; smallest divisor.
_LEAST_VARIANCE, _LEAST_ALTERNATION, _TINY = 1e-4, 0.01, 1e-30


@dataclass(frozen=True)
class LocalFit:
    """Local model of a plane near its optimum: all that σ needs of the views.

    Attributes
    ----------
    plane, metric, gradient, noise_share : float array (row, column)
        f at its optimum, W > 0 and ∇L there, and the variance of the gradient by the noise of the data, divided by W;
        the last is zero where hardly a view sees anything.
    alternation : (float, float)
        Part that HᵀH leaves of samples that alternate in sign along rows (down) and columns (right).
    """

    plane: Image
    metric: Image
    gradient: Image
    noise_share: Image
    alternation: tuple[float, float]


def local_fits(operator: SceneOperator, fit: DataFit, samples: Image) -> list[LocalFit]:
    """Return the local fit of each plane as if the others were known, given H, L of all views, and f at its optimum.

    Samples are coupled with their eight neighbours only. The signs `z` of four patterns, constant or alternating along
    rows and columns, therefore give the diagonal of HᵀH exactly, as the mean of `z · HᵀH z`.
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


def standard_deviation(
    local: LocalFit,
    weight: float,
    penalty: Penalty,
    generator: np.random.Generator,
    answers_of: "Callable[[LocalProblem], Answers] | None" = None,
) -> Image:
    """Return the standard deviation (row, column) of a plane in electrons: the root of its expected squared error.

    The plane is solved again from data with added noise of the size that they have already, on the quadratic that L is
    near the optimum. Where the weight predicts best, the mean square of these answers is about the squared error. Their
    ratio is measured: Stein's unbiased estimate of `|K(f − truth)|²` is compared with `|K answer|²`, where K is HᵀH
    divided by its row sums, on opaque samples and beside them, and weighted against the usual ratio. The error beyond
    that is the contrast that the penalty removed; it is spread evenly, because it is not where the answers are.

    `weight` and `penalty` are β ≥ 0 of the optimum, and φ. Without a penalty, the variance is 1/W. The answers are
    those of the optimum of likelihood and penalty, unless `answers_of` makes others of the local problem.
    """
    if weight == 0 or penalty.name == "none":
        return np.asarray(1 / np.sqrt(local.metric), local.plane.dtype)
    answers = (answers_of or Answers)(LocalProblem(local, weight, penalty))
    problem, usual = answers.problem, answers.usual
    noises = [problem.noise(generator) for _ in range(DRAWS)]
    size = np.float32(usual.change)
    drawn = [answers(size * noise) / size for noise in noises]
    squares = _mean([np.square(answer) for answer in drawn])
    seen_squares = _mean([np.square(problem.as_seen(answer)) for answer in drawn])
    if usual.change > _SMALL_CHANGE:
        noises = [problem.noise(generator)]
        drawn = [answers(np.float32(_SMALL_CHANGE) * noises[0]) / np.float32(_SMALL_CHANGE)]
    errors = _stein_errors(problem, noises, drawn)
    return _spread(problem.local, usual, squares, seen_squares, errors)


def _spread(local: LocalFit, usual: "UsualErrors", squares: Image, seen_squares: Image, errors: Image) -> Image:
    """Return σ (row, column), from the answers' squares scaled in each region to the error expected there."""
    variance, local_part = np.zeros_like(squares), np.zeros_like(squares)
    weights, slopes = usual.weights, None
    if weights.gradient:
        slopes = blurred(np.square(np.hypot(*differences(local.plane))).astype(squares.dtype), _OF_GRADIENT)
    for region, seen, expected in _regions(local, usual):
        noise_variance = local.noise_share[seen] / local.metric[seen]
        ratio, excess = _ratio_and_excess(errors[seen], seen_squares[seen], noise_variance, local.alternation, expected)
        local_part[region] = ratio * squares[region]
        mean = float(squares[seen if seen.any() else region].mean(dtype=np.float64))
        level = float(seen_squares[seen].mean(dtype=np.float64)) if seen.any() else 0.0
        variance[region] = weights.mean * ratio * mean + excess * (mean / level if level > 0 else 1.0)
        if slopes is not None:
            usual_slope = max(float(slopes[region].mean(dtype=np.float64)), _TINY)
            variance[region] += weights.gradient * ratio * mean / usual_slope * slopes[region]
    variance += np.float32(weights.narrow) * blurred(local_part, _NARROW)
    variance += np.float32(weights.wide) * blurred(local_part, _WIDE)
    return np.asarray(np.sqrt(np.maximum(variance, _LEAST_VARIANCE / local.metric)), local.plane.dtype)


class LocalProblem:
    """The optimum for changed data, from the quadratic of L near f: no pass over the data.

    L is taken for `½ (x − f)ᵀ √W K √W (x − f) + ∇L(f)·(x − f)`, and K for a blur of three samples along rows and
    columns that leaves of alternating samples what HᵀH leaves.
    """

    def __init__(self, local: LocalFit, weight: float, penalty: Penalty) -> None:
        self.local = local
        self.plane, self._metric, self._gradient = (
            np.ascontiguousarray(array, np.float32) for array in (local.plane, local.metric, local.gradient)
        )
        self._weight, self._penalty = weight, penalty
        self._alternation = np.clip(local.alternation, _LEAST_ALTERNATION, 1)
        self._root, self._size = np.sqrt(self._metric), norm(self.plane, self._metric)

    def as_seen(self, x: Image) -> Image:
        """Return K x."""
        return _three_sample_blur(x, self._alternation)

    def noise(self, generator: np.random.Generator) -> Image:
        """Return a draw of the noise of −∇L, of covariance `√W K √W`."""
        white = generator.standard_normal(self.plane.shape, np.float32)
        return self._root * _three_sample_blur(white, np.sqrt(self._alternation))

    def optimum(self, change: Image | None, x: Image, dual: DualField) -> Image:
        """Return the optimum if −∇L changes, by proximal steps from x and a dual field, which becomes its own."""
        for _ in range(_STEPS):
            slope = self._root * self.as_seen(self._root * (x - self.plane)) + self._gradient
            if change is not None:
                slope -= change
            x = self._step(x, x - slope / self._metric, dual)
        return x

    def _step(self, before: Image, point: Image, dual: DualField) -> Image:
        def gap_tolerance(x: Image) -> float:
            moved = norm(x - before, self._metric)
            return 0.5 * max(_OF_CHANGE * moved, _OF_PLANE * self._size) ** 2

        return dual.prox(point, self._metric, self._weight, self._penalty, gap_tolerance, _MAX_INNER_STEPS).plane


class Expected(NamedTuple):
    """Squared error of a region relative to the mean square answer; its excess over `most` is spread evenly."""

    usually: float
    most: float
    least: float


class Weights(NamedTuple):
    """Composition of σ²: the square answers under two blurs, their mean over the region, and the square gradient.

    The last, scaled to the mean of the square answers, is for edges, whose place is more uncertain than answers show.
    """

    narrow: float
    wide: float
    mean: float
    gradient: float = 0.0


@dataclass(frozen=True)
class UsualErrors:
    """Prior knowledge of the squared errors of an estimate.

    Attributes
    ----------
    change : float
        Size of the noise that is added to see the answers, relative to that of the data.
    opaque, beside, weights : Expected, Expected, Weights
        On opaque samples and beside them; their spread over a region.
    for_small_objects : float
        Addition to the usual ratio of opaque samples, times the part of the plane that is dark.
    """

    change: float
    opaque: Expected
    beside: Expected
    weights: Weights
    for_small_objects: float = 0.0


class Answers:
    """Changes of an estimate if −∇L changes; here of the optimum of likelihood and penalty."""

    # Small objects: the weight that predicts best suits their dark surroundings.
    usual = UsualErrors(1.0, Expected(1.1, 1.1, 1.0), Expected(1.1, 1.1, 1.0), Weights(0.3, 0.5, 0.2), 0.9)

    def __init__(self, problem: LocalProblem) -> None:
        self.problem = problem
        self._dual = DualField.zero([problem.local.plane.shape], np.dtype(np.float32))
        self._optimum = problem.optimum(None, problem.plane, self._dual)

    def __call__(self, change: Image) -> Image:
        """Return the change of the estimate (row, column) for a change of −∇L."""
        return self.problem.optimum(change, self._optimum, self._dual.copy()) - self._optimum


def _stein_errors(problem: LocalProblem, noises: list[Image], derivatives: list[Image]) -> Image:
    """Return an unbiased estimate (row, column) of `|K(f − truth)|²`, of much noise: it counts on average only.

    With the residual `q = −∇L/W = K(truth − f) + ν`, it is `q² − Var ν + 2 ν · K(∂f/∂ν) ν` (Stein 1981), the derivative
    by a small change along draws of ν (Ramani, Blu and Unser 2008).
    """
    local = problem.local
    pairs = zip(noises, derivatives, strict=True)
    covariance = _mean([noise * problem.as_seen(derivative) for noise, derivative in pairs]) / local.metric
    return np.asarray(np.square(local.gradient / local.metric) - local.noise_share / local.metric + 2 * covariance)


def _ratio_and_excess(
    errors: Image, squares: Image, noise_variance: Image, alternation: tuple[float, float], expected: Expected
) -> tuple[float, float]:
    """Return the squared error of a region relative to its answers, up to the most, and what it has beyond that.

    The squared error is the mean of the measured and of the usual, by their variances, plus half the deviation of that
    mean, since a σ that is too small does more harm. It is no less than the measured surely is: if the penalty leaves
    nothing, there are no answers either. The measured varies nearly as the mean of q², of correlated noise.
    """
    if not errors.size:
        return expected.usually, 0.0
    level, measured, of_noise = (float(x.mean(dtype=np.float64)) for x in (squares, errors, noise_variance))
    correlation = np.prod([1 + 2 * ((1 - k) / (2 + 2 * k)) ** 2 for k in alternation])
    deviation = float(np.sqrt(2 * correlation / errors.size)) * of_noise
    trust = (_DOUBT * level) ** 2 / max((_DOUBT * level) ** 2 + deviation**2, _TINY)
    weighted = trust * measured + (1 - trust) * expected.usually * level + _CAUTION * np.sqrt(trust) * deviation
    error = max(expected.least * level, float(weighted), measured - 2 * deviation)
    ratio = min(error / max(level, _TINY), expected.most)
    return ratio, max(error - expected.most * level, 0.0)


def _regions(local: LocalFit, usual: UsualErrors) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.bool_], Expected]]:
    """Yield the opaque samples and those beside them, each with those that views see, and the errors expected there."""
    opaque, visible = opacity(local.plane) > 0.5, local.noise_share > 0
    dark = float(np.mean(~opaque[visible])) if visible.any() else 0.0
    on_objects = usual.opaque._replace(usually=usual.opaque.usually + usual.for_small_objects * dark)
    for region, expected in ((opaque, on_objects), (~opaque, usual.beside)):
        if region.any():
            yield region, region & visible, expected


def _coupling(operator: SceneOperator, index: int) -> Iterator[Image]:
    """Yield `z · HᵀH z` (row, column) of one plane, for z constant, alternating down, right, and both."""
    for down, right in ((1, 1), (-1, 1), (1, -1), (-1, -1)):
        samples = np.zeros(operator.samples_shape, operator.dtype)
        z = operator.planes_of(samples)[index]
        rows, columns = (np.arange(length) % 2 == 0 for length in z.shape)
        z[:] = np.where(rows, 1, down)[:, np.newaxis] * np.where(columns, 1, right)
        yield z * operator.planes_of(operator.adjoint_of_forward(samples))[index]


def _three_sample_blur(image: Image, alternation: Image) -> Image:
    """Return an image blurred by (t, 1, t)/(1 + 2t) along both axes; leaves `alternation` of alternating samples."""
    for axis, left in enumerate(alternation.tolist()):
        t = (1 - left) / (2 + 2 * left)
        along = np.moveaxis(image, axis, 0)
        ends = np.pad(along, [(1, 1), (0, 0)], "edge")
        mean = (along + image.dtype.type(t) * (ends[:-2] + ends[2:])) * image.dtype.type(1 / (1 + 2 * t))
        image = np.moveaxis(mean, 0, axis)
    return np.ascontiguousarray(image)


def _mean(planes: Sequence[Image]) -> Image:
    return np.asarray(sum(planes) / np.float32(len(planes)))
