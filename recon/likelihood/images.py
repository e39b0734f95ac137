"""The data of a reconstruction: the elemental images of one scene in electrons, and the statistics of their noise."""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood import pixel_models

type Image = NDArray[np.floating]
type LikelihoodName = Literal["poisson", "shifted-poisson", "poisson-gaussian", "least-squares"]

_MODELS = {
    "poisson": pixel_models.SHIFTED_POISSON,
    "shifted-poisson": pixel_models.SHIFTED_POISSON,
    "poisson-gaussian": pixel_models.POISSON_GAUSSIAN,
    "least-squares": pixel_models.LEAST_SQUARES,
}


@dataclass(frozen=True)
class PixelLikelihood:
    """The statistical model of a pixel, see `recon.likelihood.pixel_models`.

    Parameters
    ----------
    name : str
        The model; "poisson" ignores the read noise, and takes negative numbers for zero.
    level_e : float
        Light at which least squares takes the variance of a pixel of response one; other models ignore it.
    read_noise_share : float
        Fraction of σ² that counts as variance where the exact model tells counts apart: the information of a pixel
        about its mean is that of a variance `λ + share · σ²`. Solvers use it in their metric; the likelihood does not.
    """

    name: LikelihoodName = "shifted-poisson"
    level_e: float = 0.0
    read_noise_share: float = 1.0

    @property
    def model(self) -> int:
        """The model's number in `recon.likelihood.pixel_models`."""
        return _MODELS[self.name]

    @property
    def knows_read_noise(self) -> bool:
        """Whether the model takes the read noise into account."""
        return self.name != "poisson"


@dataclass(frozen=True)
class ElementalImages:
    """All views of one scene, `g` of eq. (1), with the known part of their statistics.

    A view's pixels are `Poisson(H f + b) + N(0, σ²)`. The images of one colour of a mosaic lie on *lattices* (of every
    second pixel, for example); each view then appears once per lattice, and maps are given per lattice. The operator
    knows the lattice of each view and its rays.

    Parameters
    ----------
    electrons : float array (view, row, column)
        Offset removed and divided by the gain; values may be negative, dark current is not subtracted.
    background_e : float or array broadcastable to (lattice, row, column)
        b: expected electrons that are not light of the scene (dark current times exposure).
    read_variance_e2 : float or array broadcastable to (lattice, row, column)
        σ²: variance without any electron.
    valid : bool array (view, row, column), optional
        False where a pixel has no valid number (is saturated, for example); the operator must be made with the same.
    likelihood : PixelLikelihood
        The statistical model of the numbers.

    Raises
    ------
    ValueError
        Shapes do not fit, or a valid pixel is not finite.
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

        Sums of Poisson counts are Poisson, and sums of normal read noises normal, so the statistics stay the same. A
        bin counts if all its pixels are `valid`; the operator leaves out pixels that never count.
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
    rows, columns = (size // bins for size in maps.shape[-2:])
    whole = maps[..., : rows * bins, : columns * bins]
    return np.asarray(whole.reshape(*maps.shape[:-2], rows, bins, columns, bins).mean(axis=(-3, -1)))
