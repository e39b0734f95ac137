"""Rays and response of the detector pixels, as the kernels read them."""

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.operator.placement import BLOCK_PX

type Precision = type[np.float32] | type[np.float64] | np.dtype[np.floating]


class DetectorMaps:
    """Rays and response of the detector's pixels, which the operators of all planes share without a copy.

    Parameters
    ----------
    rays : array (row, column, 2) or (lattice, row, column, 2)
        Ray (x, y, 1) of each pixel, without distortion.
    flat : array (row, column) or (lattice, row, column), optional
        Relative response of each pixel (vignetting); zero for pixels that never count.
    dtype : dtype
        Type of the maps, samples and images.

    Attributes
    ----------
    layers : array (3, lattice, row, column)
        x and y of the rays, and the response. Rows are padded by NaN to whole blocks of columns.
    shape : tuple of int
        Lattices, rows and columns.

    Raises
    ------
    GeometryMismatch
        Shapes do not fit together, a number is not finite, or a response is negative.

    Examples
    --------
    >>> import numpy as np
    >>> from faintfield.recon.operator.detector_maps import DetectorMaps
    >>> DetectorMaps(np.zeros((2, 3, 2))).shape
    (1, 2, 3)
    """

    def __init__(
        self,
        rays: NDArray[np.floating],
        flat: NDArray[np.floating] | None = None,
        dtype: Precision = np.float32,
    ) -> None:
        rays = rays[np.newaxis] if rays.ndim == 3 else rays
        if rays.ndim != 4 or rays.shape[3] != 2:
            raise GeometryMismatch(f"rays of shape {rays.shape} do not fit; give (lattice, row, column, 2)")
        lattices, rows, columns = self.shape = rays.shape[0], rays.shape[1], rays.shape[2]
        flat = np.ones((1, rows, columns), dtype) if flat is None else flat.reshape(-1, *flat.shape[-2:])
        if flat.shape not in ((1, rows, columns), self.shape):
            raise GeometryMismatch(f"flat {flat.shape} does not fit rays {rays.shape}; give one per lattice, or one")
        if not (np.isfinite(rays).all() and np.isfinite(flat).all()):
            raise GeometryMismatch("a ray or flat field is not a finite number; check the calibration they came from")
        if (flat < 0).any():
            raise GeometryMismatch(f"the flat field is negative somewhere, {flat.min():.3g} at least; measure it again")
        padded = -(-columns // BLOCK_PX) * BLOCK_PX
        self.layers = np.full((3, lattices, rows, padded), np.nan, dtype)
        self.layers[..., :columns] = rays[..., 0], rays[..., 1], np.broadcast_to(flat, self.shape)

    @classmethod
    def of(
        cls,
        rays: "NDArray[np.floating] | DetectorMaps",
        flat: NDArray[np.floating] | None,
        dtype: Precision,
    ) -> "DetectorMaps":
        """Return maps as they are, or those of rays and a flat field."""
        if not isinstance(rays, DetectorMaps):
            return cls(rays, flat, dtype)
        if flat is not None or rays.layers.dtype != dtype:
            raise GeometryMismatch(
                f"detector maps of type {rays.layers.dtype} already have a flat field; give no other, and dtype their "
                "type"
            )
        return rays

    @property
    def rays(self) -> NDArray[np.floating]:
        """Ray of each pixel (lattice, row, column, 2), a view."""
        return np.moveaxis(self.layers[:2, ..., : self.shape[2]], 0, -1)
