"""Noise model of a sensor, which converts digital numbers to electrons with known statistics."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Largest number of a sensor; the squares of what is computed from such numbers do not overflow single precision.
_MAX_NUMBER = 1e6

type Map = float | NDArray[np.floating]
"""One value for the whole sensor, or one per pixel as an array (row, column)."""


@dataclass(frozen=True)
class NoiseModel:
    """A linear sensor: `dn = offset + gain · (Poisson(η Φ t + D t) + N(0, σ²))`, rounded to whole DN.

    Eq. (6) of Stern, Aloni and Javidi adds the same variances: `η Φ t + D t + σ²`.

    Parameters
    ----------
    offset_dn : Map
        Mean of a dark frame of zero exposure, in DN.
    gain_dn_per_e : Map
        DN per electron.
    read_noise_e : Map
        σ, standard deviation of the read noise, in electrons.
    dark_current_e_per_s : Map
        D, electrons per pixel and second without light.
    quantum_efficiency : float, optional
        η, electrons per photon; None if unknown.
    saturation_dn : float
        Value from which pixels are saturated.

    Raises
    ------
    ValueError
        A number is not finite (only `saturation_dn` may be infinite) or too large to compute with, a gain is not
        positive, or a noise is negative.
    """

    offset_dn: Map
    gain_dn_per_e: Map
    read_noise_e: Map
    dark_current_e_per_s: Map = 0.0
    quantum_efficiency: float | None = None
    saturation_dn: float = np.inf

    def __post_init__(self) -> None:
        _require("offset_dn", self.offset_dn, at_least=-_MAX_NUMBER)
        _require("gain_dn_per_e", self.gain_dn_per_e, at_least=1 / _MAX_NUMBER)
        _require("read_noise_e", self.read_noise_e, at_least=0.0)
        _require("dark_current_e_per_s", self.dark_current_e_per_s, at_least=0.0)
        if self.quantum_efficiency is not None:
            _require("quantum_efficiency", self.quantum_efficiency, at_least=1 / _MAX_NUMBER, at_most=1.0)
        if not self.saturation_dn > 0:
            raise ValueError(f"saturation_dn must be positive, got {self.saturation_dn}")

    def electrons(self, frame_dn: NDArray[Any]) -> NDArray[np.float32]:
        """Return a frame (row, column) in electrons; read noise can make them negative."""
        electrons: NDArray[np.float32] = np.subtract(frame_dn, self.offset_dn, dtype=np.float32)
        electrons /= np.asarray(self.gain_dn_per_e, np.float32)
        return electrons

    def saturated(self, frame_dn: NDArray[Any]) -> NDArray[np.bool_]:
        """Return the saturated pixels of a frame (row, column)."""
        return np.asarray(frame_dn >= self.saturation_dn)

    def background_e(self, exposure_s: float) -> Map:
        """Return the expected dark electrons `D t` of one exposure."""
        return self.dark_current_e_per_s * exposure_s

    def read_variance_e2(self) -> Map:
        """Return the variance that does not depend on light: read noise, and rounding to whole DN (1/12 DN²)."""
        return self.read_noise_e**2 + 1.0 / (12.0 * self.gain_dn_per_e**2)


def _require(name: str, value: Map, *, at_least: float, at_most: float = _MAX_NUMBER) -> None:
    """Raise ValueError unless all numbers of `value` are finite and within the limits."""
    numbers = np.asarray(value)
    if not np.isfinite(numbers).all():
        raise ValueError(f"{name} must be finite everywhere, got {_range(numbers)}")
    if (numbers < at_least).any() or (numbers > at_most).any():
        raise ValueError(f"{name} must lie within [{at_least:.3g}, {at_most:.3g}], got {_range(numbers)}")


def _range(numbers: NDArray[Any]) -> str:
    """Return a number, or the smallest and largest of several, for a message of one line."""
    return f"{numbers:.6g}" if numbers.ndim == 0 else f"{numbers.min():.6g} to {numbers.max():.6g}"
