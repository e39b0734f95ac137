"""Back-projections of views that arrive one by one: the mean so far, and how much detail two halves agree on."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.depth.focus import FocusMeasure, shared_detail
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.plane_operator import PlaneOperator

# Least coverage of each half, in views, of samples whose detail counts.
_MIN_COVERAGE = 0.5


class SeenByView(NamedTuple):
    """Contribution of one view to a plane: its light Hᵀ(g − b), and its coverage Hᵀ H 1, both (row, column)."""

    light: Image
    coverage: Image

    def mean(self) -> Image:
        """Return the back-projection of the view alone, zero where it sees nothing."""
        return _quotient(self.light, self.coverage)


def seen_by_view(operator: PlaneOperator, images: ElementalImages, share: float = 1.0) -> SeenByView:
    """Return what the views of an operator, usually one, say of a plane.

    Parameters
    ----------
    operator : PlaneOperator
        H of these views alone.
    images : ElementalImages
        Their images.
    share : float
        Exposure of the images relative to that of a whole view: the mean is in electrons of a whole view.
    """
    light = operator.adjoint(images.electrons)
    if np.any(images.background_e):
        light -= operator.adjoint_of_map(images.background_e)
    return SeenByView(light, operator.coverage() * operator.dtype.type(share))


class RunningPlane:
    """Sums over the views of one plane so far, in two halves; adding a view takes no other view.

    Once all views are added, `mean` is `recon.solver.initialization.back_projection` of them within rounding. It takes
    four arrays of the size of the plane, however many views there are.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the plane.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._light = np.zeros((2, *shape), np.float32)
        self._coverage = np.zeros((2, *shape), np.float32)

    def add(self, view: SeenByView, half: int) -> None:
        """Add what a view says to one half, 0 or 1."""
        self._light[half] += view.light
        self._coverage[half] += view.coverage

    def remove(self, view: SeenByView, half: int) -> None:
        """Take away what was added before; what rounding leaves is a part in ten million."""
        self._light[half] -= view.light
        self._coverage[half] -= view.coverage

    @property
    def covered(self) -> NDArray[np.bool_]:
        """Mask of the samples that at least half a view sees."""
        return np.asarray(self._coverage.sum(axis=0) > _MIN_COVERAGE)

    def mean(self) -> Image:
        """Return the back-projection of all views so far (row, column), in electrons; zero where none sees it."""
        return _quotient(self._light.sum(axis=0), self._coverage.sum(axis=0))

    def focus(self) -> FocusMeasure:
        """Return the power of fine detail that the halves agree on; zero while one of them is empty."""
        both = (self._coverage > _MIN_COVERAGE).all(axis=0)
        first, second = (_quotient(*half) for half in zip(self._light, self._coverage, strict=True))
        return shared_detail(first, second, both)


def _quotient(light: Image, coverage: Image) -> Image:
    """Return light over coverage, zero where next to nothing is covered."""
    return np.divide(light, coverage, out=np.zeros_like(light), where=coverage > 1e-3)
