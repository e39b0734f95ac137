"""Penalised maximum likelihood to a certified optimum: `min L(f) + β Σ φ(|∇f|)` over f ≥ 0.

Each pass over the data replaces the negative log-likelihood L by the quadratic `L(fₖ) + ∇L·(f − fₖ) + ½ Σ w (f − fₖ)²`,
whose metric w is nearly L's curvature, and finds the least of that and the penalty with `recon.proximal`. Most of the
work is thus done on the plane, where it is cheap, and few passes over the data are needed.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from recon.errors import NotConverged
from recon.images import ElementalImages, Image
from recon.penalties import Penalty
from recon.proximal import DualField
from recon.smoothing import blurred

# The metric is at least this part of its median: samples that hardly any view sees are led by their neighbours.
_LEAST_METRIC = 1e-3

# An inner problem is solved until what is left of it is this part of the last step, or of the tolerance.
_INNER_OF_STEP, _INNER_OF_TOLERANCE = 0.1, 0.5
_INNER_STEPS = 600

# The objective may rise by this part through rounding; a rise beyond it is undone.
_ROUNDING = 1e-7

# The metric is not changed after so many passes, so that the iteration has a limit.
_PASSES_WITH_NEW_METRIC = 4

# A metric this many times the likelihood's curvature is no metric: the objective must fall long before.
_LARGEST_SCALE = 1e6

# Where nothing but light is expected, a sample that data speak for must not become zero; it falls by this at most.
_FALL = 0.05


class ForwardModel(Protocol):
    """What PMLEM asks of an operator: `recon.operator.PlaneOperator` answers for one plane."""

    def value_and_ratio(self, plane: Image, images: ElementalImages) -> tuple[float, Image]:
        """Return L(f) and Hᵀ r, with ∇L = s − Hᵀ r."""

    def sensitivity(self) -> Image:
        """Return s = Hᵀ 1."""

    def coverage(self) -> Image:
        """Return Hᵀ H 1."""

    def adjoint_of_map(self, value: float | Image) -> Image:
        """Return Hᵀ of images that all equal one map."""


@dataclass(frozen=True)
class Certificate:
    """How far a plane is from the optimum at most, relative to its size, where curvature is at least that of the metric.

    With ρ = ∇L + β ∇ᵀp, w the metric, `a² = Σ w (f − (f − ρ/w)₊)²` and
    `e = β Σ( φ(|∇f|) + φ*(p) − p·∇f ) + Σ f (ρ − w f)₊`, convexity gives `‖f − f*‖ ≤ ( a + √(a² + 2 m e) )/m` in the norm
    of w, if L is curved at least m times as much as w between f and the optimum f*. Stated is this for m = 1, over ‖f‖.

    Attributes
    ----------
    distance : float
        The bound; zero only at an optimum.
    stationarity, slack : float
        Its parts a/‖f‖ and √(2e)/‖f‖.
    """

    distance: float
    stationarity: float
    slack: float


@dataclass(frozen=True)
class PmlemIterate:
    """A plane whose objective and certificate are known.

    Attributes
    ----------
    plane : float array (row, column)
        Expected electrons per detector pixel, at least zero.
    objective : float
        L(f) + β Σ φ(|∇f|).
    certificate : Certificate
        How far from the optimum.
    passes : int
        Sweeps over the data so far.
    inner_steps : int
        Steps on the dual field so far.
    dual : DualField
        The penalty's dual field, to start a similar problem from.
    """

    plane: Image
    objective: float
    certificate: Certificate
    passes: int
    inner_steps: int
    dual: DualField


class Curvature:
    """The metric: about `Hᵀ[ (H 1) / (H f + b + σ²) ]`, the row sums of the likelihood's Hessian.

    Parameters
    ----------
    operator : ForwardModel
        H.
    images : ElementalImages
        The data; their likelihood says what its curvature is.
    level_e : float
        Typical light, at which backgrounds that vary over the detector are averaged.
    """

    def __init__(self, operator: ForwardModel, images: ElementalImages, level_e: float) -> None:
        self._images = images
        self.sensitivity = operator.sensitivity()
        self._coverage = operator.coverage()
        seen = self.sensitivity > 0
        self._response = np.divide(self._coverage, self.sensitivity, out=np.ones_like(self._coverage), where=seen)
        constant = np.asarray(images.constant_variance_e2(), np.float64)
        if constant.ndim == 0:
            self._constant: float | Image = float(constant)
        else:
            inverse = operator.adjoint_of_map(1 / (level_e + constant))
            mean = np.divide(inverse, self.sensitivity, out=np.full_like(inverse, 1 / level_e), where=seen)
            self._constant = np.maximum(1 / mean - level_e, 0)

    def at(self, plane: Image, floor_e: float) -> Image:
        """Return the metric (row, column) at a plane, which counts as at least `floor_e` everywhere."""
        light = np.maximum(blurred(plane, (1,)), floor_e)
        level_e = self._images.likelihood.level_e
        variance = (light if self._images.likelihood.name != "least-squares" else level_e) * self._response
        metric = self._coverage / (variance + self._constant)
        return np.asarray(np.maximum(metric, _LEAST_METRIC * np.median(metric)), plane.dtype)


def pmlem(
    operator: ForwardModel,
    images: ElementalImages,
    start: Image,
    *,
    penalty_weight: float,
    penalty: Penalty | None = None,
    tolerance: float = 0.01,
    dual: DualField | None = None,
) -> Iterator[PmlemIterate]:
    """Yield planes of ever lower objective, each with its certificate; when to stop is the caller's business.

    Proximal gradient in the metric of `Curvature`. A step after which the objective has risen is undone and made again
    with twice the metric; the value that tells comes with the sweep that the next step needs anyway.

    Parameters
    ----------
    start : float array (row, column)
        Positive.
    penalty_weight : float
        β ≥ 0, in the unit of s.
    penalty : Penalty, optional
        Total variation by default.
    tolerance : float
        The distance that the caller is after: inner problems are solved no better than it takes.
    dual : DualField, optional
        That of a similar problem; a copy is used.

    Raises
    ------
    ValueError
        `start` is not positive, or the weight is negative.
    NotConverged
        An iterate is not finite.
    """
    if not penalty_weight >= 0:
        raise ValueError(f"need penalty_weight >= 0, got {penalty_weight}")
    if not (start > 0).all():
        raise ValueError(f"start must be positive everywhere, its least value is {start.min()}")
    penalty = penalty or Penalty()
    if penalty_weight == 0 or penalty.name == "none":
        penalty_weight, penalty = 0.0, Penalty("none")
    dual = DualField.zero(start.shape, start.dtype) if dual is None else dual.copy()
    return _Pmlem(operator, images, start, penalty_weight, penalty, tolerance).iterates(start, dual)


class _Pmlem:
    """The iteration, and what it keeps."""

    def __init__(
        self,
        operator: ForwardModel,
        images: ElementalImages,
        start: Image,
        weight: float,
        penalty: Penalty,
        tolerance: float,
    ) -> None:
        self._operator, self._images = operator, images
        self._weight, self._penalty, self._tolerance = weight, penalty, tolerance
        level_e = float(start.mean(dtype=np.float64))
        self._floor_e = 0.01 * level_e
        self._curvature = Curvature(operator, images, level_e)
        self._scale = 1.0
        self._inner_steps = 0
        self._last_step = np.inf

    def iterates(self, plane: Image, dual: DualField) -> Iterator[PmlemIterate]:
        """Iterate for ever."""
        metric = self._curvature.at(plane, self._floor_e)
        accepted: PmlemIterate | None = None
        gradient = np.zeros_like(plane)
        passes = 0
        while True:
            value, ratio = self._operator.value_and_ratio(plane, self._images)
            passes += 1
            objective = value + self._weight * dual.penalty_and_slack(plane, self._penalty)[0]
            if np.isnan(objective):
                raise NotConverged(f"pass {passes} left the finite numbers; give a smaller penalty weight")
            if accepted is None or objective <= accepted.objective + _ROUNDING * abs(accepted.objective):
                gradient = self._curvature.sensitivity - ratio
                certificate = self._certificate(plane, gradient, metric, dual)
                accepted = PmlemIterate(plane, objective, certificate, passes, self._inner_steps, dual)
                yield accepted
                if passes <= _PASSES_WITH_NEW_METRIC:
                    metric = self._curvature.at(plane, self._floor_e)
            elif self._scale > _LARGEST_SCALE:
                yield accepted  # no step leads further down: as far as these numbers go
                continue
            else:
                self._scale *= 2
            plane, dual = self._step(accepted, gradient, metric)

    def _step(self, here: PmlemIterate, gradient: Image, metric: Image) -> tuple[Image, DualField]:
        """Return the least of the quadratic and the penalty, and its dual field."""
        scaled = metric * metric.dtype.type(self._scale)
        centre = here.plane - gradient / scaled
        if self._weight == 0:
            plane, dual = np.maximum(centre, 0), here.dual
        else:
            dual = here.dual.copy()
            size = norm(here.plane, scaled)

            def enough(plane: Image) -> float:
                step = norm(plane - here.plane, scaled)
                return 0.5 * max(_INNER_OF_STEP * step, _INNER_OF_TOLERANCE * self._tolerance * size) ** 2

            nearest = dual.nearest(centre, scaled, self._weight, self._penalty, enough, _INNER_STEPS)
            plane = nearest.plane
            self._inner_steps += nearest.steps
        if np.min(self._images.constant_variance_e2()) == 0:
            np.maximum(plane, here.plane.dtype.type(_FALL) * here.plane, out=plane)
        return plane, dual

    def _certificate(self, plane: Image, gradient: Image, metric: Image, dual: DualField) -> Certificate:
        """Return how far a plane is from the optimum, in the metric it was found with."""
        reach = plane.dtype.type(self._weight) / metric
        after = dual.plane(plane - gradient / metric, reach)
        residual = norm(plane - np.maximum(after, 0), metric)
        slack = self._weight * dual.penalty_and_slack(plane, self._penalty)[1]
        slack += float(np.sum(metric * plane * np.maximum(-after, 0), dtype=np.float64))
        size = norm(plane, metric)
        distance = residual + np.sqrt(residual**2 + 2 * slack)
        return Certificate(distance / size, residual / size, np.sqrt(2 * slack) / size)


def norm(plane: Image, metric: Image) -> float:
    """Return √ Σ w x², summed in float64."""
    return float(np.sqrt(np.einsum("ij,ij,ij->", metric, plane, plane, dtype=np.float64)))
