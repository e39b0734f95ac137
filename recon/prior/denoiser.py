"""Denoisers of one's own as candidates of a prior: what they make of the back-projection, beside total variation."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from faintfield.recon.likelihood.images import Image
from faintfield.recon.prior.evidence import Evidence

# Name of the candidate of a denoiser.
_NAME = "denoiser"


class Denoiser(Protocol):
    """A function that removes noise from a picture: a prior of one's own.

    Held-out views decide how much of its result is believed, and where the views contradict it, they win. Several
    threads may call it at a time, for parts of a large plane.

    Examples
    --------
    A Gaussian blur, wider where there is more noise:

    >>> from scipy.ndimage import gaussian_filter
    >>> def blur(picture, sigma):
    ...     return gaussian_filter(picture, 1.5)
    """

    def __call__(self, picture: Image, sigma: Image) -> Image:
        """Return a picture (row, column) without its noise.

        Parameters
        ----------
        picture : float32 array (row, column)
            The mean of the views, or means of 2 x 2 or 4 x 4 of its samples, in electrons; may be negative.
        sigma : float32 array (row, column)
            Standard deviation of each sample's noise, which is correlated with that of its neighbours by about a
            quarter; large where no view sees.
        """


def name_of(denoiser: Denoiser) -> str:
    """Return the name of a function, or of the type of an object, for records."""
    return getattr(denoiser, "__name__", type(denoiser).__name__)


@dataclass(frozen=True)
class DenoiserCandidates:
    """Candidates of a denoiser: total variation's plane and what the denoiser makes of the evidence."""

    denoiser: Denoiser

    def __call__(self, evidence: Evidence, names: Collection[str] | None = None) -> dict[str, Image]:
        """Return the candidates by name: those named, by default both.

        Raises
        ------
        ValueError
            The denoiser returned a picture of another shape, or numbers that are not finite.
        """
        candidates = {"tv": evidence.pilot}
        if names is None or _NAME in names:
            variance = evidence.noise.variance
            largest = variance[np.isfinite(variance)].max(initial=0)
            sigma = np.sqrt(np.minimum(variance, largest))
            picture = np.asarray(self.denoiser(evidence.picture.copy(), sigma), evidence.pilot.dtype)
            if picture.shape != evidence.pilot.shape or not np.isfinite(picture).all():
                raise ValueError(
                    f"{name_of(self.denoiser)} returned a picture of shape {picture.shape}; it must return one of "
                    f"shape {evidence.pilot.shape}, of finite numbers"
                )
            candidates[_NAME] = picture
        return candidates
