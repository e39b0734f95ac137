"""Penalised maximum likelihood to a certified optimum: `min L(f) + β Σ φ(|∇f|)` over f ≥ 0.

Each pass over the data replaces the negative log-likelihood L by the quadratic `L(fₖ) + ∇L·(f − fₖ) + ½ Σ w (f − fₖ)²`,
whose metric w is nearly L's curvature, and minimises its sum with the penalty by `recon.solver.proximal`. Most of the
work is thus done on the plane, where it is cheap, and few passes over the data are needed.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from faintfield.recon.errors import NotConverged
from faintfield.recon.likelihood.images import Image
from faintfield.recon.solver.custom_penalty import ProximalField, ProximalPenalty
from faintfield.recon.solver.data_fit import DataFit
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.proximal import DualField
from faintfield.recon.solver.proximal_kernels import squared_distance
from faintfield.recon.threads import elementwise, summed

# An inner problem is solved until its error is this fraction of the last step, or of the tolerance, of which it is half
# as much after each pass that hardly lowered the certificate's distance; limit on its steps, of which a pass over the
# data takes as long as about 30.
_INNER_OF_STEP, _INNER_OF_TOLERANCE, _MAX_INNER_STEPS = 0.3, 0.7, 2000

# That part of the tolerance near a proposal, where the first step is short and the quadratic hardly differs from L.
_INNER_NEAR_PROPOSAL = 0.9

# A certificate's distance that falls less than to this share of the last is slow.
_SLOW = 0.8

# Largest ratio of a step to the last one that is believed, where no bound is known: it is noisy where both are short.
_LEAST_SHRINKING = 0.99

# Relative rise of the objective that rounding may cause; a step with a larger rise is undone.
_ROUNDING = 1e-7

# The metric is updated in this many passes only, so that the iteration converges.
_PASSES_WITH_NEW_METRIC = 4

# Factor by which an enlarged metric shrinks after each good step, and largest factor on the metric: the objective must
# fall long before the metric is this many times the curvature.
_RELAXATION, _MAX_SCALE = 0.7, 2.0**10

# Smallest ratio of a sample to its last value, where samples must not become zero.
_MIN_FALL = 0.05


@dataclass(frozen=True)
class Certificate:
    """A bound on the distance of a plane from the optimum, relative to its norm, ‖x‖² = Σ w x² in the metric w.

    With ρ = ∇L + β ∇ᵀp, `a² = Σ w (f − (f − ρ/w)₊)²` and `e = β Σ( φ(|∇f|) + φ*(p) − p·∇f ) + Σ f (ρ − w f)₊`,
    convexity gives `‖f − f*‖ ≤ ( a + √(a² + 4 m e) )/2m`, where the curvature of L between f and
    the optimum f* is at least m w. The bound is given for m = ½: the metric is the row sums of the Hessian, which equal
    that curvature for all that is smooth (m = 1), and penalties leave little else.

    Attributes
    ----------
    distance, stationarity, slack : float
        The bound, zero only at the optimum, and its parts a/‖f‖ and √(2e)/‖f‖. With a penalty of one's own there is no
        bound, NaN, and a is the length of the next step.
    expected : float
        The distance to expect where there is no bound: a/(1 − r)‖f‖, if steps go on to shrink by the ratio r of the
        last two. NaN with a bound.
    """

    distance: float
    stationarity: float
    slack: float
    expected: float = np.nan

    def within(self, tolerance: float) -> bool:
        """Return whether the distance, or without a bound the one to expect, is within a tolerance."""
        return (self.expected if np.isnan(self.distance) else self.distance) <= tolerance


@dataclass(frozen=True)
class PmlemIterate:
    """A plane with its objective and certificate.

    Attributes
    ----------
    plane : float array (samples)
        Expected electrons per detector pixel, at least zero; (sample,) for several planes together.
    objective, certificate : float, Certificate
        `L(f) + β Σ φ(|∇f|)`, and the distance from the optimum.
    passes, inner_steps : int
        Passes over the data, and steps of inner problems, so far.
    dual : DualField
        The penalty's dual field, from which a similar problem can start. The next iterate changes it.
    """

    plane: Image
    objective: float
    certificate: Certificate
    passes: int
    inner_steps: int
    dual: DualField


def pmlem(
    fit: DataFit,
    start: Image,
    *,
    penalty_weight: float,
    penalty: Penalty | ProximalPenalty | None = None,
    tolerance: float = 0.01,
    dual: DualField | None = None,
) -> Iterator[PmlemIterate]:
    """Maximise the penalised likelihood: yield planes of decreasing objective `L(f) + β Σ φ(|∇f|)` over f ≥ 0.

    Each plane has a certificate, a bound on its distance from the optimum; the caller decides when to stop.

    Parameters
    ----------
    fit : DataFit
        L, the negative log-likelihood.
    start : float array (samples)
        Positive samples to start from, such as those of `smooth_start`.
    penalty_weight : float
        β ≥ 0, in the unit of s = Hᵀ 1.
    penalty : Penalty or ProximalPenalty, optional
        φ, by default total variation, or a penalty of one's own.
    tolerance : float
        The distance that the caller wants to reach, which sets the accuracy of inner problems.
    dual : DualField, optional
        That of a similar problem, which is changed; by default that of one constant plane.

    Yields
    ------
    PmlemIterate
        `plane` in electrons per detector pixel, `certificate.distance` from the optimum relative to the plane,
        `objective`, and `passes` over the data so far.

    Raises
    ------
    ValueError
        `start` is not positive, or the weight is negative.
    NotConverged
        An iterate is not finite.

    Notes
    -----
    Each step is a proximal gradient step in the metric of the data. A step that raised the objective is undone and
    repeated with twice the metric; the next step needs the pass that gives the objective anyway. Only a plane that is
    certified within the tolerance may have a larger objective, as after a start that is the optimum.

    Examples
    --------
    A bright square in read noise of √12 e, seen by three cameras:

    >>> import numpy as np
    >>> from faintfield import DataFit, ElementalImages, Lens, PlaneGrid, PlaneOperator
    >>> from faintfield import back_projection, fronto_parallel_rt_ref_plane, plane_from_ray, pmlem, smooth_start
    >>> lens = Lens((32, 24), fx_px=40.0, fy_px=40.0, cx_px=15.5, cy_px=11.5)
    >>> poses_rt_cam_ref = np.array([[0.0, 0.0, 0.0, x_mm, 0.0, 0.0] for x_mm in (20.0, 0.0, -20.0)])
    >>> homographies = plane_from_ray(poses_rt_cam_ref, fronto_parallel_rt_ref_plane(depth_mm=400.0))
    >>> grid = PlaneGrid.covering(-160.0, -120.0, 160.0, 120.0, pitch_mm=10.0)
    >>> operator = PlaneOperator(homographies, lens.rays(), grid)
    >>> truth_e = np.full(grid.shape, 2.0)
    >>> truth_e[8:16, 12:20] = 6.0
    >>> rng = np.random.default_rng(1)
    >>> counts_e = rng.poisson(operator.forward(truth_e)) + rng.normal(0.0, 12.0**0.5, operator.images_shape)
    >>> images = ElementalImages(counts_e, read_variance_e2=12.0)
    >>> fit, start_e = DataFit(operator, images, level_e=2.0), smooth_start(operator, images)
    >>> for iterate in pmlem(fit, start_e, penalty_weight=0.3):
    ...     if iterate.certificate.distance < 0.01 or iterate.passes == 50:
    ...         break  # at most 1 % from the optimum

    The rms error of the mean of the views, and of the optimum, in electrons:

    >>> planes_e = [back_projection(operator, images), iterate.plane]
    >>> [round(float(np.square(plane_e - truth_e)[4:20, 6:26].mean() ** 0.5), 1) for plane_e in planes_e]
    [2.3, 0.6]
    """
    if not penalty_weight >= 0:
        raise ValueError(f"need penalty_weight >= 0, got {penalty_weight}")
    if not (start > 0).all():
        raise ValueError(f"start must be positive everywhere, its smallest value is {start.min()}")
    penalty = Penalty() if penalty is None else penalty
    dual = dual or DualField.zero([(start.shape[0], start.shape[1])], start.dtype)
    if not isinstance(penalty, Penalty):
        dual, penalty = ProximalField.of(penalty, dual), Penalty()  # the field has the penalty
    if penalty_weight == 0 or penalty.name == "none":
        penalty_weight, penalty = 0.0, Penalty("none")
    return _Pmlem(fit, penalty_weight, penalty, tolerance).iterates(start, dual)


def iterate_until(iterates: Iterator[PmlemIterate], tolerance: float, max_passes: int) -> PmlemIterate:
    """Return the first iterate that is certified within a tolerance, or the one after `max_passes`."""
    for count, iterate in enumerate(iterates, 1):  # where no step lowers the objective, passes stay as they are
        if iterate.certificate.within(tolerance) or max(count, iterate.passes) >= max_passes:
            break
    return iterate


class _Pmlem:
    def __init__(self, fit: DataFit, weight: float, penalty: Penalty, tolerance: float) -> None:
        self._fit, self._weight, self._penalty, self._tolerance = fit, weight, penalty, tolerance
        self._scale, self._inner_of_tolerance = 1.0, _INNER_OF_TOLERANCE
        self._inner_steps = 0
        self._last_step = np.inf

    def iterates(self, plane: Image, dual: DualField) -> Iterator[PmlemIterate]:
        """Iterate without end; arrays as large as the plane are dropped before the next of their kind is made."""
        metric = self._fit.metric(plane)
        if dual.proposal is not None:
            self._inner_of_tolerance = _INNER_NEAR_PROPOSAL
        accepted, point = None, plane
        passes, lowest = 0, np.inf
        while True:
            value, gradient = self._fit.value_and_gradient(plane)
            passes += 1
            objective = value + self._weight * dual.penalty_and_slack(plane, self._penalty)[0]
            if np.isnan(objective):
                raise NotConverged(f"pass {passes} left the finite numbers; give a smaller penalty weight")
            certificate = self._certificate(plane, gradient, metric, dual)
            is_lower = np.isinf(lowest) or objective <= lowest + _ROUNDING * abs(lowest)
            if accepted is None or is_lower or certificate.within(self._tolerance):
                lowest = min(lowest, objective)
                if accepted is not None and certificate.distance > _SLOW * accepted.certificate.distance:
                    self._inner_of_tolerance /= 2
                del point
                accepted = PmlemIterate(plane, objective, certificate, passes, self._inner_steps, dual)
                yield accepted
                self._scale = max(self._scale * _RELAXATION, 1.0)
                if passes <= _PASSES_WITH_NEW_METRIC:
                    del metric
                    metric = self._fit.metric(plane)
                point = elementwise(partial(_stepped, metric.dtype.type(self._scale)), plane, gradient, metric)
            else:
                self._scale *= 2
                point = (accepted.plane + point) / 2  # half the way
            while self._scale > _MAX_SCALE:
                yield accepted  # no step lowers the objective within rounding
            del plane, gradient
            plane = self._minimum(accepted.plane, point, metric, dual)

    def _minimum(self, start: Image, point: Image, metric: Image, dual: DualField) -> Image:
        """Return the minimum of quadratic and penalty; start from a dual field and replace it by that of the minimum.

        The quadratic has its own minimum at `point` and the curvature `scale · metric`; both parts are divided by that
        scale.
        """
        if self._weight == 0:
            plane = np.maximum(point, 0)
        else:
            size = norm(start, metric)

            def gap_tolerance(plane: Image) -> float:
                step = distance(plane, start, metric)
                return 0.5 * max(_INNER_OF_STEP * step, self._inner_of_tolerance * self._tolerance * size) ** 2

            weight = self._weight / self._scale
            gap = 0.5 * (self._inner_of_tolerance * self._tolerance * size) ** 2
            dual.begin_coarse(point, metric, weight, self._penalty, gap)
            found = dual.prox(point, metric, weight, self._penalty, gap_tolerance, _MAX_INNER_STEPS)
            plane = found.plane
            self._inner_steps += found.steps
        if not self._fit.may_reach_zero:
            np.maximum(plane, start.dtype.type(_MIN_FALL) * start, out=plane)
        return plane

    def _certificate(self, plane: Image, gradient: Image, metric: Image, dual: DualField) -> Certificate:
        point = elementwise(partial(_stepped, plane.dtype.type(1)), plane, gradient, metric)
        square, excess = dual.distance_from_primal(plane, point, metric, self._weight)
        residual, size = float(np.sqrt(2 * square)), norm(plane, metric)
        slack = self._weight * dual.penalty_and_slack(plane, self._penalty)[1] + excess
        bound, expected = residual + np.sqrt(residual**2 + 2 * slack), np.nan
        if not dual.certifies:
            shrinks = min(residual / self._last_step, _LEAST_SHRINKING) if self._last_step > 0 else 0.0
            bound, expected = np.nan, residual / (1 - shrinks) if np.isfinite(self._last_step) else np.inf
            self._last_step = residual
        parts = (bound, residual, np.sqrt(2 * slack), expected)
        return Certificate(*(_relative(part, size) for part in parts))


def _stepped(scale: np.floating, plane: Image, gradient: Image, metric: Image) -> Image:
    """Return f − ∇L/(scale w), where the quadratic has its minimum."""
    return plane - gradient / (scale * metric)


def _relative(part: float, size: float) -> float:
    """Return part/size; for a black plane zero is zero, and any other part infinite."""
    if size == 0:
        return 0.0 if part == 0 else np.inf
    return float(part / size)


def norm(plane: Image, metric: Image) -> float:
    """Return √ Σ w x², summed in float64."""
    return distance(plane, np.empty(0, plane.dtype), metric)


def distance(plane: Image, other: Image, metric: Image) -> float:
    """Return √ Σ w (x − y)², summed in float64; y = 0 if it has no samples."""
    flat = (array.reshape(-1) for array in (plane, other, metric))
    return float(np.sqrt(summed(squared_distance, *flat)))
