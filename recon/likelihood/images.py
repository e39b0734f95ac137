"""The data of a reconstruction: the elemental images in electrons, the likelihood of their pixels, and bins."""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood import pixel_models
from faintfield.recon.names import LikelihoodName as LikelihoodName

type Image = NDArray[np.floating]

_MODELS = {
    "poisson": pixel_models.SHIFTED_POISSON,
    "shifted-poisson": pixel_models.SHIFTED_POISSON,
    "poisson-gaussian": pixel_models.POISSON_GAUSSIAN,
    "least-squares": pixel_models.LEAST_SQUARES,
}

# The shifted model clips pixels that are still negative: 0.13 % of dark pixels at 3 e⁻ of read noise, 2.3 % at 2 e⁻.
_MIN_SHIFTED_READ_NOISE_E = 3.0

# Read noise below this variance (0.03 e⁻) is neglected: counts are then known.
_NEGLIGIBLE_VARIANCE_E2 = 1e-3

# Mean in electrons above which read noise is a small part of the variance, whatever its share.
_BRIGHT_E = 100.0

# The exact model is taken if more than this fraction of the pixels needs it.
_MAX_INEXACT = 0.01


@dataclass(frozen=True)
class PixelLikelihood:
    """The statistical model of a pixel, see `recon.likelihood.pixel_models`.

    Parameters
    ----------
    name : str
        The model; "poisson" ignores the read noise, and takes negative numbers for zero.
    level_e : float
        Light at which least squares takes the variance of a pixel of response one.
    read_noise_share : float
        Fraction κ of σ² that solvers count as variance, see `read_noise_share`; the likelihood ignores it.
    """

    name: LikelihoodName = "shifted-poisson"
    level_e: float = 0.0
    read_noise_share: float = 1.0

    @property
    def model(self) -> int:
        """Number of the model in `recon.likelihood.pixel_models`."""
        return _MODELS[self.name]

    @property
    def knows_read_noise(self) -> bool:
        """True unless the model ignores the read noise."""
        return self.name != "poisson"


@dataclass(frozen=True)
class ElementalImages:
    """All views of one scene with their known statistics: g of `g = H f + n`, eq. (1) of docs/explanation/physics.md.

    A view's pixels are `Poisson(H f + b) + N(0, σ²)`. The images of one colour of a mosaic lie on *lattices* (of every
    second pixel, for example); each view then appears once per lattice, and maps are given per lattice.

    Parameters
    ----------
    electrons : float array (view, row, column)
        Offset removed and divided by the gain; values may be negative, dark current is not subtracted.
    background_e : float or array broadcastable to (lattice, row, column)
        b, expected electrons that are not light of the scene: dark current times exposure.
    read_variance_e2 : float or array broadcastable to (lattice, row, column)
        σ², the variance without any electron.
    valid : bool array (view, row, column), optional
        False where a pixel has no valid number (is saturated, for example); the operator must be made with the same.
    likelihood : PixelLikelihood
        Shifted Poisson by default.

    Raises
    ------
    ValueError
        Shapes do not fit, or a valid pixel is not finite.

    Examples
    --------
    Nine dark views of half an electron per pixel, with read noise of 3.5 e:

    >>> import numpy as np
    >>> from faintfield import ElementalImages
    >>> rng = np.random.default_rng(1)
    >>> electrons = rng.poisson(0.5, (9, 24, 32)) + rng.normal(0.0, 3.5, (9, 24, 32))
    >>> images = ElementalImages(electrons, background_e=0.02, read_variance_e2=3.5**2)
    >>> coarse = images.binned(2)  # as a detector of larger pixels would count
    >>> coarse.electrons.shape, coarse.read_variance_e2
    ((9, 12, 16), 49.0)
    """

    electrons: Image
    background_e: float | Image = 0.0
    read_variance_e2: float | Image = 0.0
    valid: NDArray[np.bool_] | None = None
    likelihood: PixelLikelihood = field(default_factory=PixelLikelihood)

    def __post_init__(self) -> None:
        if self.electrons.ndim != 3:
            raise ValueError(f"electrons must be (view, row, column), got shape {self.electrons.shape}")
        if self.valid is not None and self.valid.shape != self.electrons.shape:
            raise ValueError(f"valid has shape {self.valid.shape}, electrons {self.electrons.shape}")
        for view, image in enumerate(self.electrons):
            finite = np.isfinite(image) if self.valid is None else np.isfinite(image[self.valid[view]])
            if not finite.all():
                raise ValueError(f"view {view} has {np.count_nonzero(~finite)} pixels that are not finite numbers")

    def binned(self, bins: int) -> "ElementalImages":
        """Return the images with `bins` by `bins` pixels added up, as a detector of larger pixels would count them.

        The statistics stay the same. A bin counts if all its pixels are `valid`.
        """
        if bins == 1:
            return self
        background_e, variance_e2 = (
            float(value) * bins**2 if np.ndim(value) == 0 else binned(np.asarray(value), bins) * bins**2
            for value in (self.background_e, self.read_variance_e2)
        )
        electrons = np.stack([binned(image, bins) for image in self.electrons]) * self.electrons.dtype.type(bins**2)
        valid = None if self.valid is None else np.stack([binned(image, bins) == 1 for image in self.valid])
        return replace(self, electrons=electrons, background_e=background_e, read_variance_e2=variance_e2, valid=valid)

    def known_variance_e2(self) -> float | Image:
        """Return b + σ², the variance of a pixel without that of the light, as far as the likelihood counts it."""
        share = self.likelihood.read_noise_share if self.likelihood.knows_read_noise else 0.0
        return self.background_e + share * self.read_variance_e2


def binned(maps: NDArray[Any], bins: int) -> NDArray[Any]:
    """Return the means of bins of maps (…, row, column); a remainder at the far edges is dropped."""
    if bins == 1:
        return maps
    rows, columns = (size // bins for size in maps.shape[-2:])
    whole = maps[..., : rows * bins, : columns * bins]
    return np.asarray(whole.reshape(*maps.shape[:-2], rows, bins, columns, bins).mean(axis=(-3, -1)))


def select_likelihood(
    images: ElementalImages, name: LikelihoodName | Literal["auto"], level_e: float
) -> PixelLikelihood:
    """Return the likelihood of the given name, for a typical light `level_e` in electrons.

    "auto" takes Poisson without read noise, shifted Poisson from 3 e⁻, and between them the exact Poisson–Gaussian,
    which is 15 times slower. Least squares takes the variance of a pixel at the typical light, so that its weights do
    not depend on the data.
    """
    if name == "least-squares":
        return PixelLikelihood(name, max(level_e, _NEGLIGIBLE_VARIANCE_E2))
    variance_e2 = np.asarray(images.read_variance_e2)
    if name == "auto" and variance_e2.max() < _NEGLIGIBLE_VARIANCE_E2:
        name = "poisson"
    elif name == "auto":
        exact = np.mean(variance_e2 < _MIN_SHIFTED_READ_NOISE_E**2) > _MAX_INEXACT
        name = "poisson-gaussian" if exact else "shifted-poisson"
    if name == "poisson-gaussian":
        mean_e = level_e + float(np.mean(images.background_e))
        return PixelLikelihood(name, read_noise_share=read_noise_share(mean_e, float(np.sqrt(np.median(variance_e2)))))
    return PixelLikelihood(name)


def read_noise_share(mean_e: float, read_noise_e: float) -> float:
    """Return the fraction of σ² that counts as variance in the exact model: κ in `1/I = λ + κ σ²`.

    I is Fisher's information of a pixel about its mean λ. Read noise well below one electron leaves counts
    distinguishable, so κ is nearly 0; above two electrons, or in bright light, it is nearly 1.
    """
    if mean_e > _BRIGHT_E or read_noise_e > _MIN_SHIFTED_READ_NOISE_E or read_noise_e**2 < _NEGLIGIBLE_VARIANCE_E2:
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
