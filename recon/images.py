"""The data of a reconstruction: the elemental images of one scene in electrons, and what is known of their noise."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

type Image = NDArray[np.floating]


@dataclass(frozen=True)
class ElementalImages:
    """All views of one scene, `g` of eq. (1), with the known part of their statistics.

    A view's pixels are `Poisson(H f + b) + N(0, σ²)`. The images of a colour of a mosaic lie on *lattices* of every
    second pixel, say; each view then appears once per lattice, and maps are given per lattice. Which view lies on which
    lattice, and where that looks, the operator knows.

    Parameters
    ----------
    electrons : float array (view, row, column)
        Offset removed and divided by the gain; negative values are meant, dark current is not subtracted.
    background_e : float or array broadcastable to (lattice, row, column)
        b: expected electrons that are not light of the scene (dark current times exposure).
    read_variance_e2 : float or array broadcastable to (lattice, row, column)
        σ²: variance that is there without any electron.
    valid : bool array (view, row, column), optional
        False where a pixel carries no number (saturated, say); the operator must have been made with the same.

    Raises
    ------
    ValueError
        Shapes do not fit, or a valid pixel is not finite.
    """

    electrons: Image
    background_e: float | Image = 0.0
    read_variance_e2: float | Image = 0.0
    valid: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        if self.electrons.ndim != 3:
            raise ValueError(f"electrons must be (view, row, column), got shape {self.electrons.shape}")
        if self.valid is not None and self.valid.shape != self.electrons.shape:
            raise ValueError(f"valid has shape {self.valid.shape}, electrons {self.electrons.shape}")
        for view, image in enumerate(self.electrons):
            finite = np.isfinite(image) if self.valid is None else np.isfinite(image[self.valid[view]])
            if not finite.all():
                raise ValueError(f"view {view} has {np.count_nonzero(~finite)} pixels that are not finite numbers")
