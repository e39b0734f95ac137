"""The proximal operator of the penalty, solved by its dual to a proven gap.

That is `min ½ Σ w (x − v)² + β Σ φ(|∇(x − x̂)|)` over x ≥ 0, with a proposal x̂ that is zero unless given.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numba
import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.solver import proximal_kernels
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.threads import run_in_threads

# Steps that a strip makes before it exchanges its edges with its neighbours.
_STEPS_PER_EXCHANGE = 10

# Fewest rows of a strip: each strip also works on that many steps' rows of its neighbours.
_MIN_STRIP_ROWS = 64

# Exchanges between measurements of the gap.
_EXCHANGES_PER_CHECK = 2


@dataclass(frozen=True)
class ProxResult:
    """The solution of a proximal problem.

    Attributes
    ----------
    plane : float array (samples)
        x, at least zero.
    gap : float
        Bound on how much its objective exceeds the minimum, in the unit of the objective.
    steps : int
        Steps made on the dual field.
    """

    plane: Image
    gap: float
    steps: int


@dataclass
class DualField:
    """p, the dual field of the penalty: a start for the next problem, which is nearly the same.

    Samples are those of one plane (row, column), or those of several planes (sample,), one plane after the other. Each
    plane is penalised separately.

    Attributes
    ----------
    vectors : list of float array (2, row, column)
        p of each plane, down and right.
    proposal : float array (samples), optional
        x̂, whose difference to the planes is penalised; zero by default.
    workers : int
        Number of threads.
    """

    vectors: list[Image]
    proposal: Image | None = None
    workers: int = field(default_factory=lambda: int(numba.config.NUMBA_NUM_THREADS))

    @classmethod
    def zero(cls, shapes: Sequence[tuple[int, int]], dtype: np.dtype[np.floating]) -> "DualField":
        """Return the field of constant planes of the given shapes."""
        return cls([np.zeros((2, *shape), dtype) for shape in shapes])

    def copy(self) -> "DualField":
        """Return a copy that can be changed without changing this field."""
        return replace(self, vectors=[vectors.copy() for vectors in self.vectors])

    def primal(self, point: Image, reach: Image) -> Image:
        """Return `v − β/w ∇ᵀp` (samples), not clipped at zero, for a point v and a reach β/w."""
        plane = np.empty(point.shape, point.dtype)
        for vectors, (v, r, x) in zip(self.vectors, self._planes(point, reach, plane), strict=True):
            _set_primal(vectors, v, r, x, self.workers)
        return plane

    def penalty_and_slack(self, plane: Image, penalty: Penalty) -> tuple[float, float]:
        """Return `Σ φ(|∇x|)`, and `Σ φ(|∇x|) + φ*(p) − p·∇x ≥ 0`, which is zero where p belongs to x; x is x − x̂."""
        change = plane if self.proposal is None else plane - self.proposal
        sums = [
            _penalty_and_slack(vectors, part, penalty, self.workers)
            for vectors, (part,) in zip(self.vectors, self._planes(change), strict=True)
        ]
        return sum(part[0] for part in sums), sum(part[1] for part in sums)

    def prox(
        self,
        point: Image,
        metric: Image,
        weight: float,
        penalty: Penalty,
        gap_tolerance: Callable[[Image], float],
        max_steps: int,
    ) -> ProxResult:
        """Solve the problem starting from this field, and replace the field by that of the solution.

        Parameters
        ----------
        point, metric : float array (samples)
            v and w > 0.
        weight : float
            β > 0.
        penalty : Penalty
            φ.
        gap_tolerance : callable
            Returns the gap to reach, given x so far. Planes share it equally.
        max_steps : int
            Limit on the steps for each plane, rounded up to the next check of the gap.
        """
        reach = point.dtype.type(weight) / metric
        several = len(self.vectors) > 1
        plane = np.maximum(self.primal(point, reach), 0) if several else np.empty(point.shape, point.dtype)
        gap, steps = 0.0, 0
        # The kernel takes an array without samples for a proposal of zeros
        proposals = [np.empty((0, 0), point.dtype)] * len(self.vectors)
        if self.proposal is not None:
            proposals = [part for (part,) in self._planes(self.proposal)]
        for index, (v, r, x) in enumerate(self._planes(point, reach, plane)):
            ascent = _DualAscent(self.vectors[index], v, r, proposals[index], penalty, self.workers)
            while True:
                ascent.advance()
                gap_of_plane = weight * ascent.set_solution(x)
                if ascent.steps >= max_steps or gap_of_plane <= gap_tolerance(plane) / len(self.vectors):
                    break
            self.vectors[index] = ascent.vectors
            gap, steps = gap + gap_of_plane, max(steps, ascent.steps)
        return ProxResult(plane, gap, steps)

    def _planes(self, *samples: Image) -> Iterator[list[Image]]:
        """Yield the part (row, column) of each array for each plane, as views into the arrays."""
        first = 0
        for vectors in self.vectors:
            shape = vectors.shape[1:]
            stop = first + shape[0] * shape[1]
            yield [array.reshape(-1)[first:stop].reshape(shape) for array in samples]
            first = stop


class _DualAscent:
    """Accelerated projected gradient on the dual of one plane (Beck and Teboulle 2009), in a diagonal metric.

    The acceleration is dropped when it leads uphill (O'Donoghue and Candès 2015).
    """

    def __init__(
        self, vectors: Image, point: Image, reach: Image, proposal: Image, penalty: Penalty, workers: int
    ) -> None:
        self.vectors, self.steps = vectors, 0
        self._ahead, self._momentum = vectors.copy(), 1.0
        self._spare = np.empty_like(vectors), np.empty_like(vectors)
        self._point, self._reach, self._step_sizes = point, reach, step_sizes(reach)
        self._proposal, self._penalty, self._workers = proposal, penalty, workers

    def advance(self) -> None:
        """Make the steps up to the next check of the gap."""
        for _ in range(_EXCHANGES_PER_CHECK):
            momenta, self._momentum = _momenta(self._momentum)
            fields = (self.vectors, self._ahead, *self._spare)
            planes = (self._point, self._reach, self._step_sizes, self._proposal)
            arguments = (*fields, *planes, self._penalty.smoothing_e, self._penalty.bounded, momenta)
            uphill = sum(_on_strips(proximal_kernels.step_strip, len(self._point), self._workers, *arguments))
            self._spare, (self.vectors, self._ahead) = (self.vectors, self._ahead), self._spare
            self.steps += momenta.size
            if uphill > 0:
                self._ahead[:], self._momentum = self.vectors, 1.0

    def set_solution(self, plane: Image) -> float:
        """Write x (row, column) that belongs to the field so far, and return its slack."""
        _set_primal(self.vectors, self._point, self._reach, plane, self._workers)
        np.maximum(plane, 0, out=plane)
        change = plane - self._proposal if self._proposal.size else plane
        return _penalty_and_slack(self.vectors, change, self._penalty, self._workers)[1]


def step_sizes(reach: Image) -> Image:
    """Return the largest steps that are sure to lead downhill: 1/8 of the inverse of β/w, at its largest nearby."""
    largest = reach.copy()
    np.maximum(largest[:-1], reach[1:], out=largest[:-1])
    np.maximum(largest[:, :-1], reach[:, 1:], out=largest[:, :-1])
    return reach.dtype.type(0.125) / largest


def _set_primal(vectors: Image, point: Image, reach: Image, plane: Image, workers: int) -> None:
    """Set a plane (row, column) to `v − β/w ∇ᵀp`."""
    _on_strips(proximal_kernels.primal_of_dual, len(plane), workers, vectors, point, reach, plane)


def _penalty_and_slack(vectors: Image, plane: Image, penalty: Penalty, workers: int) -> tuple[float, float]:
    """Return the penalty and the slack of one plane (row, column)."""
    arguments = (plane, vectors, penalty.smoothing_e, penalty.bounded)
    sums = _on_strips(proximal_kernels.penalty_and_slack, len(plane), workers, *arguments)
    return sum(part[0] for part in sums), sum(part[1] for part in sums)


def _on_strips[Result](kernel: Callable[..., Result], rows: int, workers: int, *arguments: object) -> list[Result]:
    """Call a kernel with the first and past-the-last row of every strip, in threads when there are several strips."""
    count = max(1, min(workers, rows // _MIN_STRIP_ROWS))
    edges = np.linspace(0, rows, count + 1).astype(int).tolist()
    return run_in_threads(lambda strip: kernel(*strip, *arguments), list(pairwise(edges)))


def _momenta(t: float) -> tuple[NDArray[np.float64], float]:
    """Return the extrapolations of the next steps, and the state of their sequence after them."""
    momenta = np.empty(_STEPS_PER_EXCHANGE)
    for n in range(_STEPS_PER_EXCHANGE):
        t_next = (1 + (1 + 4 * t * t) ** 0.5) / 2
        momenta[n] = (t - 1) / t_next
        t = t_next
    return momenta, t
