"""Test whether the views contradict planes by more than their noise: then noise is not what limits them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator

# Largest excess of the squares of residuals over their variance in detail, and largest of detail over smooth parts: a
# calibration of the noise may be off by a percent everywhere. Chosen on `CHOSEN_ON` in benchmarks/uncertainty.py.
_MAX_EXCESS, _MAX_BEYOND_SMOOTH = 0.006, 0.012

# Standard errors that are added to both.
_SIGMAS = 2.0


class Misfit(NamedTuple):
    """Squares of a plane's residuals over their variance.

    Attributes
    ----------
    detail, smooth : float
        Their mean where the plane has detail, and where it has light but none; one for the right model.
    se : float
        Standard error of their difference by chance.
    """

    detail: float
    smooth: float
    se: float

    @property
    def contradicts(self) -> bool:
        """Return whether the residuals in detail are larger than noise makes them, and larger than elsewhere."""
        chance = _SIGMAS * self.se
        return self.detail - 1 > _MAX_EXCESS + chance and self.detail - self.smooth > _MAX_BEYOND_SMOOTH + chance


def misfits(
    operator: SceneOperator, images: ElementalImages, samples: Image, regions: Sequence[dict[str, Image]]
) -> list[Misfit]:
    """Return how the views contradict each plane, in one pass over the data.

    Parameters
    ----------
    operator, images
        H and the data.
    samples : float array (samples)
        f ≥ 0, in electrons.
    regions : sequence of dict of str to float array (row, column)
        Shares of the samples of each plane in "light, detail" and "light, smooth".
    """
    squares, variances, spreads = (np.zeros_like(samples) for _ in range(3))
    for view in operator.seeing_views.tolist():
        background_e, read_variance_e2 = (
            operator.map_of_views(value, np.array([view])) for value in (images.background_e, images.read_variance_e2)
        )
        expected = (operator.forward(samples, [view]) + background_e)[0]
        variance = np.asarray(expected + read_variance_e2).reshape(expected.shape)
        squares += operator.adjoint_of_view(np.square(images.electrons[view] - expected), view)
        variances += operator.adjoint_of_view(variance, view)
        # Of a Poisson number and a normal one
        spreads += operator.adjoint_of_view(2 * np.square(variance) + expected, view)
    parts = (operator.planes_of(array) for array in (squares, variances, spreads))
    return [_misfit(*of_plane) for of_plane in zip(*parts, regions, strict=True)]


def _misfit(squares: Image, variances: Image, spreads: Image, regions: dict[str, Image]) -> Misfit:
    """Return the misfit of one plane from back-projected squares, variances, and variances of squares of its views."""

    def ratio(share: Image) -> tuple[float, float]:
        total, expected, spread = (
            float(np.sum(terms * share, dtype=np.float64)) for terms in (squares, variances, spreads)
        )
        return (total / expected, np.sqrt(max(spread, 0.0)) / expected) if expected > 0 else (1.0, 0.0)

    (detail, of_detail), (smooth, of_smooth) = ratio(regions["light, detail"]), ratio(regions["light, smooth"])
    return Misfit(detail, smooth, float(np.hypot(of_detail, of_smooth)))
