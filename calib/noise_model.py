"""Noise model of a sensor, which converts digital numbers to electrons with known statistics."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Rows that are converted at a time, so that one pass finds in the cache what the pass before it wrote.
_STRIP_ROWS = 64

# Largest number of a sensor; the squares of what is computed from such numbers do not overflow single precision.
_MAX_NUMBER = 1e6

type Map = float | NDArray[np.floating]
"""One value for the whole sensor, or one per pixel as an array (row, column)."""


@dataclass(frozen=True)
class BentResponse:
    """A response that bends: the charge behind a signal s is `s (1 + κ₁ s + κ₂ s² + …) / gain`.

    Below zero, and beyond the brightest light that was measured, it goes on straight.

    Parameters
    ----------
    bends_per_dn, up_to_dn : tuple of Map, Map
        κ₁ in 1/DN, κ₂ in 1/DN² and so on; signal up to which the bend was measured.

    Raises
    ------
    ValueError
        A number is not finite, the range is not positive, or the charge does not grow with the signal.
    """

    bends_per_dn: tuple[Map, ...]
    up_to_dn: Map

    def __post_init__(self) -> None:
        _require("up_to_dn", self.up_to_dn, at_least=1 / _MAX_NUMBER)
        for bend in self.bends_per_dn:
            _require("bends_per_dn", bend, at_least=-_MAX_NUMBER)
        within = (share * self.up_to_dn for share in np.linspace(0, 1, 33))
        if not min(float(np.min(_slope(self.bends_per_dn, signal_dn))) for signal_dn in within) > 0:
            raise ValueError(f"bends_per_dn {self.bends_per_dn}: the charge must grow with the signal")

    def charge_dn(self, signal_dn: NDArray[np.floating], rows: slice = slice(None)) -> NDArray[np.float64]:
        """Return the charge behind a signal (row, column) of some rows, times the gain at zero signal."""
        within = np.clip(np.asarray(signal_dn, float), 0.0, _of_rows(self.up_to_dn, rows))
        bends = [_of_rows(bend, rows) for bend in self.bends_per_dn]
        factor = 1.0 + sum(bend * within**power for power, bend in enumerate(bends, 1))
        return np.asarray(within * factor + (signal_dn - within) * _slope(bends, within))

    def slope(self, signal_dn: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the gain at zero signal over that at the signals (row, column)."""
        return np.asarray(_slope(self.bends_per_dn, np.clip(np.asarray(signal_dn, float), 0.0, self.up_to_dn)))

    def part(self, of: Callable[[NDArray[Any]], NDArray[Any]]) -> "BentResponse":
        """Return the response of a part of the pixels, which `of` takes from a map."""
        bends = tuple(of(np.asarray(bend)) if np.ndim(bend) == 2 else bend for bend in self.bends_per_dn)
        up_to = of(np.asarray(self.up_to_dn)) if np.ndim(self.up_to_dn) == 2 else self.up_to_dn
        return BentResponse(bends, up_to)


@dataclass(frozen=True)
class NoiseModel:
    """A sensor: `dn = offset + gain · (Poisson(η Φ t + D t) + N(0, σ²))`, rounded to whole DN, linear unless stated.

    Eq. (6) of Stern, Aloni and Javidi adds the same variances: `η Φ t + D t + σ²`.

    Parameters
    ----------
    offset_dn, gain_dn_per_e : Map
        Mean of a dark frame of zero exposure, in DN; DN per electron, at zero signal where the response bends.
    read_noise_e, dark_current_e_per_s : Map
        σ, standard deviation of the read noise, in electrons; D, electrons per pixel and second without light.
    quantum_efficiency : float, optional
        η, electrons per photon; None if unknown.
    saturation_dn : float
        Value from which pixels are saturated.
    response : BentResponse, optional
        Bend of the response; None for a linear sensor.

    Raises
    ------
    ValueError
        A number is not finite (only `saturation_dn` may be infinite) or too large to compute with, a gain is not
        positive, or a noise is negative.

    Examples
    --------
    A pixel of 124 DN, of a camera with an offset of 100 DN and 2 DN per electron:

    >>> import numpy as np
    >>> from faintfield import NoiseModel
    >>> noise = NoiseModel(offset_dn=100.0, gain_dn_per_e=2.0, read_noise_e=3.5, dark_current_e_per_s=0.2)
    >>> noise.electrons(np.array([[124]]))
    array([[12.]], dtype=float32)
    >>> noise.background_e(exposure_s=10.0)
    2.0
    """

    offset_dn: Map
    gain_dn_per_e: Map
    read_noise_e: Map
    dark_current_e_per_s: Map = 0.0
    quantum_efficiency: float | None = None
    saturation_dn: float = np.inf
    response: BentResponse | None = None

    def __post_init__(self) -> None:
        _require("offset_dn", self.offset_dn, at_least=-_MAX_NUMBER)
        _require("gain_dn_per_e", self.gain_dn_per_e, at_least=1 / _MAX_NUMBER)
        _require("read_noise_e", self.read_noise_e, at_least=0.0)
        _require("dark_current_e_per_s", self.dark_current_e_per_s, at_least=0.0)
        if self.quantum_efficiency is not None:
            _require("quantum_efficiency", self.quantum_efficiency, at_least=1 / _MAX_NUMBER, at_most=1.0)
        if not self.saturation_dn > 0:
            raise ValueError(f"saturation_dn must be positive, got {self.saturation_dn}")

    def electrons(self, frame_dn: NDArray[Any], out: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
        """Return a frame (row, column) in electrons, in `out` if given; read noise can make them negative."""
        electrons = np.empty(np.shape(frame_dn), np.float32) if out is None else out
        gain_dn_per_e = np.asarray(self.gain_dn_per_e, np.float32)
        for top in range(0, len(electrons), _STRIP_ROWS):
            rows = slice(top, top + _STRIP_ROWS)
            strip = electrons[rows]
            np.subtract(frame_dn[rows], _of_rows(self.offset_dn, rows), out=strip, dtype=np.float32)
            if self.response is not None:
                strip[:] = self.response.charge_dn(strip, rows)
            strip /= _of_rows(gain_dn_per_e, rows)
        return electrons

    def local_gain_dn_per_e(self, frame_dn: NDArray[Any]) -> NDArray[np.float64]:
        """Return the DN that one more electron adds to each pixel of a frame (row, column)."""
        gain = np.broadcast_to(np.asarray(self.gain_dn_per_e, float), np.shape(frame_dn))
        return gain.copy() if self.response is None else gain / self.response.slope(frame_dn - self.offset_dn)

    def variance_dn2(self, frame_dn: NDArray[Any]) -> NDArray[np.float64]:
        """Return the variance that noise and rounding give to each pixel of a frame (row, column) of means."""
        charge = np.maximum(self.electrons(frame_dn).astype(float), 0.0)
        return np.asarray((charge + self.read_noise_e**2) * self.local_gain_dn_per_e(frame_dn) ** 2 + 1.0 / 12.0)

    def saturated(self, frame_dn: NDArray[Any]) -> NDArray[np.bool_]:
        """Return the saturated pixels of a frame (row, column); of real numbers, those that are NaN, too."""
        if frame_dn.dtype.kind in "iu":  # compared as whole numbers, which takes no array of floats
            if self.saturation_dn > np.iinfo(frame_dn.dtype).max:
                return np.zeros(frame_dn.shape, bool)
            return np.asarray(frame_dn >= int(np.ceil(self.saturation_dn)))
        return ~np.asarray(frame_dn < self.saturation_dn)

    def background_e(self, exposure_s: float) -> Map:
        """Return the expected dark electrons `D t` of one exposure."""
        return self.dark_current_e_per_s * exposure_s

    def read_variance_e2(self) -> Map:
        """Return the variance that does not depend on light: read noise, and rounding to whole DN (1/12 DN²)."""
        return self.read_noise_e**2 + 1.0 / (12.0 * self.gain_dn_per_e**2)


def _slope(bends_per_dn: Sequence[Map], within: Any) -> Any:
    return 1.0 + sum((power + 1) * bend * within**power for power, bend in enumerate(bends_per_dn, 1))


def _of_rows(value: Map, rows: slice) -> Map:
    """Return some rows of a map; one number, or one row, is that of all."""
    return value if np.ndim(value) < 2 or len(np.asarray(value)) == 1 else np.asarray(value)[rows]


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
