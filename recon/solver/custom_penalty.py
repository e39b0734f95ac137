"""Penalties of one's own: any R(f) whose proximal operator is known takes the place of total variation in PMLEM."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np

from faintfield.recon.likelihood.images import Image
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.proximal import DualField, ProxResult
from faintfield.recon.threads import elementwise


class ProximalPenalty(Protocol):
    """A convex penalty R(f) ≥ 0 on a plane, by its value and its proximal operator.

    Any object with these two methods can be given where a penalty is asked for. Several threads may call them at a
    time, for parts of a large plane.

    Examples
    --------
    Tikhonov's penalty, half the sum of squares, which draws dark samples to zero:

    >>> import numpy as np
    >>> class Tikhonov:
    ...     def value(self, plane):
    ...         return 0.5 * float(np.vdot(plane, plane))
    ...
    ...     def prox(self, point, metric, weight):
    ...         return np.maximum(metric * point / (metric + weight), 0)
    >>> Tikhonov().prox(np.array([[2.0, -1.0]]), np.array([[1.0, 1.0]]), 1.0)
    array([[1., 0.]])
    """

    def value(self, plane: Image) -> float:
        """Return R(f) of a plane (row, column)."""

    def prox(self, point: Image, metric: Image, weight: float) -> Image:
        """Return the x ≥ 0 of least `½ Σ w (x − v)² + weight · R(x)`; v, w > 0 and x are arrays (row, column)."""


@dataclass
class ProximalField(DualField):
    """The inner problem of PMLEM with a penalty of one's own, in the place of a dual field.

    It has no dual vectors and proves no distance to the optimum: that the curvature of the likelihood is at least half
    its metric, on which the proof stands, holds only for planes that a penalty makes smooth.
    """

    penalty: ProximalPenalty | None = None
    certifies = False

    @classmethod
    def of(cls, penalty: ProximalPenalty, dual: DualField) -> Self:
        """Return the field of a penalty on planes of the shapes of another field."""
        vectors = [np.broadcast_to(part.dtype.type(0), part.shape) for part in dual.vectors]  # takes no memory
        return cls(vectors, workers=dual.workers, penalty=penalty)

    def copy(self) -> Self:
        """Return this field: nothing in it changes."""
        return self

    def begin_coarse(self, point: Image, metric: Image, weight: float, penalty: Penalty, gap: float) -> None:
        """Do nothing: there are no vectors to begin with."""

    def penalty_and_slack(self, plane: Image, penalty: Penalty) -> tuple[float, float]:
        """Return R(f), the sum of that of each plane, and a slack of zero."""
        assert self.penalty is not None
        return sum(self.penalty.value(part) for (part,) in self._planes(plane)), 0.0

    def distance_from_primal(self, plane: Image, point: Image, metric: Image, weight: float) -> tuple[float, float]:
        """Return `Σ ½ w (f − x)²`, where x is the result of the next step, and zero."""
        change = elementwise(np.subtract, plane, self._minimum(point, metric, weight))
        return 0.5 * float(np.sum(metric * np.square(change, out=change), dtype=np.float64)), 0.0

    def prox(
        self,
        point: Image,
        metric: Image,
        weight: float,
        penalty: Penalty,
        gap_tolerance: Callable[[Image], float],
        max_steps: int,
    ) -> ProxResult:
        """Return the minimum by the penalty's own operator, in one step."""
        return ProxResult(self._minimum(point, metric, weight), 0.0, 1)

    def _minimum(self, point: Image, metric: Image, weight: float) -> Image:
        assert self.penalty is not None
        minimum = np.empty_like(point)
        for v, w, x in self._planes(point, metric, minimum):
            part = np.asarray(self.penalty.prox(v, w, weight))
            if part.shape != v.shape or not ((part >= 0) & (part < np.inf)).all():
                raise ValueError(
                    f"{type(self.penalty).__name__}.prox returned an array of shape {part.shape} with a least value of "
                    f"{part.min(initial=0.0):g}; it must return finite samples of shape {v.shape}, none negative"
                )
            x[:] = part
        return minimum
