"""Which likelihood the elemental images are judged by, and how well a plane explains them."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image, Likelihood, LikelihoodName
from faintfield.recon.operator.plane import PlaneOperator

# The shifted model clips what is still negative: at 3 e⁻ of read noise 0.13 % of dark pixels, at 2 e⁻ 2.3 %.
LEAST_SHIFTED_READ_NOISE_E = 3.0

# So little read noise (0.03 e⁻) is none: counts are known.
_NO_VARIANCE_E2 = 1e-3

# Where there are so many electrons, read noise is a small part of the variance whatever share of it counts.
_BRIGHT_E = 100.0

# Exact where more than this part of the pixels need it.
_FEW = 0.01


def likelihood_of(images: ElementalImages, name: LikelihoodName | Literal["auto"], level_e: float) -> Likelihood:
    """Return the likelihood of a name; "auto" chooses by the read noise.

    Without read noise that is Poisson, from 3 e⁻ shifted Poisson, which is 15 times faster than the exact
    Poisson–Gaussian that is taken between them. Least squares takes the variance of a pixel at the typical light
    `level_e`, so that its weights do not depend on the data.
    """
    if name == "least-squares":
        return Likelihood(name, max(level_e, _NO_VARIANCE_E2))
    variance_e2 = np.asarray(images.read_variance_e2)
    if name == "auto" and variance_e2.max() < _NO_VARIANCE_E2:
        name = "poisson"
    elif name == "auto":
        exact = np.mean(variance_e2 < LEAST_SHIFTED_READ_NOISE_E**2) > _FEW
        name = "poisson-gaussian" if exact else "shifted-poisson"
    if name == "poisson-gaussian":
        mean_e = level_e + float(np.mean(images.background_e))
        return Likelihood(name, read_noise_share=read_noise_share(mean_e, float(np.sqrt(np.median(variance_e2)))))
    return Likelihood(name)


def read_noise_share(mean_e: float, read_noise_e: float) -> float:
    """Return what part of σ² counts as variance in the exact model: κ in `1/I = λ + κ σ²`, with I Fisher's information.

    Counts are told apart where read noise is well below one electron, and then it does not count; where it is above
    two, or the light is bright, nearly all of it does.
    """
    if mean_e > _BRIGHT_E or read_noise_e > LEAST_SHIFTED_READ_NOISE_E or read_noise_e**2 < _NO_VARIANCE_E2:
        return 1.0
    counts = np.arange(int(mean_e + 10 * np.sqrt(mean_e)) + 15.0)
    observed = np.arange(-8 * read_noise_e, counts[-1] + 8 * read_noise_e, read_noise_e / 10)
    logarithm = counts * np.log(max(mean_e, 1e-9)) - mean_e - np.cumsum(np.log(np.maximum(counts, 1)))
    exponent = logarithm - 0.5 * ((observed[:, np.newaxis] - counts) / read_noise_e) ** 2
    joint = np.exp(exponent)
    density = joint.sum(axis=1)
    score = 1 - np.divide(joint @ counts, density * mean_e, out=np.ones_like(density), where=density > 0)
    information = float(np.sum(density * score**2) / np.sum(density))
    return float(np.clip((1 / information - mean_e) / read_noise_e**2, 0.0, 1.0))


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
