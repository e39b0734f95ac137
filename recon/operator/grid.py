"""The samples of a plane: their number and positions."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PlaneGrid:
    """A regular grid of samples on a plane; x runs along columns and y along rows, as in the reference camera.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    pitch_mm : float
        Distance between neighbouring samples.
    origin_mm : (float, float)
        x, y of the first sample's centre.

    Raises
    ------
    ValueError
        Fewer than two samples along an axis (nothing to interpolate between), a pitch that is not positive, or an
        origin that is not finite.

    Examples
    --------
    >>> from faintfield import PlaneGrid
    >>> grid = PlaneGrid(shape=(48, 64), pitch_mm=5.0, origin_mm=(-157.5, -117.5))
    >>> grid == PlaneGrid.covering(left_mm=-160.0, top_mm=-120.0, right_mm=160.0, bottom_mm=120.0, pitch_mm=5.0)
    True
    >>> grid.index_from_plane() @ [0.0, 0.0, 1.0]  # column and row of the middle
    array([31.5, 23.5,  1. ])
    """

    shape: tuple[int, int]
    pitch_mm: float
    origin_mm: tuple[float, float]

    def __post_init__(self) -> None:
        if min(self.shape) < 2:
            raise ValueError(f"a plane needs at least 2 x 2 samples, got {self.shape}; take a finer pitch_mm")
        if not (np.isfinite(self.pitch_mm) and self.pitch_mm > 0):
            raise ValueError(f"pitch_mm must be positive, got {self.pitch_mm}")
        if not np.isfinite(self.origin_mm).all():
            raise ValueError(f"origin_mm must be finite, got {self.origin_mm}")

    @classmethod
    def covering(cls, left_mm: float, top_mm: float, right_mm: float, bottom_mm: float, pitch_mm: float) -> "PlaneGrid":
        """Return the grid of samples `pitch_mm` apart on the rectangle with these edges, whole samples only."""
        rows, columns = round((bottom_mm - top_mm) / pitch_mm), round((right_mm - left_mm) / pitch_mm)
        return cls((rows, columns), pitch_mm, (left_mm + pitch_mm / 2, top_mm + pitch_mm / 2))

    def on_multiples(self) -> "PlaneGrid":
        """Return the grid moved by half a sample at most, so that x and y of its samples are multiples of the pitch."""
        x_mm, y_mm = (self.pitch_mm * round(start / self.pitch_mm) for start in self.origin_mm)
        return PlaneGrid(self.shape, self.pitch_mm, (x_mm, y_mm))

    def binned(self, bins: int) -> "PlaneGrid":
        """Return the grid with samples of `bins` by `bins` of these; incomplete ones at the far edges are dropped."""
        first = tuple(origin + self.pitch_mm * (bins - 1) / 2 for origin in self.origin_mm)
        return PlaneGrid((self.shape[0] // bins, self.shape[1] // bins), self.pitch_mm * bins, (first[0], first[1]))

    def window(self, rows: slice, columns: slice) -> "PlaneGrid":
        """Return the grid of a part of these samples; both slices have a start and a stop."""
        x_mm, y_mm = self.origin_mm
        origin_mm = x_mm + columns.start * self.pitch_mm, y_mm + rows.start * self.pitch_mm
        return PlaneGrid((rows.stop - rows.start, columns.stop - columns.start), self.pitch_mm, origin_mm)

    def index_from_plane(self) -> NDArray[np.float64]:
        """Return the 3 x 3 matrix from plane coordinates (x, y, 1) in mm to sample indices (column, row, 1)."""
        x_mm, y_mm = self.origin_mm
        return np.array([[1, 0, -x_mm], [0, 1, -y_mm], [0, 0, self.pitch_mm]]) / self.pitch_mm
