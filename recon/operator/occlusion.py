"""What nearer planes hide of farther ones, from the light of the nearer ones."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator.scene import SceneOperator
from faintfield.recon.smoothing import blurred

# A plane is looked at with a blur of a standard deviation of about two samples: noise is not opaque.
_LOOK, _SOFTEN = (1, 2, 2), (1,)

# Opaque from the upper of these parts of the plane's typical light, transparent below the lower.
_TRANSPARENT, _OPAQUE = 0.15, 0.35


def opacity(plane: Image) -> Image:
    """Return how opaque a plane is, 0 to 1 (row, column), judged by its light: what shines or scatters, hides.

    Typical is the mean of the light weighted by the light itself, so that an empty surround does not count. What is
    black hides without being seen; it stays transparent. And what is fainter than a seventh of the typical passes for
    noise, or for the blur of something at another depth.
    """
    light = blurred(plane, _LOOK)
    total = float(light.sum(dtype=np.float64))
    if total <= 0:
        return np.zeros_like(plane)
    typical = float(np.square(light, dtype=np.float64).sum()) / total
    share = (light / plane.dtype.type(typical) - _TRANSPARENT) / (_OPAQUE - _TRANSPARENT)
    return np.asarray(blurred(np.clip(share, 0, 1), _SOFTEN), plane.dtype)


def transmission(
    operator: SceneOperator, opacities: Sequence[Image], depths_mm: Sequence[float]
) -> NDArray[np.floating]:
    """Return `Π (1 − H_z' α_z')` over the planes z' nearer than z, (plane, view, row, column).

    Parameters
    ----------
    operator : SceneOperator
        H of all planes with nothing hidden; its response is divided out.
    opacities : sequence of float array (row, column)
        α of each plane.
    depths_mm : sequence of float
        Of the planes.
    """
    response = np.asarray(operator.map_of_views(operator.response(), operator.all_views))
    through = np.ones((len(depths_mm), *operator.images_shape), operator.dtype)
    for near, depth in enumerate(depths_mm):
        farther = [index for index, other in enumerate(depths_mm) if other > depth]
        if not farther:
            continue
        alone = [one if index == near else np.zeros_like(one) for index, one in enumerate(opacities)]
        seen = operator.forward(alone)
        hidden = np.divide(seen, response, out=np.zeros_like(seen), where=response > 0)
        through[farther] *= np.clip(1 - hidden, 0, 1)
    return through
