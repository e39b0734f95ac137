"""One-step-late PMLEM, the iteration of eq. (2) as published; with a weight of zero it is MLEM.

It does not know whether it has converged, as `recon.solver.pmlem` does: `settled` and `oscillates` judge its steps.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.errors import NotConverged
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.solver.initialization import well_seen_samples
from faintfield.recon.solver.penalties import total_variation_gradient

# |P| of eq. (3) is at most 1 + 1 + √2: two differences that cannot exceed their own magnitude, and the sum of two.
_MAX_PENALTY_GRADIENT = 2 + 2**0.5


class IterationStep(NamedTuple):
    """Change of the plane in one pass over the data.

    `relative_change` is ‖f⁽ᵏ⁺¹⁾ − f⁽ᵏ⁾‖ / ‖f⁽ᵏ⁾‖, and `alternation` the cosine of the angle between this step and the
    last: −1 when the iteration oscillates, 0 at the first pass.
    """

    passes: int
    relative_change: float
    alternation: float


class Iterate(NamedTuple):
    """Plane (row, column) in electrons after one pass over the data, and its change."""

    plane: Image
    step: IterationStep


def pmlem_one_step_late(
    operator: PlaneOperator, images: ElementalImages, start: Image, *, penalty_weight: float, epsilon: float
) -> Iterator[Iterate]:
    """Yield iterates of Green's one-step-late PMLEM with total variation, eqs. (2) and (3) as published.

    `f ← f / ( s + β P{f} ) · Hᵀ[ (g + σ²)₊ / (H f + b + σ²) ]`: the shifted Poisson model adds the read noise's
    variance to data and model, which makes the data nearly Poisson; with σ = 0 it is eq. (2) itself.

    Parameters
    ----------
    operator, images, start : PlaneOperator, ElementalImages, float array (row, column)
        H, g, and a positive plane to start from.
    penalty_weight, epsilon : float
        β ≥ 0, in the unit of s, zero for maximum likelihood; ε > 0 of eq. (3), in the unit of f squared.

    Raises
    ------
    NotConverged
        The weight is so large that most denominators could become negative, or an iterate is not finite.

    Notes
    -----
    The denominator is positive for every f only where `s > (2 + √2) β`. Samples seen by fewer views keep their start
    value, see `updated_samples`. With a large β iterates may oscillate without end, which `oscillates` detects.
    """
    sensitivity = operator.sensitivity()
    updated, seen = updated_samples(sensitivity, penalty_weight), well_seen_samples(sensitivity)
    if np.count_nonzero(updated & seen) < np.count_nonzero(seen) / 2:
        limit = float(np.median(sensitivity[seen])) / _MAX_PENALTY_GRADIENT
        raise NotConverged(
            f"penalty weight {penalty_weight:.3g} makes most denominators of eq. (2) negative; with these views it "
            f"must stay below {limit:.3g}: give a smaller one"
        )
    plane = np.array(start, operator.dtype)
    step, passes = np.zeros_like(plane), 0
    while True:
        denominator = sensitivity
        if penalty_weight > 0:
            denominator = total_variation_gradient(plane, epsilon)
            denominator *= plane.dtype.type(penalty_weight)
            denominator += sensitivity
        next_plane = operator.adjoint_of_ratio(plane, images)
        next_plane *= plane
        np.divide(next_plane, denominator, out=next_plane, where=updated)
        np.copyto(next_plane, plane, where=~updated)
        if not np.isfinite(next_plane).all():
            raise NotConverged(f"pass {passes + 1} left the finite numbers; give a smaller penalty weight")
        passes += 1
        last_step, step = step, next_plane - plane
        norms = float(np.linalg.norm(step)) * float(np.linalg.norm(last_step))
        alternation = float(np.vdot(step, last_step)) / norms if norms > 0 else 0.0
        change = float(np.linalg.norm(step) / np.linalg.norm(plane)) if step.any() else 0.0
        plane = next_plane
        yield Iterate(plane, IterationStep(passes, change, alternation))


def updated_samples(sensitivity: Image, penalty_weight: float) -> NDArray[np.bool_]:
    """Return which samples one-step-late PMLEM changes: those whose denominator is positive for every plane."""
    return np.asarray(sensitivity > _MAX_PENALTY_GRADIENT * penalty_weight)


def settled(steps: Sequence[IterationStep], tolerance: float) -> bool:
    """Return whether the relative change of the last pass is less than `tolerance`."""
    return bool(steps) and steps[-1].relative_change < tolerance


def oscillates(steps: Sequence[IterationStep], tolerance: float, window: int = 10) -> bool:
    """Return whether the iteration oscillates instead of settling.

    Over the last `window` passes, successive steps then mostly oppose each other (mean cosine below −0.5), are larger
    than `tolerance`, and do not shrink (the second half of the window moves at least 0.8 times as far).
    """
    if len(steps) < window:
        return False
    last = steps[-window:]
    changes = [step.relative_change for step in last]
    early, late = np.mean(changes[: window // 2]), np.mean(changes[window // 2 :])
    alternation = np.mean([step.alternation for step in last])
    return bool(alternation < -0.5 and late > tolerance and late >= 0.8 * early)
