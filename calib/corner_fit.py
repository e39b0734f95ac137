"""Fit the corners of a chessboard to a fraction of a pixel, with standard deviations.

Two edges cross in a corner, each blurred by lens and pixel. With t along an edge and n across it, from the corner,

    I(u) = a + c f₁ f₂,      fᵢ = erf(dᵢ / √2 s),      dᵢ = nᵢ − κᵢ tᵢ² / 2,

is fitted to the pixels beside the edges by weighted least squares. A corner has nine parameters: its position, the
directions and bends of its edges, the blur, and two levels. The weight of a pixel follows from its noise, which grows
with the light; the inverse of the normal matrix is the covariance.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

type Array = NDArray[np.float64]
type Pixels = NDArray[np.floating]  # single precision: each step corrects the rounding of the one before

# Parameters of a corner: x, y (px), two directions (rad), two bends (1/px), ln of the blur (px), a, c.
_PLACE, _ANGLES, _BENDS, _BLUR, _LEVEL, _CONTRAST = slice(0, 2), slice(2, 4), slice(4, 6), 6, 7, 8
_COUNT = 9

# Extent of the window along an edge and to its sides; in longer ones errors of lens and print exceed the noise.
_MAX_ALONG_PX, _MAX_ACROSS_PX, _MIN_ACROSS_PX = 10.0, 5.0, 1.5
_MAX_ALONG_SQUARES = 0.75  # keeps clear of the next corner
_BLUR_OF_MARKERS_PX = 1.0

# Priors: standard deviation of the turn of an edge over the image's width (rad), and mean and standard deviation of the
# blur of a lens, the latter of its logarithm.
_BEND_SD = 0.25
_BLUR_PX, _LOG_BLUR_SD = 0.7, 0.6
_INITIAL_BLUR_PX = 1.2  # wider than most, so that the fit converges from guesses some pixels off
_PIXEL_VARIANCE = 1 / 12  # px², since a pixel is the mean over its area

# Numbers of steps in windows about the guesses, then about the corners found; the step that ends each; largest steps.
_MAX_STEPS = (8, 4)
_TOLERANCE_PX = 1e-4
_LARGEST_STEP = np.array([0.7, 0.7, 0.1, 0.1, 0.01, 0.01, 0.25, np.inf, np.inf])

# Limits for a corner to be accepted: distance from its guess, contrast over its own σ, and pixels in its window.
_MAX_SHIFT_PX, _MIN_CONTRAST_SIGMAS, _MIN_PIXELS = 4.0, 4.0, 24

_FLAT = 0.9  # |f₁ f₂| from which a pixel counts as flat
_MIN_NOISE = 1e-3  # of the contrast, for images without noise

# Standard deviation in pixels that lens and print add in any case.
_FLOOR_PX = 0.01


@dataclass(frozen=True)
class _Windows:
    """Pixels about each corner: positions (corner, pixel, 2), values and use in the fit (corner, pixel)."""

    places: Pixels
    values: Pixels
    counts: NDArray[np.bool_]


def refine_corners(image: NDArray[np.float32], guesses: Array, squares_px: Array, clear: float) -> tuple[Array, Array]:
    """Return the corners near the guesses, and their standard deviations per axis.

    Parameters
    ----------
    image : array (row, column)
        Image that is linear in the light, in any unit.
    guesses : array (corner, 2)
        Column and row to within a few pixels.
    squares_px : array (corner, 2, 2)
        Image of one square at each corner: the step along the board's rows, then that along its columns.
    clear : float
        Distance from an edge, in squares, up to which only its two squares are seen.

    Returns
    -------
    points : array (corner, 2)
        Column and row; NaN if there is no corner near the guess.
    sigma_px : array (corner,)
        Standard deviations from the noise of the flat pixels beside the edges; NaN likewise.
    """
    if not len(guesses):
        return np.empty((0, 2)), np.empty(0)
    state = np.zeros((len(guesses), _COUNT))  # positions are relative to the guesses
    state[:, _ANGLES] = np.arctan2(squares_px[..., 1], squares_px[..., 0])
    state[:, _BLUR] = np.log(_INITIAL_BLUR_PX)
    for index, max_steps in enumerate(_MAX_STEPS):
        windows = _windows(image, guesses, state[:, _PLACE], squares_px, clear)
        if index == 0:
            _set_levels(state, windows)
        for _ in range(max_steps):
            step, normal = _step(state, windows, image.shape[1])
            state += np.clip(step, -_LARGEST_STEP, _LARGEST_STEP)
            if np.abs(step[:, _PLACE]).max() < _TOLERANCE_PX:
                break
    points = guesses + state[:, _PLACE]
    variances = np.diagonal(np.linalg.inv(normal), axis1=1, axis2=2)
    found = np.abs(state[:, _PLACE]).max(axis=1) <= _MAX_SHIFT_PX
    found &= np.square(state[:, _CONTRAST]) >= _MIN_CONTRAST_SIGMAS**2 * variances[:, _CONTRAST]
    # Where the pixels say nothing, rounding can make a variance of the inverted matrix negative.
    found &= (variances[:, _CONTRAST] > 0) & (variances[:, _PLACE].mean(axis=1) > 0)
    found &= windows.counts.sum(axis=1) >= _MIN_PIXELS
    found &= ((points >= 0) & (points <= np.array(image.shape[::-1]) - 1)).all(axis=1)
    place_variances = np.where(found, variances[:, _PLACE].mean(axis=1), np.nan)
    return np.where(found[:, np.newaxis], points, np.nan), np.hypot(np.sqrt(place_variances), _FLOOR_PX)


def _windows(image: Pixels, guesses: Array, positions: Array, squares_px: Array, clear: float) -> _Windows:
    """Return a cross of pixels along the edges about the positions (corner, 2), relative to the guesses."""
    sides = np.linalg.norm(squares_px, axis=2)
    heights = np.abs(np.linalg.det(squares_px))[:, np.newaxis] / sides
    along = np.minimum(_MAX_ALONG_SQUARES * sides, _MAX_ALONG_PX)
    across = np.clip(clear * heights - _BLUR_OF_MARKERS_PX, _MIN_ACROSS_PX, _MAX_ACROSS_PX)
    reach = np.arange(-int(along.max()) - 1, int(along.max()) + 2)
    offsets = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    whole = np.rint(guesses + np.clip(positions, -_MAX_SHIFT_PX, _MAX_SHIFT_PX)).astype(int)[:, np.newaxis] + offsets
    limits = np.array(image.shape[::-1]) - 1
    columns, rows = np.moveaxis(np.clip(whole, 0, limits), -1, 0)
    places = whole - guesses[:, np.newaxis]
    cos, sin = np.moveaxis(squares_px / sides[..., np.newaxis], -1, 0)[..., np.newaxis]
    x, y = np.moveaxis(places - positions[:, np.newaxis], -1, 0)[:, :, np.newaxis]
    beside = (np.abs(x * cos + y * sin) <= along[..., np.newaxis]) & (
        np.abs(y * cos - x * sin) <= across[..., np.newaxis]
    )
    inside = ((whole >= 0) & (whole <= limits)).all(axis=2)
    return _Windows(places.astype(np.float32), image[rows, columns], beside.any(axis=1) & inside)


def _set_levels(state: Array, windows: _Windows) -> None:
    """Set a and c, in place, by a linear regression of the pixels on the pattern."""
    _, _, rise, *_ = _edges(state, windows)
    pattern = rise[0] * rise[1]
    share = windows.counts / np.maximum(windows.counts.sum(axis=1, keepdims=True), 1)
    middle, level = ((share * what).sum(axis=1, keepdims=True) for what in (pattern, windows.values))
    slope = (share * (pattern - middle) * windows.values).sum(axis=1)
    state[:, _CONTRAST] = slope / np.maximum((share * np.square(pattern - middle)).sum(axis=1), 1e-12)
    state[:, _LEVEL] = level[:, 0] - state[:, _CONTRAST] * middle[:, 0]


def _edges(state: Array, windows: _Windows) -> tuple[Pixels, Pixels, Pixels, Pixels, Pixels, Pixels]:
    """Return both edges of each corner at the pixels of the windows, each (2, corner, pixel).

    These are distances along and across, f, its derivative by d, and the cosine and sine of the direction.
    """
    numbers = state.astype(np.float32)[..., np.newaxis]
    x, y = (windows.places[..., axis] - numbers[:, axis] for axis in (0, 1))
    angles, bends = (np.swapaxes(numbers[:, which], 0, 1) for which in (_ANGLES, _BENDS))
    blur = np.sqrt(np.exp(2 * numbers[:, _BLUR]) + np.float32(_PIXEL_VARIANCE))
    cos, sin = np.cos(angles), np.sin(angles)
    along = x * cos + y * sin
    across = y * cos - x * sin - bends * along * along / 2
    blurs = across / (np.float32(np.sqrt(2)) * blur)
    slope = np.exp(-np.square(blurs)) * (np.float32(np.sqrt(2 / np.pi)) / blur)
    return along, across, erf(blurs), slope, cos, sin


def _step(state: Array, windows: _Windows, width_px: int) -> tuple[Array, Array]:
    """Return the Gauss-Newton step of each corner (corner, 9), and its normal matrix (corner, 9, 9)."""
    along, across, rise, slope, cos, sin = _edges(state, windows)
    pattern = rise[0] * rise[1]
    level, contrast = (state[:, which, np.newaxis].astype(np.float32) for which in (_LEVEL, _CONTRAST))
    residuals = windows.values - level - contrast * pattern
    tilt = contrast * slope * rise[::-1]  # ∂I/∂dᵢ
    by_blur = -(tilt * across).sum(axis=0) / (1 + _PIXEL_VARIANCE * np.exp(-2 * state[:, _BLUR, np.newaxis]))
    by_place = (tilt * sin).sum(axis=0), -(tilt * cos).sum(axis=0)
    by_angle = -tilt * along
    by_bend = by_angle * along / 2
    flat = np.ones_like(pattern)
    slopes = np.stack([*by_place, *by_angle, *by_bend, by_blur, flat, pattern], axis=1, dtype=np.float32)
    weighted = slopes * (windows.counts / _variances(state, windows, pattern, residuals))[:, np.newaxis]
    normal = (weighted @ np.swapaxes(slopes, 1, 2)).astype(np.float64)
    right = (weighted @ residuals[..., np.newaxis])[..., 0].astype(np.float64)
    known, weights = np.zeros(_COUNT), np.full(_COUNT, 1e-12)  # not zero, or windows without pixels would be singular
    weights[_BENDS] = (width_px / _BEND_SD) ** 2
    known[_BLUR], weights[_BLUR] = np.log(_BLUR_PX), _LOG_BLUR_SD**-2
    normal[:, range(_COUNT), range(_COUNT)] += weights
    return np.linalg.solve(normal, (right + weights * (known - state))[..., np.newaxis])[..., 0], normal


def _variances(state: Array, windows: _Windows, pattern: Pixels, residuals: Pixels) -> Pixels:
    """Return the variance of each pixel (corner, pixel), linear in the light between dark and white squares.

    Both ends are medians over the corners, so that guesses without a corner do not matter.
    """
    counts = windows.counts.sum(axis=1)
    freedom = np.maximum(counts - _COUNT, 1) / np.maximum(counts, 1)
    light = np.sign(state[:, _CONTRAST, np.newaxis]) * pattern
    found = []
    for side in (-light, light):
        flat = windows.counts & (side > _FLAT)
        corners = flat.any(axis=1)
        squares = np.square(residuals[corners]).sum(axis=1, where=flat[corners]) / flat[corners].sum(axis=1)
        found.append(float(np.median(squares / freedom[corners])) if corners.any() else 0.0)
    dark, white = found[0], max(found)  # light adds noise; clipped whites only seem to have none
    floor = (_MIN_NOISE * float(np.median(np.abs(state[:, _CONTRAST])))) ** 2
    return np.asarray(np.maximum(dark + (white - dark) * (1 + light) / 2, floor) + np.float32(1e-30), np.float32)
