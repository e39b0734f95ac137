"""Colour filter mosaics: the pixels of one phase, that is of one position in the period."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray


def mosaic_period(mosaic: Sequence[str] | None) -> tuple[int, int]:
    """Return rows and columns of the period of a mosaic such as ("RG", "GB"); (1, 1) without filters."""
    return (1, 1) if mosaic is None else (len(mosaic), len(mosaic[0]))


def at_phase(pixels: NDArray[Any], phase: tuple[int, int], period: tuple[int, int]) -> NDArray[Any]:
    """Return the pixels of a phase, as a view of an array (row, column)."""
    return pixels[phase[0] :: period[0], phase[1] :: period[1]]


@dataclass(frozen=True)
class Lattice:
    """The detector pixels of one phase of a mosaic; all pixels without colour filters.

    Attributes
    ----------
    first, step : (int, int)
        Row and column of its first pixel, and the distance to its next.
    shape : (int, int)
        Rows and columns; an incomplete period at the far edges is left out.
    """

    first: tuple[int, int]
    step: tuple[int, int]
    shape: tuple[int, int]

    def of(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return the lattice's part of an image (row, column), as a view."""
        return at_phase(pixels, self.first, self.step)[: self.shape[0], : self.shape[1]]
