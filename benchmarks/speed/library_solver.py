"""The same problem solved by the primal-dual iterations of pyproximal and of ODL, on the same operator."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from queue import Queue
from threading import Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.linear import linear_operator
from faintfield.recon.operator.single_plane import PlaneOperator

_NORM_OF_GRADIENT = 8**0.5
_STEPS = 4000


@dataclass(frozen=True)
class LibraryProblem:
    """`min L(f) + β TV(f), f ≥ 0` as two blocks of one linear operator: the data and the gradient of the plane.

    The gradient is scaled to the norm of H. The ratio of the step lengths, which determines the speed of Chambolle and
    Pock's algorithm, is the best in theory: ‖f*‖/‖y*‖ of the solution itself.

    Parameters
    ----------
    operator, images
        H and the data; the likelihood is shifted Poisson.
    start, optimum : float array (row, column)
        f at the first iteration, and the solution.
    weight : float
        β.
    """

    operator: PlaneOperator
    images: ElementalImages
    start: Image
    weight: float
    optimum: Image

    @cached_property
    def norm(self) -> float:
        """‖H‖ by power iteration."""
        plane = np.ones(self.operator.grid.shape, np.float32)
        for _ in range(15):
            plane = self.operator.adjoint(self.operator.forward(plane / np.linalg.norm(plane)))
        return float(np.sqrt(np.linalg.norm(plane)))

    @property
    def scale(self) -> float:
        """Factor of the gradient."""
        return self.norm / _NORM_OF_GRADIENT

    @property
    def lengths(self) -> tuple[float, float]:
        """The steps on the plane and on the dual."""
        seen = self.operator.forward(self.optimum)
        dual = np.linalg.norm((1 - self.shifted / (seen + self.known))[self.counts])
        ratio = float(np.linalg.norm(self.optimum) / dual)
        length = 0.99 / (self.norm * 2**0.5)
        return length * ratio, length / ratio

    @cached_property
    def known(self) -> Image:
        """Background plus variance of each pixel (view, row, column)."""
        variance = np.asarray(self.images.read_variance_e2, np.float32)
        known = np.asarray(self.images.background_e, np.float32) + variance
        return np.array(np.broadcast_to(known, self.operator.images_shape))

    @cached_property
    def shifted(self) -> Image:
        """Data plus variance, at least zero."""
        variance = np.asarray(self.images.read_variance_e2, np.float32)
        return np.asarray(np.maximum(self.images.electrons + variance, 0))

    @cached_property
    def counts(self) -> NDArray[np.bool_]:
        """Mask of the pixels that see the plane."""
        return np.asarray(self.operator.forward(np.ones(self.operator.grid.shape, np.float32)) != 0)

    def prox_of_data(self, x: Image, length: float) -> Image:
        """Return the proximal point of Σ m − y ln m with m = x + b + σ²: the root of a quadratic."""
        half = (x + self.known - np.float32(length)) * np.float32(0.5)
        mean = half + np.sqrt(half * half + np.float32(length) * self.shifted)
        return np.where(self.counts, mean - self.known, x)


type Solver = Callable[[LibraryProblem, Callable[[Image], None]], None]


def iterates_of(solver: Solver, problem: LibraryProblem) -> Iterator[Image]:
    """Yield the iterates that a library passes to its callback; it waits until the last one is taken."""
    made: Queue[Image | BaseException] = Queue(1)
    stopped: list[bool] = []

    def callback(plane: Image) -> None:
        if stopped:
            raise StopIteration
        made.put(plane.reshape(problem.operator.grid.shape).copy())

    def work() -> None:
        try:
            solver(problem, callback)
        except StopIteration:
            pass
        except BaseException as failure:
            made.put(failure)

    thread = Thread(target=work, daemon=True)
    thread.start()
    try:
        for _ in range(_STEPS):
            found = made.get()
            if isinstance(found, BaseException):
                raise found
            yield found
    finally:
        stopped.append(True)
        while thread.is_alive():
            while not made.empty():
                made.get()
            thread.join(0.05)


def installed_solvers() -> dict[str, Solver | None]:
    """Return the solver of each library, None for those that are not installed."""
    both = find_spec("pyproximal") and find_spec("pylops")
    return {"pyproximal": solve_by_pyproximal if both else None, "odl": solve_by_odl if find_spec("odl") else None}


def solve_by_pyproximal(problem: LibraryProblem, callback: Callable[[Image], None]) -> None:
    """Run pyproximal's iteration."""
    import pylops
    import pyproximal

    operator, shape, views = problem.operator, problem.operator.grid.shape, problem.operator.images_shape
    forward = pylops.LinearOperator(linear_operator(operator))
    gradient = pylops.Gradient(shape, edge=False, kind="forward", dtype=np.float32)

    class ShiftedPoisson(pyproximal.ProxOperator):  # type: ignore[misc]
        """The negative log-likelihood, of which the iteration takes the proximal point alone."""

        def __call__(self, x: Image) -> float:
            return float("nan")

        def prox(self, x: Image, tau: float) -> Image:
            return problem.prox_of_data(x.reshape(views), tau).ravel()

    on_plane, on_dual = problem.lengths
    penalty = pyproximal.L21(ndim=2, sigma=problem.weight / problem.scale)
    pyproximal.optimization.primaldual.PrimalDual(
        pyproximal.Box(lower=0.0),
        pyproximal.VStack([ShiftedPoisson(), penalty], nn=[int(np.prod(views)), 2 * int(np.prod(shape))]),
        pylops.VStack([forward, problem.scale * gradient]),
        problem.start.ravel().copy(),
        tau=on_plane,
        mu=on_dual,
        niter=_STEPS,
        callback=callback,
    )


def solve_by_odl(problem: LibraryProblem, callback: Callable[[Image], None]) -> None:
    """Run ODL's iteration."""
    import odl

    shape = problem.operator.grid.shape
    plane = odl.uniform_discr([0, 0], shape, shape, dtype="float32")
    images = odl.rn(problem.operator.images_shape, dtype="float32")

    class Adjoint(odl.Operator):  # type: ignore[misc]
        """Hᵀ."""

        def __init__(self) -> None:
            super().__init__(images, plane, linear=True)

        def _call(self, x: Any) -> Any:
            return plane.element(problem.operator.adjoint(x.asarray()))

    class Forward(odl.Operator):  # type: ignore[misc]
        """H."""

        def __init__(self) -> None:
            super().__init__(plane, images, linear=True)

        def _call(self, x: Any) -> Any:
            return images.element(problem.operator.forward(x.asarray()))

        @property
        def adjoint(self) -> Adjoint:
            return Adjoint()

    class ShiftedPoisson(odl.functionals.Functional):  # type: ignore[misc]
        """The negative log-likelihood, of which the iteration takes the proximal point alone."""

        def __init__(self) -> None:
            super().__init__(images, linear=False)

        @property
        def proximal(self) -> Callable[[float], Any]:
            def at(length: float) -> Any:
                class Proximal(odl.Operator):  # type: ignore[misc]
                    def __init__(self) -> None:
                        super().__init__(images, images, linear=False)

                    def _call(self, x: Any) -> Any:
                        return images.element(problem.prox_of_data(x.asarray(), float(length)))

                return Proximal()

            return at

    gradient = problem.scale * odl.Gradient(plane, method="forward", pad_mode="symmetric")
    penalty = (problem.weight / problem.scale) * odl.functionals.GroupL1Norm(gradient.range, exponent=2)
    on_plane, on_dual = problem.lengths
    odl.solvers.pdhg(
        plane.element(problem.start.copy()),
        odl.functionals.IndicatorNonnegativity(plane),
        odl.functionals.SeparableSum(ShiftedPoisson(), penalty),
        odl.BroadcastOperator(Forward(), gradient),
        _STEPS,
        tau=on_plane,
        sigma=on_dual,
        callback=lambda x: callback(x.asarray()),
    )
