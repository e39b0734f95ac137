"""The choice of the likelihood of elemental images, by name or by their read noise."""

from typing import Literal

import numpy as np

from faintfield.recon.likelihood.images import ElementalImages, LikelihoodName, PixelLikelihood

# The shifted model clips pixels that are still negative: 0.13 % of dark pixels at 3 e⁻ of read noise, 2.3 % at 2 e⁻.
MIN_SHIFTED_READ_NOISE_E = 3.0

# Read noise below this variance (0.03 e⁻) is neglected: counts are then known.
_NEGLIGIBLE_VARIANCE_E2 = 1e-3

# Mean in electrons above which read noise is a small part of the variance, whatever its share.
_BRIGHT_E = 100.0

# The exact model is taken if more than this fraction of the pixels needs it.
_MAX_INEXACT = 0.01


def select_likelihood(
    images: ElementalImages, name: LikelihoodName | Literal["auto"], level_e: float
) -> PixelLikelihood:
    """Return the likelihood of the given name; "auto" chooses it by the read noise.

    "auto" takes Poisson without read noise, shifted Poisson from 3 e⁻, and between them the exact Poisson–Gaussian,
    which is 15 times slower. Least squares takes the variance of a pixel at the typical light `level_e`, so that its
    weights do not depend on the data.
    """
    if name == "least-squares":
        return PixelLikelihood(name, max(level_e, _NEGLIGIBLE_VARIANCE_E2))
    variance_e2 = np.asarray(images.read_variance_e2)
    if name == "auto" and variance_e2.max() < _NEGLIGIBLE_VARIANCE_E2:
        name = "poisson"
    elif name == "auto":
        exact = np.mean(variance_e2 < MIN_SHIFTED_READ_NOISE_E**2) > _MAX_INEXACT
        name = "poisson-gaussian" if exact else "shifted-poisson"
    if name == "poisson-gaussian":
        mean_e = level_e + float(np.mean(images.background_e))
        return PixelLikelihood(name, read_noise_share=read_noise_share(mean_e, float(np.sqrt(np.median(variance_e2)))))
    return PixelLikelihood(name)


def read_noise_share(mean_e: float, read_noise_e: float) -> float:
    """Return the fraction of σ² that counts as variance in the exact model: κ in `1/I = λ + κ σ²`.

    I is Fisher's information of a pixel about its mean λ.

    Read noise well below one electron leaves counts distinguishable and does not count; above two electrons, or in
    bright light, nearly all of it counts.
    """
    if mean_e > _BRIGHT_E or read_noise_e > MIN_SHIFTED_READ_NOISE_E or read_noise_e**2 < _NEGLIGIBLE_VARIANCE_E2:
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
