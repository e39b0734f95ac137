"""Penalised maximum likelihood to a certified optimum: `min L(f) + β Σ φ(|∇f|)` over f ≥ 0.

Each pass over the data replaces the negative log-likelihood L by the quadratic `L(fₖ) + ∇L·(f − fₖ) + ½ Σ w (f − fₖ)²`,
whose metric w is nearly L's curvature, and finds the least of that and the penalty with `recon.solver.proximal`. Most of the
work is thus done on the plane, where it is cheap, and few passes over the data are needed.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from faintfield.recon.errors import NotConverged
from faintfield.recon.likelihood.images import Image
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.proximal import DualField, Nearest

# An inner problem is solved until what is left of it is this part of the last step, or of the tolerance.
_INNER_OF_STEP, _INNER_OF_TOLERANCE = 0.1, 0.5
_INNER_STEPS = 600

# The objective may rise by this part through rounding; a rise beyond it is undone.
_ROUNDING = 1e-7

# The metric is not changed after so many passes, so that the iteration has a limit.
_PASSES_WITH_NEW_METRIC = 4

# What is left, after a step that was good, of a metric that had to be made larger.
_RELAXED = 0.7

# A metric this many times the likelihood's curvature is none: the objective must fall long before.
_LARGEST_SCALE = 2.0**10

# Where a sample must not become zero, it falls to this part of itself at most in one pass.
_FALL = 0.05


class Fit(Protocol):
    """What PMLEM asks of the data; `recon.solver.data_fit.DataFit` answers for the views of one plane."""

    @property
    def may_reach_zero(self) -> bool:
        """Whether L is finite wherever f ≥ 0."""

    def value_and_gradient(self, plane: Image, /) -> tuple[float, Image]:
        """Return L(f) up to a constant and ∇L(f), in one pass over the data."""

    def metric(self, plane: Image, /) -> Image:
        """Return a positive diagonal that is about as large as the curvature of L near a plane, or larger."""


class Dual(Protocol):
    """The penalty's dual field: `recon.solver.proximal.DualField` of a plane, `recon.solver.scene_dual.SceneDual` of several."""

    def copy(self) -> "Dual":
        """Return a copy that can be changed without changing this one."""

    def plane(self, centre: Image, reach: Image) -> Image:
        """Return `v − β/w ∇ᵀp`, not clipped at zero."""

    def penalty_and_slack(self, plane: Image, penalty: Penalty) -> tuple[float, float]:
        """Return `Σ φ(|∇x|)` and `Σ φ(|∇x|) + φ*(p) − p·∇x ≥ 0`."""

    def nearest(
        self, centre: Image, metric: Image, weight: float, penalty: Penalty, enough: Callable[[Image], float], most: int
    ) -> Nearest:
        """Solve `min ½ Σ w (x − v)² + β Σ φ(|∇x|)` over x ≥ 0."""


@dataclass(frozen=True)
class Certificate:
    """How far a plane is from the optimum at most, in the norm ‖x‖² = Σ w x² of the metric, relative to its own.

    With ρ = ∇L + β ∇ᵀp, `a² = Σ w (f − (f − ρ/w)₊)²` and `e = β Σ( φ(|∇f|) + φ*(p) − p·∇f ) + Σ f (ρ − w f)₊`,
    convexity gives `‖f − f*‖ ≤ ( a + √(a² + 2 m e) )/m`, where L is curved at least m times as much as w between f and
    the optimum f*. Stated is the bound for m = 1: the metric is the row sums of the Hessian, which is that curvature
    for all that is smooth, and penalties leave little else.

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
    dual : Dual
        The penalty's dual field, to start a similar problem from.
    """

    plane: Image
    objective: float
    certificate: Certificate
    passes: int
    inner_steps: int
    dual: Dual


def pmlem(
    fit: Fit,
    start: Image,
    *,
    penalty_weight: float,
    penalty: Penalty | None = None,
    tolerance: float = 0.01,
    dual: Dual | None = None,
) -> Iterator[PmlemIterate]:
    """Yield planes of ever lower objective, each with its certificate; when to stop is the caller's business.

    Proximal gradient in the metric of the data. A step after which the objective has risen is undone and made again
    with twice the metric; the value that tells comes with the sweep that the next step needs anyway.

    Parameters
    ----------
    fit : Fit
        L.
    start : float array (row, column)
        Positive.
    penalty_weight : float
        β ≥ 0, in the unit of s.
    penalty : Penalty, optional
        Total variation by default.
    tolerance : float
        The distance that the caller is after: inner problems are solved no better than it takes.
    dual : Dual, optional
        That of a similar problem, of which a copy is used; by default that of one plane without roughness.

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
    dual = dual or DualField.zero((start.shape[0], start.shape[1]), start.dtype)
    return _Pmlem(fit, penalty_weight, penalty, tolerance).iterates(start, dual)


class _Pmlem:
    """The iteration, and what it keeps."""

    def __init__(self, fit: Fit, weight: float, penalty: Penalty, tolerance: float) -> None:
        self._fit, self._weight, self._penalty, self._tolerance = fit, weight, penalty, tolerance
        self._scale = 1.0
        self._inner_steps = 0

    def iterates(self, plane: Image, dual: Dual) -> Iterator[PmlemIterate]:
        """Iterate for ever."""
        metric = self._fit.metric(plane)
        accepted: PmlemIterate | None = None
        gradient = np.zeros_like(plane)
        passes, lowest = 0, np.inf
        while True:
            value, new_gradient = self._fit.value_and_gradient(plane)
            passes += 1
            objective = value + self._weight * dual.penalty_and_slack(plane, self._penalty)[0]
            if np.isnan(objective):
                raise NotConverged(f"pass {passes} left the finite numbers; give a smaller penalty weight")
            if accepted is None or np.isinf(lowest) or objective <= lowest + _ROUNDING * abs(lowest):
                lowest = min(lowest, objective)
                gradient = new_gradient
                certificate = self._certificate(plane, gradient, metric, dual)
                accepted = PmlemIterate(plane, objective, certificate, passes, self._inner_steps, dual)
                yield accepted
                self._scale = max(self._scale * _RELAXED, 1.0)
                if passes <= _PASSES_WITH_NEW_METRIC:
                    metric = self._fit.metric(plane)
            else:
                self._scale *= 2
            while self._scale > _LARGEST_SCALE:
                yield accepted  # no step leads further down: as far as these numbers go
            plane, dual = self._step(accepted, gradient, metric, dual)

    def _step(self, here: PmlemIterate, gradient: Image, metric: Image, dual: Dual) -> tuple[Image, Dual]:
        """Return the least of the quadratic and the penalty, and its dual field, sought from that of the last one."""
        scaled = metric if self._scale == 1 else metric * metric.dtype.type(self._scale)
        centre = here.plane - gradient / scaled
        if self._weight == 0:
            plane = np.maximum(centre, 0)
        else:
            dual = dual.copy()
            size = norm(here.plane, scaled)

            def enough(plane: Image) -> float:
                step = norm(plane - here.plane, scaled)
                return 0.5 * max(_INNER_OF_STEP * step, _INNER_OF_TOLERANCE * self._tolerance * size) ** 2

            nearest = dual.nearest(centre, scaled, self._weight, self._penalty, enough, _INNER_STEPS)
            plane = nearest.plane
            self._inner_steps += nearest.steps
        if not self._fit.may_reach_zero:
            np.maximum(plane, here.plane.dtype.type(_FALL) * here.plane, out=plane)
        return plane, dual

    def _certificate(self, plane: Image, gradient: Image, metric: Image, dual: Dual) -> Certificate:
        """Return how far a plane is from the optimum, in the metric it was found with."""
        reach = plane.dtype.type(self._weight) / metric
        after = dual.plane(plane - gradient / metric, reach)
        residual = norm(plane - np.maximum(after, 0), metric)
        slack = self._weight * dual.penalty_and_slack(plane, self._penalty)[1]
        slack += float(np.sum(metric * plane * np.maximum(-after, 0), dtype=np.float64))
        size = norm(plane, metric)
        parts = (residual + np.sqrt(residual**2 + 2 * slack), residual, np.sqrt(2 * slack))
        return Certificate(*(_relative(part, size) for part in parts))


def _relative(part: float, size: float) -> float:
    """Return a part of a size; of a black plane everything is infinitely much, and nothing is nothing."""
    if size == 0:
        return 0.0 if part == 0 else np.inf
    return float(part / size)


def norm(plane: Image, metric: Image) -> float:
    """Return √ Σ w x², summed in float64."""
    return float(np.sqrt(np.einsum("i,i,i->", metric.ravel(), plane.ravel(), plane.ravel(), dtype=np.float64)))
