"""The penalties on a plane's roughness: those of PMLEM, and total variation smoothed as in the paper."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from faintfield.recon.likelihood.images import Image
from faintfield.recon.names import PenaltyName as PenaltyName


@dataclass(frozen=True)
class Penalty:
    """Σ φ(t) over the samples of a plane, where t is the length of the difference to the next samples.

    "tv": φ = t, isotropic total variation, not smoothed. "quadratic": φ = t²/2δ. "huber-tv": φ = t²/2δ up to t = δ and
    t − δ/2 beyond. "none": 0.

    Parameters
    ----------
    name : {"tv", "huber-tv", "quadratic", "none"}
        The penalty.
    smoothing_e : float
        δ, in electrons.

    Raises
    ------
    ValueError
        δ is not positive where it is needed.
    """

    name: PenaltyName = "tv"
    smoothing_e: float = 0.0

    def __post_init__(self) -> None:
        if self.name in ("huber-tv", "quadratic") and not self.smoothing_e > 0:
            raise ValueError(f"{self.name} needs a smoothing_e > 0, got {self.smoothing_e}")

    @classmethod
    def for_noise(cls, name: PenaltyName, noise_e: Callable[[], float]) -> "Penalty":
        """Return a penalty whose δ suits a back-projection with noise of standard deviation `noise_e()`.

        The quadratic penalty weights differences as large as the noise about as much as total variation does; Huber's
        is total variation above a tenth of the noise.
        """
        share = {"quadratic": 1.0, "huber-tv": 0.1}.get(name, 0.0)
        return cls(name, share * noise_e() if share else 0.0)

    @property
    def bounded(self) -> bool:
        """True if the derivative of φ never exceeds one."""
        return self.name != "quadratic"


def total_variation(plane: Image, epsilon: float) -> float:
    """Return Σ u, the smoothed total variation of a plane (row, column).

    `u[i,j] = sqrt( (f[i+1,j] − f[i,j])² + (f[i,j+1] − f[i,j])² + ε )` without differences across an edge
    (Panin, Zeng and Gullberg 1999, eq. (3) of the paper). `epsilon` has the unit of f squared.
    """
    return float(_gradient_magnitude(*differences(plane), epsilon).sum(dtype=np.float64))


def total_variation_gradient(plane: Image, epsilon: float) -> Image:
    """Return P{f} of eq. (3), the derivative of `total_variation` with respect to each sample (row, column)."""
    down, right = differences(plane)
    magnitude = _gradient_magnitude(down, right, epsilon)
    down /= magnitude
    right /= magnitude
    gradient = -(down + right)
    gradient[1:] += down[:-1]
    gradient[:, 1:] += right[:, :-1]
    return gradient


def differences(plane: Image) -> tuple[Image, Image]:
    """Return the forward differences along rows and columns; zero at the last row and column."""
    down, right = np.zeros_like(plane), np.zeros_like(plane)
    np.subtract(plane[1:], plane[:-1], out=down[:-1])
    np.subtract(plane[:, 1:], plane[:, :-1], out=right[:, :-1])
    return down, right


def _gradient_magnitude(down: Image, right: Image, epsilon: float) -> Image:
    magnitude: Image = np.square(down)
    magnitude += np.square(right)
    magnitude += magnitude.dtype.type(epsilon)
    return np.sqrt(magnitude, out=magnitude)
