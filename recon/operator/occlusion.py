"""How much of a plane's light nearer planes hide, judged by the light of the nearer planes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.smoothing import blurred

# Spacings of the blurs before the light is judged, of about two samples (noise is not opaque), and after.
_BLUR_BEFORE, _BLUR_AFTER = (1, 2, 2), (1,)

# A plane is transparent below the first of these fractions of its typical light, and opaque above the second.
_TRANSPARENT, _OPAQUE = 0.15, 0.35


def opacity(plane: Image) -> Image:
    """Return the opacity of a plane, 0 to 1 (row, column), judged by its light.

    The typical light is the mean of the light weighted by the light itself, so that empty surroundings do not count.
    Black objects are taken for transparent, although they hide what is behind them. Light fainter than a seventh of the
    typical light is taken for noise, or for the blur of something at another depth.
    """
    light = blurred(plane, _BLUR_BEFORE)
    total = float(light.sum(dtype=np.float64))
    if total <= 0:
        return np.zeros_like(plane)
    typical = float(np.square(light, dtype=np.float64).sum()) / total
    share = (light / plane.dtype.type(typical) - _TRANSPARENT) / (_OPAQUE - _TRANSPARENT)
    return np.asarray(blurred(np.clip(share, 0, 1), _BLUR_AFTER), plane.dtype)


def transmission(
    operator: SceneOperator, opacities: Sequence[Image], depths_mm: Sequence[float]
) -> NDArray[np.floating]:
    """Return `Π (1 − H_z' α_z')` over the planes z' nearer than z, (plane, view, row, column).

    Parameters
    ----------
    operator : SceneOperator
        H of all planes without occlusion; its response is divided out.
    opacities : sequence of float array (row, column)
        α of each plane.
    depths_mm : sequence of float
        Depth of each plane.
    """
    response = np.asarray(operator.map_of_views(operator.response(), operator.all_views))
    through = np.ones((len(depths_mm), *operator.images_shape), operator.dtype)
    for near, depth in enumerate(depths_mm):
        farther = [index for index, other in enumerate(depths_mm) if other > depth]
        if not farther:
            continue
        alone = np.zeros(operator.samples_shape, operator.dtype)
        operator.planes_of(alone)[near][:] = opacities[near]
        seen = operator.forward(alone)
        hidden = np.divide(seen, response, out=np.zeros_like(seen), where=response > 0)
        through[farther] *= np.clip(1 - hidden, 0, 1)
    return through
