"""One plane of one channel: run a method on it, watch it, and say how it went."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from recon.images import ElementalImages
from recon.likelihoods import negative_log_likelihood
from recon.operator import PlaneOperator
from recon.penalties import total_variation
from recon.solvers import (
    Step,
    back_projection,
    oscillates,
    pmlem_one_step_late,
    settled,
    smooth_start,
    universal_penalty_weight,
    updated_samples,
)

type Method = Literal["backprojection", "mlem", "pmlem-osl"]

# Passes over the data that are made at most. MLEM is stopped early on purpose: carried on, it fits the noise.
_PASSES = {"mlem": 20, "pmlem-osl": 50}

# An iteration whose plane changes by less than this per pass has settled.
_SETTLED = 1e-3

# ε of eq. (3) relative to the square of the image's scale; the paper asks for less than 1 %.
_EPSILON_OF_SCALE = 0.005


@dataclass(frozen=True)
class Settings:
    """How planes are reconstructed.

    Attributes
    ----------
    penalty_weight : float, optional
        β of eq. (2); chosen from the noise level when None.
    passes : int, optional
        At most this many passes over the data; the method's own limit when None.
    """

    penalty_weight: float | None = None
    passes: int | None = None


@dataclass(frozen=True)
class Solution:
    """A plane (row, column) in expected electrons, and the record of how it came about."""

    plane: NDArray[np.floating]
    record: dict[str, Any]


def solve(operator: PlaneOperator, images: ElementalImages, method: Method, settings: Settings) -> Solution:
    """Reconstruct one plane of one channel.

    Raises
    ------
    NotConverged
        The penalty weight is too large for the views.
    """
    if method == "backprojection":
        plane = back_projection(operator, images)
        return Solution(plane, _record(plane, None, "none: a mean of the views", 1))
    start = smooth_start(operator, images)
    epsilon = _EPSILON_OF_SCALE * float(np.quantile(start, 0.99)) ** 2
    weight, chosen = _penalty_weight(operator, images, start, method, settings)
    steps: list[Step] = []
    limit = settings.passes or _PASSES[method]
    for iterate in pmlem_one_step_late(operator, images, start, penalty_weight=weight, epsilon=epsilon):
        steps.append(iterate.step)
        if len(steps) >= limit or settled(steps, _SETTLED):
            break
    plane = iterate.plane
    objective = negative_log_likelihood(operator, plane, images) + weight * total_variation(plane, epsilon)
    certificate = {
        "kind": "relative change of the last pass; one-step-late iterations prove no optimum",
        "relative_change": steps[-1].relative_change,
        "settled": settled(steps, _SETTLED),
        "oscillates": oscillates(steps, _SETTLED),
        "kept_at_start": int(np.count_nonzero(~updated_samples(operator.sensitivity(), weight))),
    }
    return Solution(plane, _record(plane, weight, chosen, len(steps), epsilon, objective, certificate))


def _penalty_weight(
    operator: PlaneOperator, images: ElementalImages, start: NDArray[np.floating], method: Method, settings: Settings
) -> tuple[float, str]:
    """Return β and how it was chosen."""
    if method == "mlem":
        return 0.0, "none: maximum likelihood"
    if settings.penalty_weight is not None:
        return settings.penalty_weight, "given"
    return universal_penalty_weight(operator, images, start), "from the noise level"


def _record(
    plane: NDArray[np.floating],
    weight: float | None,
    chosen: str,
    passes: int,
    epsilon: float | None = None,
    objective: float | None = None,
    certificate: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Return what reconstruction.json says of a plane's making."""
    return {
        "penalty_weight": weight,
        "penalty_weight_chosen": chosen,
        "epsilon_e2": epsilon,
        "passes": passes,
        "objective": objective,
        "certificate": certificate,
        "mean_e": float(np.mean(plane, dtype=np.float64)),
    }
