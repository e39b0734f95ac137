"""Response of the pixels to light: dead pixels, vignetting, and the spread of the rest (PRNU)."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from faintfield.calib.estimate import Estimate, root
from faintfield.calib.noise.strips import (
    Array,
    Map,
    Mask,
    map_of,
    maps_of,
    mean_over,
    over_strips,
    thinned,
    variance_over,
)

# Response below which a pixel is dead, over the lower quartile of its neighbourhood. At an edge of the light, and at
# its corners, more than a quarter of the neighbours are as dim as the pixel.
_MIN_RESPONSE, _QUARTILE = 0.5, 0.25

# Width of the neighbourhood, and pixels that are compared with theirs at once.
_WINDOW_PX, _CHUNK_PX = 15, 1 << 14

# Rows whose products are summed at once.
_ROWS = 256

# Order of the surface, the orders in row and column of its polynomials, and its least value; light that is as uneven is
# not fitted.
_ORDER = 4
_LOW_ORDERS = tuple((row, column) for row in range(_ORDER + 1) for column in range(_ORDER + 1 - row))
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
    relative, vignetting, relative_se : array (row, column)
        Response over its mean, its smooth part, and the standard error of the rest.
    spread2, spread2_se : float
        Variance of the rest over the square of the mean (that of EMVA 1288's PRNU after its high-pass filter), and its
        standard error. It may be negative by chance.
    dead : array (row, column), bool
        Pixels that respond less than half as much as their neighbourhood.
    why_no_prnu : str
        Why the rest is not the PRNU; empty if it is.
    """

    relative: Map
    vignetting: Map
    relative_se: Map
    spread2: float
    spread2_se: float
    dead: Mask
    why_no_prnu: str = ""

    @property
    def prnu(self) -> float:
        """Standard deviation of the rest relative to the mean."""
        return float(np.sqrt(max(self.spread2, 0.0)))

    def prnu_estimate(self) -> Estimate:
        """Return PRNU with its interval, or the reason why it has none."""
        if self.why_no_prnu:
            return Estimate(None, why=self.why_no_prnu)
        return root(self.spread2, self.spread2_se)


@dataclass(frozen=True)
class SignalNoise:
    """Variance of a signal at its mean: the part that grows with light, the rest, and the standard error of both."""

    shot_dn2: float
    dark_dn2: float
    se_dn2: float = 0.0


def measure_response(signal_dn: Map, noise: SignalNoise, usable: Mask) -> Response:
    """Separate vignetting from PRNU, and shrink the latter by its share of noise.

    Parameters
    ----------
    signal_dn : array (row, column)
        Means of the flat series minus offset and dark signal, summed over the series.
    noise : SignalNoise
        Noise of this sum.
    usable : array (row, column), bool
        Pixels in use.
    """
    mean = mean_over(lambda rows: signal_dn[rows], usable)
    raw = map_of(lambda rows: signal_dn[rows] / mean, usable.shape, signal_dn.dtype)
    dead = _dead(raw, usable)
    usable = map_of(lambda rows: usable[rows] & ~dead[rows], dead.shape, bool)
    vignetting = running_mean(raw, usable, _width(raw.shape))
    why_no_prnu = _why_colour(raw, usable) or _why_uneven(vignetting, usable)
    if not why_no_prnu:
        vignetting = smooth_part(raw, usable)

    def pixel(rows: slice) -> Array:
        return np.asarray(np.divide(raw[rows], np.maximum(vignetting[rows], 1e-6), dtype=np.float64) - 1)

    # Shot noise grows less than the signal, so that brighter pixels have less of it in relation to their signal.
    def chance_of(rows: slice) -> Array:
        light = np.maximum(vignetting[rows], 1e-6, dtype=np.float64)
        return np.asarray((noise.shot_dn2 * light + noise.dark_dn2) / (mean * light) ** 2)

    # The smooth part holds a part of each pixel, which is missing from the rest
    scatter2 = variance_over(pixel, usable) / kept_freedom(usable).share
    mean_chance = mean_over(chance_of, usable)
    spread2 = scatter2 - mean_chance
    known = noise.se_dn2 / (noise.shot_dn2 + noise.dark_dn2) * mean_chance
    error2 = float(np.hypot(max(scatter2, mean_chance) * np.sqrt(2 / usable.sum()), known))

    def work(rows: slice) -> tuple[Map, Map]:
        chance, smooth, found2 = chance_of(rows), vignetting[rows], max(spread2, 0.0)
        kept = found2 / (found2 + chance)
        return smooth * (1 + np.where(usable[rows], kept * pixel(rows), 0.0)), smooth * np.sqrt(kept * chance)

    relative, relative_se = maps_of(work, raw.shape, (raw.dtype,) * 2)
    return Response(
        relative=relative,
        vignetting=vignetting,
        relative_se=relative_se,
        spread2=spread2,
        spread2_se=error2,
        dead=dead,
        why_no_prnu=why_no_prnu,
    )


def _why_colour(raw: Map, usable: Mask) -> str:
    phases = [np.s_[row::2, column::2] for row, column in np.ndindex(2, 2)]
    middle = [float(np.median(raw[at][usable[at]])) for at in phases if usable[at].any()]
    if max(middle) <= _MAX_ALTERNATE * max(min(middle), 1e-6):
        return ""
    means = ", ".join(f"{value:.2f}" for value in middle)
    return (
        f"pixels of even and odd rows and columns respond by {means} of the mean (a ratio of {_MAX_ALTERNATE:g} is the "
        'limit), as colour filters make them: state them, for example mosaic = ["RG", "GB"]'
    )


def _why_uneven(vignetting: Map, usable: Mask) -> str:
    dim, bright = np.quantile(thinned(vignetting, usable), (_TAIL, 1 - _TAIL))
    if bright <= _MAX_UNEVEN * max(dim, 1e-6):
        return ""
    return (
        f"the light of the flats is {bright / max(dim, 1e-6):.2g} times as bright in one part of the image as in "
        f"another (limit {_MAX_UNEVEN:g}), so that its edges cannot be told from the pixels' response; light the "
        "sensor evenly, or state a region that is"
    )


def _dead(raw: Map, usable: Mask) -> Mask:
    """Return the usable pixels that respond less than half as much as the lower quartile of their neighbourhood."""
    # No quartile is above 4/3 of the mean, so that few pixels need one
    around_mean = running_mean(raw, usable, _WINDOW_PX)

    def dim(rows: slice) -> NDArray[np.intp]:
        row, column = np.nonzero(usable[rows] & (raw[rows] < _MIN_RESPONSE / (1 - _QUARTILE) * around_mean[rows]))
        return np.stack([rows.start + row, column], axis=1)

    places = np.concatenate(over_strips(dim, raw.shape))
    dead = np.zeros(raw.shape, bool)
    if not places.size:
        return dead
    half = _WINDOW_PX // 2
    padded = np.pad(np.where(usable, raw, raw.dtype.type(np.nan)), half, constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, (_WINDOW_PX, _WINDOW_PX))
    for start in range(0, len(places), _CHUNK_PX):
        row, column = places[start : start + _CHUNK_PX].T
        quartile = np.nanquantile(around[row, column].reshape(row.size, -1), _QUARTILE, axis=1)
        dead[row, column] = raw[row, column] < _MIN_RESPONSE * quartile
    return dead


def _width(shape: tuple[int, ...]) -> int:
    return int(max(_WINDOW_PX, min(shape) // 16) | 1)


def smooth_part(response: Map, usable: Mask) -> Map:
    """Return the smooth part: a surface of fourth order, times the running mean over the rest.

    The running mean is a sixteenth of the frame wide, over the usable pixels. Alone it would be off where the light
    slopes at the edges of the frame.
    """
    surface = _surface(response, usable)
    rest = map_of(lambda rows: response[rows] / surface(rows), response.shape, response.dtype)
    smooth = running_mean(rest, usable, _width(response.shape))
    return map_of(lambda rows: smooth[rows] * surface(rows), smooth.shape, smooth.dtype)


def _surface(response: Map, usable: Mask) -> Callable[[slice], Array]:
    """Return the polynomial of fourth order in row and column with the least squares over the usable pixels.

    It is a function of some rows (row, column), and no less than `_MIN_SURFACE`.
    """
    of_rows, of_columns = (np.polynomial.legendre.legvander(np.linspace(-1, 1, size), 4) for size in usable.shape)
    low = np.add.outer(np.arange(5), np.arange(5)) <= 4
    products = [np.einsum("pi,pk->pik", basis, basis).reshape(len(basis), 25) for basis in (of_rows, of_columns)]

    def work(rows: slice) -> Array:
        counted = usable[rows].astype(np.float64)
        moments = products[0][rows].T @ (counted @ products[1])
        weighted = of_rows[rows].T @ (np.where(usable[rows], response[rows], 0.0).astype(np.float64) @ of_columns)
        return np.concatenate([moments.ravel(), weighted.ravel()])

    # Products of matrices have threads of their own
    sums = sum((work(slice(first, first + _ROWS)) for first in range(0, len(usable), _ROWS)), np.zeros(650))
    moments, weighted = sums[:625].reshape(5, 5, 5, 5).transpose(0, 2, 1, 3), sums[625:].reshape(5, 5)
    surface = np.zeros((5, 5))
    surface[low] = np.linalg.lstsq(moments[low][:, low], weighted[low])[0]
    return lambda rows: np.maximum(of_rows[rows] @ surface @ of_columns.T, _MIN_SURFACE)


def running_mean(response: Map, usable: Mask, window: int) -> Map:
    """Return the mean of the usable pixels over a window around each (row, column)."""
    mean = _box(np.where(usable, response, response.dtype.type(0)), window)
    share = _box(usable.astype(response.dtype), window)
    return map_of(lambda rows: mean[rows] / np.maximum(share[rows], 1e-6), mean.shape, mean.dtype)


def _box(values: Map, window: int) -> Map:
    """Return the mean over a window around each value, beyond an edge of the values at the edge (row, column)."""
    return np.asarray(cv2.blur(values, (window, window), borderType=cv2.BORDER_REPLICATE))


@dataclass(frozen=True)
class KeptFreedom:
    """Degrees of freedom of independent pixels that are left when `smooth_part` is subtracted.

    `total` are those of all usable pixels, `rows` and `columns` those of the means of rows and of columns, `pixels`
    those of the rest. `share` is the total over the number of pixels.
    """

    total: float
    rows: float
    columns: float
    share: float

    @property
    def pixels(self) -> float:
        """Degrees of freedom without those of rows and columns."""
        return max(self.total - self.rows - self.columns, 1.0)


def kept_freedom(usable: Mask) -> KeptFreedom:
    """Return the degrees of freedom that the surface and the running mean leave of each kind.

    Of the surface P and the running mean B, (I − B)(I − P) is left; the squares of its elements are those of I − B
    less those of I − B times the basis of P.
    """
    window = _width(usable.shape)
    smoothed, rows, columns = 0.0, *(_kept_of_lines(size, window) for size in usable.shape)
    bases = [_orthonormal(size) for size in usable.shape]
    blurred = [ndimage.uniform_filter1d(basis, window, axis=0, mode="nearest") for basis in bases]
    squares, means, both = (
        [np.sum(a * b, axis=0) for a, b in zip(*pair, strict=True)]
        for pair in ((bases, bases), (bases, blurred), (blurred, blurred))
    )
    for row, column in _LOW_ORDERS:
        parts = [kind[0][row] * kind[1][column] for kind in (squares, means, both)]
        smoothed += parts[0] - 2 * parts[1] + parts[2]
    total = mean_over(_kept_share(usable), usable) * float(usable.sum()) - smoothed
    return KeptFreedom(total, rows, columns, total / float(usable.sum()))


def _orthonormal(size: int) -> Array:
    """Return the polynomials up to the fourth order, orthonormal over the places of a line (place, order)."""
    return np.asarray(np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, size), _ORDER))[0])


def _kept_of_lines(size: int, window: int) -> float:
    own, squares = _line_weights(size, window)
    basis = _orthonormal(size)
    rest = basis - ndimage.uniform_filter1d(basis, window, axis=0, mode="nearest")
    return max(float(np.sum(1 - 2 * own + squares) - np.square(rest).sum()), 1.0)


def _kept_share(usable: Mask) -> Callable[[slice], Array]:
    """Return the share of independent pixels' variance that is left when the running mean is subtracted, by its rows.

    With the weights a_ij of the running mean it is 1 − 2 a_ii + Σ_j a_ij². At an edge of the frame the outermost pixel
    stands for those that are missing beyond.
    """
    window = _width(usable.shape)
    own, squares = zip(*(_line_weights(size, window) for size in usable.shape), strict=True)
    weight = _box(usable.astype(np.float32), window)

    def share(rows: slice) -> Array:
        loss = 2 * np.outer(own[0][rows], own[1]) - np.outer(squares[0][rows], squares[1])
        return np.asarray(np.maximum(1 - loss / np.maximum(weight[rows], 1e-6), 0.05))

    return share


def _line_weights(size: int, window: int) -> tuple[Array, Array]:
    """Return the weight of each place of a line in its own running mean, and the sum of all squared weights there."""
    # Only near the ends do they differ from those in the middle
    some = min(size, 2 * window + 1)
    weights = ndimage.uniform_filter1d(np.eye(some), window, axis=0, mode="nearest")
    spread = np.minimum(np.arange(size), some // 2)
    spread = np.where(np.arange(size) >= size - some // 2, np.arange(size) - (size - some), spread)
    return np.diag(weights)[spread], np.square(weights).sum(axis=1)[spread]
