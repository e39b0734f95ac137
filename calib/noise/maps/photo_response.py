"""Response of the pixels to light: dead pixels, vignetting, and the spread of the rest (PRNU)."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from faintfield.calib.noise.intervals import interval
from faintfield.calib.noise.result import Estimate

type Array = NDArray[np.float64]
type Mask = NDArray[np.bool_]

# Response below which a pixel is dead, over the lower quartile of its neighbourhood. At an edge of the light, and at
# its corners, more than a quarter of the neighbours are as dim as the pixel.
_MIN_RESPONSE, _QUARTILE = 0.5, 0.25

# Width of the neighbourhood, and pixels that are compared with theirs at once.
_WINDOW_PX, _CHUNK_PX = 15, 1 << 14

# Least value of the surface of fourth order; light that is as uneven is not fitted.
_MIN_SURFACE = 0.1

# Largest ratio of the light over the image, by its quantiles, with which PRNU is measured.
_MAX_UNEVEN, _TAIL = 2.0, 0.005

# Largest ratio between the means of alternate rows and columns that no colour filters make.
_MAX_ALTERNATE = 1.15


@dataclass(frozen=True)
class Response:
    """Response of the sensor to even light.

    Attributes
    ----------
    relative, vignetting : array (row, column)
        Response over its mean, and its smooth part.
    relative_se : array (row, column)
        Standard error of the response of a pixel beside the smooth part.
    prnu, prnu_se : float
        Standard deviation of the rest relative to the mean (EMVA 1288's PRNU after its high-pass filter), and its
        standard error.
    dead : array (row, column), bool
        Pixels that respond less than half as much as their neighbourhood.
    why_no_prnu : str
        Why the rest is not the PRNU; empty if it is.
    """

    relative: NDArray[np.float64]
    vignetting: NDArray[np.float64]
    relative_se: NDArray[np.float64]
    prnu: float
    prnu_se: float
    dead: NDArray[np.bool_]
    why_no_prnu: str = ""

    def prnu_estimate(self, quantile: float) -> Estimate:
        """Return PRNU with its interval, or the reason why it has none."""
        if self.why_no_prnu:
            return Estimate(None, why=self.why_no_prnu)
        return interval(self.prnu, self.prnu_se, quantile)


def measure_response(signals_dn: Sequence[Array], noise_dn2: Sequence[float], usable: Mask) -> Response:
    """Separate vignetting from PRNU, and shrink the latter by its share of noise.

    Parameters
    ----------
    signals_dn : sequence of arrays (row, column)
        Mean of each flat series minus offset and dark signal.
    noise_dn2 : sequence of float
        Variance of these means for a pixel of mean signal.
    usable : array (row, column), bool
        Pixels in use.
    """
    total = np.sum(signals_dn, axis=0)
    mean = float(total.mean(where=usable))
    raw = total / mean
    dead = _dead(raw, usable)
    usable = usable & ~dead
    vignetting = _running_mean(raw, usable, _width(raw.shape))
    why_no_prnu = _why_colour(raw, usable) or _why_uneven(vignetting, usable)
    if not why_no_prnu:
        vignetting = _smooth(raw, usable)
    pixel = raw / np.maximum(vignetting, 1e-6) - 1
    # Shot noise grows less than the signal, so that brighter pixels have less of it in relation to their signal.
    noise = float(np.sum(noise_dn2)) / mean**2 / np.maximum(vignetting, 1e-6)
    # The running mean holds a part of each pixel, which is missing from the rest
    scatter2 = float(pixel.var(where=usable)) / float(_kept_share(usable).mean(where=usable))
    spread2 = max(scatter2 - float(noise.mean(where=usable)), 0.0)
    kept = spread2 / (spread2 + noise)
    error2 = (spread2 + float(noise.mean(where=usable))) * np.sqrt(2 / usable.sum())
    return Response(
        relative=vignetting * (1 + np.where(usable, kept * pixel, 0.0)),
        vignetting=vignetting,
        relative_se=vignetting * np.sqrt(kept * noise),
        prnu=float(np.sqrt(spread2)),
        prnu_se=float(np.sqrt(spread2 + error2) - np.sqrt(spread2)),
        dead=dead,
        why_no_prnu=why_no_prnu,
    )


def _why_colour(raw: Array, usable: Mask) -> str:
    """Return that the pixels respond as colour filters in periods of 2 × 2 do, "" if they do not."""
    phases = [np.s_[row::2, column::2] for row, column in np.ndindex(2, 2)]
    middle = [float(np.median(raw[at][usable[at]])) for at in phases if usable[at].any()]
    if max(middle) <= _MAX_ALTERNATE * max(min(middle), 1e-6):
        return ""
    found = ", ".join(f"{it:.2f}" for it in middle)
    return (
        f"pixels of even and odd rows and columns respond by {found} of the mean (a ratio of {_MAX_ALTERNATE:g} is the "
        'limit), as colour filters make them: state them, for example mosaic = ["RG", "GB"]'
    )


def _why_uneven(vignetting: Array, usable: Mask) -> str:
    """Return that the light is too uneven for PRNU, "" if it is not."""
    dim, bright = np.quantile(vignetting[usable], (_TAIL, 1 - _TAIL))
    if bright <= _MAX_UNEVEN * max(dim, 1e-6):
        return ""
    return (
        f"the light of the flats is {bright / max(dim, 1e-6):.2g} times as bright in one part of the image as in "
        f"another (limit {_MAX_UNEVEN:g}), so that its edges cannot be told from the pixels' response; light the "
        "sensor evenly, or state a region that is"
    )


def _dead(raw: Array, usable: Mask) -> Mask:
    """Return the usable pixels that respond less than half as much as the lower quartile of their neighbourhood."""
    # No quartile is above 4/3 of the mean, so that few pixels need one
    dim = usable & (raw < _MIN_RESPONSE / (1 - _QUARTILE) * _running_mean(raw, usable, _WINDOW_PX))
    half = _WINDOW_PX // 2
    padded = np.pad(np.where(usable, raw, np.nan), half, constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, (_WINDOW_PX, _WINDOW_PX))
    dead = np.zeros_like(dim)
    places = np.argwhere(dim)
    for start in range(0, len(places), _CHUNK_PX):
        row, column = places[start : start + _CHUNK_PX].T
        quartile = np.nanquantile(around[row, column].reshape(row.size, -1), _QUARTILE, axis=1)
        dead[row, column] = raw[row, column] < _MIN_RESPONSE * quartile
    return dead


def _width(shape: tuple[int, ...]) -> int:
    """Return the width of the running mean: a sixteenth of the frame."""
    return int(max(_WINDOW_PX, min(shape) // 16) | 1)


def _smooth(response: Array, usable: Mask) -> Array:
    """Return the smooth part: a surface of fourth order, times the running mean over the rest.

    The running mean is a sixteenth of the frame wide, over the usable pixels. Alone it would be off where the light
    slopes at the edges of the frame.
    """
    surface = np.maximum(_surface(response, usable), _MIN_SURFACE)
    return surface * _running_mean(response / surface, usable, _width(response.shape))


def _surface(response: Array, usable: Mask) -> Array:
    """Return the polynomial of fourth order in row and column with the least squares over the usable pixels."""
    of_rows, of_columns = (np.polynomial.legendre.legvander(np.linspace(-1, 1, size), 4) for size in usable.shape)
    low = np.add.outer(np.arange(5), np.arange(5)) <= 4
    products = [np.einsum("pi,pk->pik", one, one).reshape(len(one), 25) for one in (of_rows, of_columns)]
    moments = (products[0].T @ usable.astype(float) @ products[1]).reshape(5, 5, 5, 5).transpose(0, 2, 1, 3)
    weighted = of_rows.T @ np.where(usable, response, 0.0) @ of_columns
    found = np.zeros((5, 5))
    found[low] = np.linalg.lstsq(moments[low][:, low], weighted[low])[0]
    return np.asarray(of_rows @ found @ of_columns.T)


def _running_mean(response: Array, usable: Mask, window: int) -> Array:
    """Return the mean over the usable pixels of a window around each pixel (row, column)."""
    mean = _box(np.where(usable, response, 0.0), window)
    mean /= np.maximum(_box(usable.astype(float), window), 1e-6)
    return mean


def _box(values: Array, window: int) -> Array:
    """Return the mean over a window around each value, beyond an edge of the values at the edge (row, column)."""
    return np.asarray(cv2.blur(values, (window, window), borderType=cv2.BORDER_REPLICATE))


def _kept_share(usable: Mask) -> Array:
    """Return the share of the variance of independent pixels that is left when `_smooth` is subtracted.

    With the weights a_ij of the running mean it is 1 − 2 a_ii + Σ_j a_ij². At an edge of the frame the outermost pixel
    stands for those that are missing beyond.
    """
    window = _width(usable.shape)
    own, squares = zip(*(_line_weights(size, window) for size in usable.shape), strict=True)
    weight = np.maximum(_box(usable.astype(float), window), 1e-6)
    share = 1 - (2 * np.outer(*own) - np.outer(*squares)) / weight
    return np.asarray(np.maximum(share, 0.05))


def _line_weights(size: int, window: int) -> tuple[Array, Array]:
    """Return the weight of each place of a line in its own running mean, and the sum of all squared weights there."""
    weights = ndimage.uniform_filter1d(np.eye(size), window, axis=0, mode="nearest")
    return np.diag(weights).copy(), np.square(weights).sum(axis=1)
