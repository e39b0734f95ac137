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
    ones = np.ones(operator.grid.shape, operator.dtype)
    lattices = np.zeros(len(operator.all_views), int) if images.lattice_of_view is None else images.lattice_of_view
    total = 0.0
    for view in chosen:
        counts = operator.forward(ones, [view])[0] != 0
        variance, background = (
            np.broadcast_to(value, (lattices.max() + 1, *counts.shape))[lattices[view]][counts]
            for value in (images.read_variance_e2, images.background_e)
        )
        mean = operator.forward(plane, [view])[0][counts] + background + variance
        observed = np.maximum(images.electrons[view][counts] + variance, 0)
        logarithm = np.log(mean, out=np.zeros_like(mean), where=observed > 0)
        total += float(np.sum(mean - observed * logarithm, dtype=np.float64))
    return total
