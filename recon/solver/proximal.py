"""The nearest plane of little penalty: `min ½ Σ w (x − v)² + β Σ φ(|∇x|)` over x ≥ 0, by its dual, to a proven gap."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.solver import proximal_kernels
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.threads import at_once

# Steps that a strip makes before it exchanges its edges with its neighbours, and the least rows of a strip.
_STEPS_AT_ONCE = 10
_STRIP_ROWS = 64

# The gap is measured, and acceleration reconsidered, after so many exchanges.
_EXCHANGES_PER_CHECK = 2


@dataclass(frozen=True)
class Nearest:
    """The plane found, and how well.

    Attributes
    ----------
    plane : float array (row, column)
        At least zero.
    gap : float
        By how much its objective exceeds the least there is, at most; in the unit of the objective.
    steps : int
        Steps on the dual field that were made.
    """

    plane: Image
    gap: float
    steps: int


@dataclass
class DualField:
    """The penalty's dual field, carried from one problem to the next, which it fits nearly.

    Attributes
    ----------
    vectors : float array (2, row, column)
        p, down and right.
    workers : int
        Threads.
    """

    vectors: Image
    workers: int = field(default_factory=lambda: int(numba.config.NUMBA_NUM_THREADS))

    @classmethod
    def zero(cls, shape: tuple[int, int], dtype: np.dtype[np.floating]) -> "DualField":
        """Return the field of a constant plane."""
        return cls(np.zeros((2, *shape), dtype))

    def copy(self) -> "DualField":
        """Return a copy that can be changed without changing this one."""
        return DualField(self.vectors.copy(), self.workers)

    def plane(self, centre: Image, reach: Image) -> Image:
        """Return `v − β/w ∇ᵀp` (row, column), not clipped at zero."""
        plane = np.empty_like(centre)
        rows = centre.shape[0]
        self._each_strip(rows, lambda a, b: proximal_kernels.plane_of_dual(a, b, self.vectors, centre, reach, plane))
        return plane

    def penalty_and_slack(self, plane: Image, penalty: Penalty) -> tuple[float, float]:
        """Return `Σ φ(|∇x|)` of a plane, and `Σ φ(|∇x|) + φ*(p) − p·∇x ≥ 0`, which is zero where p belongs to x."""
        shape = (penalty.smoothing_e, penalty.bounded)
        sums = self._each_strip(
            plane.shape[0], lambda a, b: proximal_kernels.penalty_and_slack(a, b, plane, self.vectors, *shape)
        )
        return sum(part[0] for part in sums), sum(part[1] for part in sums)

    def nearest(
        self, centre: Image, metric: Image, weight: float, penalty: Penalty, enough: Callable[[Image], float], most: int
    ) -> Nearest:
        """Solve the problem with this field to start from; leave in it the one that belongs to the solution.

        Accelerated projected gradient (Beck and Teboulle 2009) on the dual, in a diagonal metric, with the acceleration
        dropped when it leads uphill (O'Donoghue and Candès 2015).

        Parameters
        ----------
        centre, metric : float array (row, column)
            v and w > 0.
        weight : float
            β > 0.
        penalty : Penalty
            φ.
        enough : callable
            The gap that will do, given the plane so far.
        most : int
            Steps that are made at most, to the next multiple of what is made at once.
        """
        reach = centre.dtype.type(weight) / metric
        steps = step_sizes(reach)
        ahead, made, momentum = self.vectors.copy(), 0, 1.0
        spare = np.empty_like(self.vectors), np.empty_like(self.vectors)
        shape = (penalty.smoothing_e, penalty.bounded)
        while True:
            for _ in range(_EXCHANGES_PER_CHECK):
                momenta, momentum = _momenta(momentum)
                arrays = (self.vectors, ahead, *spare, centre, reach, steps)
                uphill = self._steps(arrays, (*shape, momenta))
                old, (self.vectors, ahead) = (self.vectors, ahead), spare
                spare = old
                made += momenta.size
                if uphill > 0:
                    ahead[:], momentum = self.vectors, 1.0
            plane = np.maximum(self.plane(centre, reach), 0)
            gap = weight * self.penalty_and_slack(plane, penalty)[1]
            if made >= most or gap <= enough(plane):
                return Nearest(plane, gap, made)

    def _steps(self, arrays: tuple[Image, ...], options: tuple[Any, ...]) -> float:
        """Make some steps on all strips; return how far they and the acceleration disagree, above 0 for uphill."""
        sums = self._each_strip(
            self.vectors.shape[1], lambda a, b: proximal_kernels.step_strip(a, b, *arrays, *options)
        )
        return float(sum(sums))

    def _each_strip[Result](self, rows: int, work: Callable[[int, int], Result]) -> list[Result]:
        """Call a function for the first and last row of every strip, in threads when there are several."""
        count = max(1, min(self.workers, rows // _STRIP_ROWS))
        edges = np.linspace(0, rows, count + 1).astype(int).tolist()
        return at_once(lambda strip: work(*strip), list(pairwise(edges)))


def compile_kernels() -> None:
    """Compile what float32 planes need, unless the cache beside the code has it."""
    ones = np.ones((2, 2), np.float32)
    DualField.zero((2, 2), ones.dtype).nearest(ones, ones, 1.0, Penalty(), lambda _: 0.0, 1)


def step_sizes(reach: Image) -> Image:
    """Return the largest steps that are sure to lead downhill: 1/8 of the inverse of β/w, at its largest nearby."""
    largest = reach.copy()
    np.maximum(largest[:-1], reach[1:], out=largest[:-1])
    np.maximum(largest[:, :-1], reach[:, 1:], out=largest[:, :-1])
    return reach.dtype.type(0.125) / largest


def _momenta(t: float) -> tuple[NDArray[np.float64], float]:
    """Return the extrapolations of the next steps, and where their sequence stands after them."""
    momenta = np.empty(_STEPS_AT_ONCE)
    for n in range(_STEPS_AT_ONCE):
        t_next = (1 + (1 + 4 * t * t) ** 0.5) / 2
        momenta[n] = (t - 1) / t_next
        t = t_next
    return momenta, t
