"""Occlusion by nearer planes, judged by their light."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.blur import blurred
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.kernels import Hiding

# Spacings of the blurs before the light is judged, of about two samples (noise is not opaque), and after.
_BLUR_BEFORE, _BLUR_AFTER = (1, 2, 2), (1,)

# A plane is transparent below the first of these fractions of its typical light, and opaque above the second.
_TRANSPARENT, _OPAQUE = 0.15, 0.35


class Occluders(NamedTuple):
    """Planes that hide those behind them: light of a plane is multiplied by `Π (1 − H_z' α_z')` over nearer planes z'.

    H_z' is without the response of the pixels. Planes of the same depth do not hide one another.

    Attributes
    ----------
    opacities : sequence of float array (row, column)
        Opacity α of each plane, 0 to 1.
    depths_mm : sequence of float
        Depth of each plane.
    """

    opacities: Sequence[Image]
    depths_mm: Sequence[float]


def opacity(plane: Image) -> Image:
    """Return the opacity of a plane, 0 to 1 (row, column), judged by its light.

    Black objects are taken for transparent, although they hide what is behind them. Light fainter than a seventh of the
    typical light, the mean of the light weighted by itself, is taken for noise or the blur of another depth.
    """
    light = blurred(plane, _BLUR_BEFORE)
    total = float(light.sum(dtype=np.float64))
    if total <= 0:
        return np.zeros_like(plane)
    typical = float(np.square(light, dtype=np.float64).sum()) / total
    share = (light / plane.dtype.type(typical) - _TRANSPARENT) / (_OPAQUE - _TRANSPARENT)
    return np.asarray(blurred(np.clip(share, 0, 1), _BLUR_AFTER), plane.dtype)


def hiding_of(occluders: Occluders | None, grids: Sequence[PlaneGrid], dtype: np.dtype[Any]) -> Hiding:
    """Return occluders as the kernel reads them; raise GeometryMismatch where they do not fit the planes."""
    if occluders is None:
        return Hiding(np.zeros(0, dtype), np.zeros(0, np.intp), np.zeros(0))
    opacities, depths_mm = occluders
    if [opacity.shape for opacity in opacities] != [grid.shape for grid in grids] or len(depths_mm) != len(grids):
        raise GeometryMismatch(
            f"opacities of shapes {[opacity.shape for opacity in opacities]} and {len(depths_mm)} depths do not fit "
            f"planes of {[grid.shape for grid in grids]} samples; give one of each for each plane"
        )
    if not all(((opacity >= 0) & np.isfinite(opacity)).all() for opacity in opacities):
        raise GeometryMismatch("an opacity is negative or not a finite number; give numbers from 0 to 1")
    samples = np.concatenate([np.ascontiguousarray(opacity, dtype).reshape(-1) for opacity in opacities])
    # The farthest plane hides nothing
    hides = [depth < max(depths_mm) for depth in depths_mm]
    columns = [_opaque_columns(opacity * nearer) for opacity, nearer in zip(opacities, hides, strict=True)]
    return Hiding(samples, np.concatenate(columns).reshape(-1), np.array(depths_mm, np.float64))


def _opaque_columns(alpha: Image) -> NDArray[np.intp]:
    """Return the first and the past-the-last column with some opacity (row, 2); a row without begins nowhere."""
    some = alpha > 0
    first = np.where(some.any(axis=1), some.argmax(axis=1), np.iinfo(np.int32).max)
    return np.column_stack([first, alpha.shape[1] - some[:, ::-1].argmax(axis=1)])
