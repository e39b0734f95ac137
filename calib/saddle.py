"""Saddle points: where the corner of a chessboard is, to a small part of a pixel, and how well that is known."""

import cv2
import numpy as np
from numpy.typing import NDArray

_ITERATIONS = 12
_SETTLED_PX = 1e-4

# Below this, what counts is the lens and the print, not the noise.
_FLOOR_PX = 0.02

# Its square sum is 36; it is blind to planes and, nearly, to edges along rows and columns.
_NOISE_KERNEL = np.array([[1.0, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)


def refine_saddles(
    image: NDArray[np.float32], guesses: NDArray[np.floating], radius_px: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the saddle points nearest to guesses, and their standard deviations per axis.

    About each guess the image is fitted by `a + b·u + uᵀ H u / 2` with weights (1 − |u|²/r²)²; the saddle
    is at `−H⁻¹ b`, and the fit is made again about it until it stays. Where both colours lie point-symmetric about a
    corner, so does every term that the fit leaves out: it is unbiased there. σ² is the pixels' noise, found from the
    image's finest detail, carried through the same linear map.

    Parameters
    ----------
    image : array (row, column)
        Linear in the light, in any unit.
    guesses : array (corner, 2)
        Column, row, within a few pixels of the corners.
    radius_px : int
        Of the round window: it should hold nothing but the four squares that meet in the corner.

    Returns
    -------
    points : array (corner, 2)
        NaN where there is no saddle within the radius, or the window leaves the image.
    sigma_px : array (corner,)
        NaN likewise.
    """
    radius_px = max(radius_px, 3)
    across = np.arange(-radius_px, radius_px + 1)
    offsets = np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2)
    offsets = offsets[np.square(offsets).sum(axis=1) <= (radius_px + 1) ** 2]
    points = np.array(guesses, np.float64)
    alive = _inside(points, image.shape, radius_px)
    moving = alive.copy()
    for _ in range(_ITERATIONS):
        if not moving.any():
            break
        step, _, _ = _fit(image, points[moving], offsets, radius_px)
        points[moving] += np.clip(step, -1, 1)
        near = np.abs(points - guesses).max(axis=1, initial=0) <= radius_px  # false for what is no number, too
        alive &= near & _inside(points, image.shape, radius_px)
        moving[moving] = (np.abs(step) >= _SETTLED_PX).any(axis=1)
        moving &= alive
    sigma_px = np.full(len(points), np.nan)
    if alive.any():
        step, hessian, normal = _fit(image, points[alive], offsets, radius_px)
        gain = _gain(points[alive], offsets, radius_px, hessian, normal)
        settled = np.isfinite(step).all(axis=1)
        noise = _noise_sd(image, points[alive], radius_px)
        sigma_px[alive] = np.where(settled, np.hypot(noise * gain, _FLOOR_PX), np.nan)
    points[~np.isfinite(sigma_px)] = np.nan
    return points, sigma_px


def _fit(
    image: NDArray[np.float32], points: NDArray[np.float64], offsets: NDArray[np.intp], radius_px: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the step from each point to its saddle (corner, 2), H (corner, 2, 2) and the normal matrix (…, 6, 6)."""
    columns, rows = np.moveaxis(np.rint(points).astype(int)[:, np.newaxis] + offsets, -1, 0)
    values = image[rows, columns].astype(np.float64)
    terms, weighted = _design(points, offsets, radius_px)
    normal = np.swapaxes(terms, 1, 2) @ weighted
    moments = np.swapaxes(weighted, 1, 2) @ values[..., np.newaxis]
    _, b_x, b_y, h_xx, h_xy, h_yy = np.moveaxis(np.linalg.solve(normal, moments)[..., 0], -1, 0)
    determinant = h_xx * h_yy - h_xy**2
    determinant = np.where(determinant < 0, determinant, np.nan)  # a saddle curves both ways
    step = np.stack([h_xy * b_y - h_yy * b_x, h_xy * b_x - h_xx * b_y], axis=-1) / determinant[:, np.newaxis]
    hessian = np.stack([h_xx, h_xy, h_xy, h_yy], axis=-1).reshape(-1, 2, 2)
    return step, hessian, normal


def _design(
    points: NDArray[np.float64], offsets: NDArray[np.intp], radius_px: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the terms of the fit about each point (corner, pixel, 6), and the same times their weights."""
    x, y = np.moveaxis(offsets - (points - np.rint(points))[:, np.newaxis], -1, 0)
    # vanishing with its slope at the radius, so that it does not matter which pixels happen to lie within
    weights = np.square(np.clip(1 - (x * x + y * y) / radius_px**2, 0, None))
    terms = np.stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2], axis=-1)
    return terms, terms * weights[..., np.newaxis]


def _gain(
    points: NDArray[np.float64],
    offsets: NDArray[np.intp],
    radius_px: int,
    hessian: NDArray[np.float64],
    normal: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the saddle's σ per axis, in px, per unit of noise of a pixel (corner,): −H⁻¹ b is linear in the pixels."""
    _, weighted = _design(points, offsets, radius_px)
    slopes = np.linalg.inv(normal)[:, 1:3] @ np.swapaxes(weighted, 1, 2)
    moves = np.linalg.pinv(hessian) @ slopes
    return np.asarray(np.sqrt(np.square(moves).sum(axis=(1, 2)) / 2))


def _noise_sd(image: NDArray[np.float32], points: NDArray[np.float64], radius_px: int) -> NDArray[np.float64]:
    """Return the noise about each point: the root mean square of what no smooth picture has."""
    size = 2 * radius_px + 1
    detail = cv2.blur(cv2.filter2D(image, cv2.CV_32F, _NOISE_KERNEL) ** 2, (size, size)) / 36
    columns, rows = np.rint(points).astype(int).T
    return np.asarray(np.sqrt(detail[rows, columns]), np.float64)


def _inside(points: NDArray[np.float64], shape: tuple[int, ...], radius_px: int) -> NDArray[np.bool_]:
    """Return whether the window about each point lies in the image."""
    limits = np.array([shape[1] - 1, shape[0] - 1]) - radius_px
    with np.errstate(invalid="ignore"):
        return np.asarray(((np.rint(points) >= radius_px) & (np.rint(points) <= limits)).all(axis=1))
