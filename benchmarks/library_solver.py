"""The same problem solved by pyproximal's primal-dual iteration, on the same operator."""

from collections.abc import Iterator
from importlib.util import find_spec
from queue import Queue
from threading import Thread
from typing import Any

import numpy as np

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.plane_operator import PlaneOperator

_NORM_OF_GRADIENT = 8**0.5
_STEPS = 4000


def primal_dual(
    operator: PlaneOperator, images: ElementalImages, start: Image, weight: float, optimum: Image
) -> Iterator[Image] | None:
    """Return iterates of Chambolle and Pock's algorithm for `min L(f) + β TV(f), f ≥ 0`; None without pyproximal.

    The data and the gradient of the plane are two blocks of one linear operator, scaled to equal norms. The ratio
    of its step lengths, which determines its speed, is the best in theory: ‖f*‖/‖y*‖ of the solution itself.
    """
    if not (find_spec("pyproximal") and find_spec("pylops")):
        return None
    return _in_thread(operator, images, start, weight, optimum)


def _in_thread(
    operator: PlaneOperator, images: ElementalImages, start: Image, weight: float, optimum: Image
) -> Iterator[Image]:
    """Yield the iterates that the library passes to its callback; it waits until the last one is taken."""
    made: Queue[Image] = Queue(1)
    stopped: list[bool] = []

    def callback(plane: Image) -> None:
        if stopped:
            raise StopIteration
        made.put(plane.reshape(operator.grid.shape).copy())

    def work() -> None:
        try:
            _solve(operator, images, start, weight, optimum, callback)
        except StopIteration:
            pass

    thread = Thread(target=work, daemon=True)
    thread.start()
    try:
        for _ in range(_STEPS):
            yield made.get()
    finally:
        stopped.append(True)
        while thread.is_alive():
            while not made.empty():
                made.get()
            thread.join(0.05)


def _solve(
    operator: PlaneOperator, images: ElementalImages, start: Image, weight: float, optimum: Image, callback: Any
) -> None:
    """Run the library's iteration."""
    import pylops
    import pyproximal

    shape, views = operator.grid.shape, operator.images_shape
    norm = _norm(operator)
    scale = norm / _NORM_OF_GRADIENT
    forward = pylops.FunctionOperator(
        lambda x: operator.forward(x.reshape(shape).astype(np.float32)).ravel(),
        lambda y: operator.adjoint(y.reshape(views).astype(np.float32)).ravel(),
        int(np.prod(views)),
        int(np.prod(shape)),
        dtype=np.float32,
    )
    both = pylops.VStack([forward, scale * pylops.Gradient(shape, edge=False, kind="forward", dtype=np.float32)])
    seen, variance = operator.forward(optimum), np.asarray(images.read_variance_e2, np.float32)
    known = np.broadcast_to(np.asarray(images.background_e, np.float32) + variance, views).ravel()
    shifted = np.maximum(images.electrons + variance, 0).ravel()
    counts = (operator.forward(np.ones(shape, np.float32)) != 0).ravel()

    class ShiftedPoisson(pyproximal.ProxOperator):  # type: ignore[misc]
        """Σ m − y ln m with m = x + b + σ², whose proximal point is the root of a quadratic."""

        def __call__(self, x: Image) -> float:
            mean = (x + known)[counts]
            return float(np.sum(mean - shifted[counts] * np.log(mean)))

        def prox(self, x: Image, tau: float) -> Image:
            half = (x + known - np.float32(tau)) * np.float32(0.5)
            mean = half + np.sqrt(half * half + np.float32(tau) * shifted)
            return np.where(counts, mean - known, x)

    dual = np.linalg.norm((1 - shifted / (seen.ravel() + known))[counts])
    ratio = float(np.linalg.norm(optimum) / dual)
    penalty = pyproximal.L21(ndim=2, sigma=weight / scale)
    length = 0.99 / (norm * 2**0.5)
    pyproximal.optimization.primaldual.PrimalDual(
        pyproximal.Box(lower=0.0),
        pyproximal.VStack([ShiftedPoisson(), penalty], nn=[int(np.prod(views)), 2 * int(np.prod(shape))]),
        both,
        start.ravel().copy(),
        tau=length * ratio,
        mu=length / ratio,
        niter=_STEPS,
        callback=callback,
    )


def _norm(operator: PlaneOperator) -> float:
    """Return ‖H‖ by power iteration."""
    plane = np.ones(operator.grid.shape, np.float32)
    for _ in range(15):
        plane = operator.adjoint(operator.forward(plane / np.linalg.norm(plane)))
    return float(np.sqrt(np.linalg.norm(plane)))
