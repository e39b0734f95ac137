"""The proximal operator of the penalty, solved by a primal-dual iteration to a proven gap.

That is `min ½ Σ w (x − v)² + β Σ φ(|∇(x − x̂)|)` over x ≥ 0, with a proposal x̂ that is zero unless given.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import ClassVar, NamedTuple, Self

import numba
import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.solver import proximal_kernels
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.threads import elementwise, run_in_threads

# Steps that a strip makes before it exchanges its edges with its neighbours, and its fewest rows: it also works on as
# many rows of its neighbours as it makes steps.
_STEPS_PER_EXCHANGE, _MIN_STRIP_ROWS = 20, 64

# Columns of a tile of a strip, about: the rows in work of wider ones do not stay in the cache.
_TILE_COLUMNS = 1024

# The gap is measured after this share of the steps so far, at least after one exchange.
_CHECK_SHARE = 0.1

# Samples along a side of the coarsest problem from which others begin, and most steps that each of these makes.
_COARSEST, _MAX_COARSE_STEPS = 64, 600

# Length of the first step on the plane in the metric, and the strong convexity that the acceleration relies on; the
# metric's own is 1, and less converges faster.
_FIRST_LENGTH, _CONVEXITY = 1.0, 0.6


type _Pair = tuple[float, float]


class ProxResult(NamedTuple):
    """Solution of a proximal problem.

    Attributes
    ----------
    plane : float array (samples)
        The solution x ≥ 0.
    gap : float
        Bound on the excess of the objective over its minimum.
    steps : int
        Number of steps.
    """

    plane: Image
    gap: float
    steps: int


@dataclass
class DualField:
    """p, the dual field of the penalty: a start for the next problem, which is nearly the same.

    Samples are those of one plane (row, column), or of several planes (sample,), one after the other and each penalised
    separately.

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

    # True if it proves how far a plane is from the optimum
    certifies: ClassVar[bool] = True

    @classmethod
    def zero(cls, shapes: Sequence[tuple[int, int]], dtype: np.dtype[np.floating]) -> "DualField":
        """Return the field of constant planes of the given shapes."""
        return cls([np.zeros((2, *shape), dtype) for shape in shapes])

    def copy(self) -> Self:
        """Return a copy that can be changed without changing this field."""
        return replace(self, vectors=[vectors.copy() for vectors in self.vectors])

    def begin_coarse(self, point: Image, metric: Image, weight: float, penalty: Penalty, gap: float) -> None:
        """Set this field to that of planes of half as many rows and columns: a start from which fewer steps are left.

        A field that has begun stays, and so does that of a φ of unbounded slope.
        Light is averaged over wide even parts in few steps on coarse samples and in many on fine ones. A sum over 2 x 2
        samples of the quadratic is that of a coarse sample; its steps to the next count along two fine edges, so
        that β is twice as large. Coarse problems, too, begin with coarser ones, and are solved until their gap is
        `gap`. The other parameters are as for `prox`. Vectors may be longer than one, which the first step mends.
        """
        if not penalty.bounded or any(vectors.any() for vectors in self.vectors):
            return
        for vectors, (v, w, *x) in zip(
            self.vectors,
            self._planes(point, metric, *([] if self.proposal is None else [self.proposal])),
            strict=True,
        ):
            if min(v.shape) >= 2 * _COARSEST:
                coarse_w = _sums_of_four(w)
                coarse = DualField.zero([coarse_w.shape], v.dtype)
                coarse.proposal, coarse.workers = (_sums_of_four(x[0]) / v.dtype.type(4) if x else None), self.workers
                problem = _sums_of_four(w * v) / coarse_w, coarse_w, 2 * weight, penalty
                coarse.begin_coarse(*problem, gap)
                coarse.prox(*problem, lambda _: gap, _MAX_COARSE_STEPS)
                rows = _edges(coarse_w.shape[0], self.workers)
                _on_strips(proximal_kernels.interpolate_edges, rows, coarse.vectors[0], vectors)

    def primal(self, point: Image, reach: Image) -> Image:
        """Return `v − β/w ∇ᵀp` (samples), not clipped at zero, for a point v and a reach β/w."""
        plane = np.empty(point.shape, point.dtype)
        for vectors, part in zip(self.vectors, self._planes(point, reach, plane), strict=True):
            _on_strips(proximal_kernels.primal_of_dual, _edges(vectors.shape[1], self.workers), vectors, *part)
        return plane

    def distance_from_primal(self, plane: Image, point: Image, metric: Image, weight: float) -> _Pair:
        """Return `Σ ½ w (x − u₊)²` and `Σ w (−u)₊ x` for planes x ≥ 0 and the primal `u = v − β/w ∇ᵀp`."""
        parts = zip(self.vectors, self._planes(plane, point, metric), strict=True)
        return _sum(_distance(x, vectors, v, w, weight, self.workers) for vectors, (x, v, w) in parts)

    def penalty_and_slack(self, plane: Image, penalty: Penalty) -> _Pair:
        """Return `Σ φ(|∇x|)`, and `Σ φ(|∇x|) + φ*(p) − p·∇x ≥ 0`, which is zero where p belongs to x; x is x − x̂."""
        change = plane if self.proposal is None else elementwise(np.subtract, plane, self.proposal)
        parts = zip(self.vectors, self._planes(change), strict=True)
        return _sum(_penalty_and_slack(vectors, part, penalty, self.workers) for vectors, (part,) in parts)

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
        point, metric, weight, penalty : float array (samples), float array (samples), float, Penalty
            v, w > 0, β > 0 and φ.
        gap_tolerance : callable
            Returns the gap to reach, given x so far. Planes share it equally.
        max_steps : int
            Limit on the steps for each plane, rounded up to the next check of the gap.
        """
        scaled = point.dtype.type(weight)
        reach = elementwise(lambda w: scaled / w, metric)
        plane = self.primal(point, reach)
        np.maximum(plane, 0, out=plane)
        gap, steps = 0.0, 0
        # The kernel takes an array without samples for a proposal of zeros
        proposals = [np.empty((0, 0), point.dtype)] * len(self.vectors)
        if self.proposal is not None:
            proposals = [part for (part,) in self._planes(self.proposal)]
        for index, (v, r, x, w) in enumerate(self._planes(point, reach, plane, metric)):
            iteration = _PrimalDual(self.vectors[index], x, v, r, proposals[index], penalty, self.workers)
            while True:
                iteration.advance()
                gap_of_plane, is_proposal = iteration.gap(w, weight)
                if iteration.steps >= max_steps or gap_of_plane <= gap_tolerance(plane) / len(self.vectors):
                    break
            if is_proposal:
                x[:] = proposals[index]
            gap, steps = gap + gap_of_plane, max(steps, iteration.steps)
        return ProxResult(plane, gap, steps)

    def _planes(self, *samples: Image) -> Iterator[list[Image]]:
        """Yield the part (row, column) of each array for each plane, as views into the arrays."""
        first = 0
        for vectors in self.vectors:
            shape = vectors.shape[1:]
            stop = first + shape[0] * shape[1]
            yield [array.reshape(-1)[first:stop].reshape(shape) for array in samples]
            first = stop


class _PrimalDual:
    """The accelerated primal-dual iteration (Chambolle and Pock 2011, algorithm 2), in a diagonal metric.

    It changes p and x of one plane, which belong to the caller. Its x is much nearer the minimum than the primal of p.
    """

    def __init__(
        self, vectors: Image, plane: Image, point: Image, reach: Image, proposal: Image, penalty: Penalty, workers: int
    ) -> None:
        self.steps = 0
        self._length = _FIRST_LENGTH
        self._ahead = plane - proposal if proposal.size else plane.copy()
        self._changed = vectors, plane, self._ahead
        self._fixed = point, reach, step_sizes(reach), proposal, penalty.smoothing_e, penalty.bounded
        self._point, self._proposal, self._penalty = point, proposal, penalty
        self._may_stay = proposal.size > 0 and penalty.smoothing_e == 0 and bool(proposal.min() >= 0)
        self._edges, self._workers = _edges(len(plane), workers), workers
        tiles = max(round(plane.shape[1] / _TILE_COLUMNS), 1)
        self._column_edges = [tile * plane.shape[1] // tiles for tile in range(tiles + 1)]

    def advance(self) -> None:
        for _ in range(max(round(_CHECK_SHARE * self.steps / _STEPS_PER_EXCHANGE), 1)):
            # Neighbours change their rows and columns while a tile is in work
            rows = {row: self._around_edge(row, 0) for row in self._edges}
            columns = {column: self._around_edge(column, 1) for column in self._column_edges}
            step = partial(self._step_strip, self._next_steps(), rows, columns)
            run_in_threads(step, list(pairwise(self._edges)))
            self.steps += _STEPS_PER_EXCHANGE

    def _step_strip(
        self,
        steps: tuple[NDArray[np.float64], NDArray[np.float64]],
        rows: Mapping[int, tuple[Image, Image]],
        columns: Mapping[int, tuple[Image, Image]],
        strip: tuple[int, int],
    ) -> None:
        """Make steps on a strip tile by tile, given what lies before and after each of its edges."""
        first, stop = strip
        for left, right in pairwise(self._column_edges):
            around = rows[first][0], rows[stop][1], columns[left][0], columns[right][1]
            proximal_kernels.step_tile(first, stop, left, right, *around, *self._changed, *self._fixed, *steps)

    def gap(self, metric: Image, weight: float) -> tuple[float, bool]:
        """Return a bound on the gap, and True if it is that of the proposal in place of x.

        The change of x from its proposal x̂ has small waves for long after p is right, and where x̂ is nearly the
        minimum they make up most of the gap q + l + s: square q and excess l are those from the primal of p, s is the
        slack of the penalty, of which x̂ has none. The bound for x̂ is `(√q + √(q + l))² ≥ q + l`, half the square of
        that which `recon.solver.pmlem.Certificate` gives. Proposals with negative light, and smoothed penalties, are
        left out.
        """
        vectors, plane, _ = self._changed
        change = elementwise(np.subtract, plane, self._proposal) if self._proposal.size else plane
        slack = _penalty_and_slack(vectors, change, self._penalty, self._workers)[1]
        problem = vectors, self._point, metric, weight, self._workers
        gap = float(sum(_distance(plane, *problem)) + weight * slack)
        if self._may_stay:
            square, excess = _distance(self._proposal, *problem)
            of_proposal = float(np.sqrt(square) + np.sqrt(square + excess)) ** 2
            if of_proposal < gap:
                return of_proposal, True
        return gap, False

    def _next_steps(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        lengths, momenta = np.empty((2, _STEPS_PER_EXCHANGE))
        for n in range(_STEPS_PER_EXCHANGE):
            lengths[n], momenta[n] = self._length, (1 + 2 * _CONVEXITY * self._length) ** -0.5
            self._length *= float(momenta[n])
        return lengths, momenta

    def _around_edge(self, edge: int, axis: int) -> tuple[Image, Image]:
        """Return copies (4, row, column) of p, x and x ahead before and after an edge, as far as the plane has them."""
        vectors, *planes = self._changed
        before, after = slice(max(edge - _STEPS_PER_EXCHANGE, 0), edge), slice(edge, edge + _STEPS_PER_EXCHANGE)

        def copied(part: slice) -> Image:
            at = (part, slice(None)) if axis == 0 else (slice(None), part)
            return np.stack([array[at] for array in (*vectors, *planes)])

        return copied(before), copied(after)


def _sums_of_four(picture: Image) -> Image:
    """Return the sums of 2 x 2 samples of a picture (row, column); at an odd edge, of those that there are."""
    rows, columns = picture.shape
    padded = np.pad(picture, ((0, rows % 2), (0, columns % 2))) if rows % 2 or columns % 2 else picture
    sums: Image = padded[::2, ::2] + padded[1::2, ::2]
    sums += padded[::2, 1::2]
    sums += padded[1::2, 1::2]
    return sums


def step_sizes(reach: Image) -> Image:
    """Return steps on p: 0.15 of the inverse of β/w, at its largest nearby.

    With |∇|² < 8, those shorter than 1/6 are known to converge (Banert, Upadhyaya and Giselsson 2023). They need a
    tenth fewer steps than the 1/8 of Chambolle and Pock.
    """
    largest = reach.copy()
    np.maximum(largest[:-1], reach[1:], out=largest[:-1])
    np.maximum(largest[:, :-1], reach[:, 1:], out=largest[:, :-1])
    return np.divide(reach.dtype.type(0.15), largest, out=largest)


def _distance(plane: Image, vectors: Image, point: Image, metric: Image, weight: float, workers: int) -> _Pair:
    arguments = (plane, vectors, point, metric, plane.dtype.type(weight))
    return _sum(_on_strips(proximal_kernels.distance_from_primal, _edges(len(plane), workers), *arguments))


def _penalty_and_slack(vectors: Image, plane: Image, penalty: Penalty, workers: int) -> _Pair:
    arguments = (plane, vectors, penalty.smoothing_e, penalty.bounded)
    return _sum(_on_strips(proximal_kernels.penalty_and_slack, _edges(len(plane), workers), *arguments))


def _sum(pairs: Iterable[Sequence[float]]) -> _Pair:
    first, second = map(sum, zip(*pairs, strict=True))
    return float(first), float(second)


def _edges(rows: int, workers: int) -> list[int]:
    """Return the first row of every strip, and the number of rows."""
    count = max(1, min(workers, rows // _MIN_STRIP_ROWS))
    return [strip * rows // count for strip in range(count + 1)]


def _on_strips[Result](kernel: Callable[..., Result], edges: Sequence[int], *arguments: object) -> list[Result]:
    """Call a kernel with the first and past-the-last row of every strip, in threads."""
    return run_in_threads(lambda strip: kernel(*strip, *arguments), list(pairwise(edges)))
