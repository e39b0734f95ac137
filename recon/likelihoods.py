"""How well a plane explains the elemental images."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recon.images import ElementalImages, Image
from recon.operator import PlaneOperator


def negative_log_likelihood(
    operator: PlaneOperator,
    plane: Image,
    images: ElementalImages,
    views: Sequence[int] | NDArray[np.intp] | None = None,
) -> float:
    """Return the negative log-likelihood of a plane under the images' model, without terms that do not depend on it.

    For the shifted Poisson model it is `Σ m − y + y ln(y/m)`, with `y = (g + σ²)₊` and `m = H f + b + σ²`. The sum runs
    over the pixels that see the plane.
    """
    return operator.negative_log_likelihood(plane, images, views)
