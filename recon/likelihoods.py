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
    """Return `Σ m − y ln m` of the shifted Poisson model, with `y = (g + σ²)₊` and `m = H f + b + σ²`.

    The sum runs over the pixels that see the plane; terms that do not depend on f are left out. Views are taken one at
    a time, so that the memory needed is that of one.
    """
    chosen = operator.all_views if views is None else np.asarray(views, np.intp)
    return sum(_of_view(operator, plane, images, int(view)) for view in chosen)


def _of_view(operator: PlaneOperator, plane: Image, images: ElementalImages, view: int) -> float:
    """Return the negative log-likelihood of one view."""
    sees_plane = operator.forward(np.ones_like(plane), [view])[0] != 0
    variance, background = (
        operator.map_of_view(value, view)[sees_plane] for value in (images.read_variance_e2, images.background_e)
    )
    mean = operator.forward(plane, [view])[0][sees_plane] + background + variance
    observed = np.maximum(images.electrons[view][sees_plane] + variance, 0)
    logarithm = np.log(mean, out=np.zeros_like(mean), where=observed > 0)
    return float(np.sum(mean - observed * logarithm, dtype=np.float64))
