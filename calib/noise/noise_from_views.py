"""Gain and read noise estimated from the views of a scene, where nobody measured them (docs/explanation/noise.md).

Neighbouring views show the same scene, moved. The part of three of them that no movement explains is noise, and its
variance over the light is a photon transfer curve. Each block of the middle view is compared on its own:

1. Optical flow says where the block is in the other two views; it is taken from there by whole pixels, because
   interpolation would smooth the noise.
2. What remains of the movement, and changes of exposure, are fitted to the residual v₁ − 2 v₂ + v₃ as a combination of
   a plane and the derivatives of the sum v₁ + v₂ + v₃. Noise of the sum is independent of that of the residual.
3. The rest has 6 times the variance of a view.

Blocks of little texture come nearest to this, so the flattest of each brightness are used.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from faintfield.calib.errors import NotIdentifiable
from faintfield.calib.estimate import Estimate
from faintfield.calib.noise.strips import Array

# Side of a block in px: small against objects, large enough for a variance within 9 %.
_BLOCK_PX = 16

# Blocks compared of each three views: more would not make the curve better than its model.
_MAX_BLOCKS = 1200

# Mean difference of the flow within a block from its median, in px; more of it is an edge in depth.
_MAX_SPREAD_PX = 0.5

# Largest share of pixels at the floor: values that are cut off there have lost noise.
_MAX_AT_FLOOR = 0.01

# Terms fitted to the residual of a block: a plane, and first and second derivatives. It has 1 + 4 + 1 variances.
_TERMS, _RESIDUAL_FACTOR = 8, 6

# Intervals of brightness, equal in its square root, and the fewest blocks of a point, and points of a curve.
_BINS, _MIN_BLOCKS, _MIN_POINTS = 20, 20, 3

# Least share of the light in the variance at the brightest point: without any, no gain could be stated.
_MIN_LIGHT = 0.01

# Departure of a point from the curve, relative, beyond which it counts less.
_USUAL_DEPARTURE = 0.05

# Curves drawn from the scatter of blocks, for intervals.
_DRAWS = 40


class ViewBlocks(NamedTuple):
    """Blocks seen in three views each: mean in DN above the offset, variance of one view in DN², and texture."""

    mean_dn: Array
    variance_dn2: Array
    texture: Array


_NO_BLOCKS = ViewBlocks(*[np.zeros(0)] * 3)


@dataclass(frozen=True)
class ViewNoise:
    """Noise of one view as its views show it: `variance = gain · mean + read_noise_dn²`, rounding included.

    Both have a value; their errors are by the scatter of blocks alone.
    `mean_dn` and `variance_dn2` (point,) are the photon transfer curve, with the number of `blocks` behind it.
    """

    gain_dn: Estimate
    read_noise_dn: Estimate
    mean_dn: Array
    variance_dn2: Array
    blocks: int


def compared_blocks(
    views: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
    *,
    saturation_dn: float,
    floor_dn: float,
    generator: np.random.Generator,
) -> ViewBlocks:
    """Return blocks of three neighbouring views, the middle one second.

    Parameters
    ----------
    views : tuple of float32 array (row, column, colour)
        Values above the offset; colours are compared each on its own.
    saturation_dn, floor_dn : float
        Blocks with a value from the first on, or many down to the second, where darkness is cut off, are left out.
    generator : numpy.random.Generator
        Picks blocks, where there are more than are needed.
    """
    corners, moves = _located(views, generator)
    if not len(corners):
        return _NO_BLOCKS
    colours = [
        _residuals(views, colour, corners, moves, saturation_dn, floor_dn) for colour in range(views[0].shape[2])
    ]
    return ViewBlocks(*(np.concatenate(parts) for parts in zip(*colours, strict=True)))


def _located(
    views: Sequence[NDArray[np.float32]], generator: np.random.Generator
) -> tuple[NDArray[np.int64], list[NDArray[np.int64]]]:
    """Return the upper left corners of blocks (block, 2), and where each is in the three views, from there (block, 2).

    Rows come first. The border of one pixel that derivatives need is inside all views. Small views have no blocks.
    """
    shape = np.array(views[0].shape[:2])
    if shape.min() < 3 * _BLOCK_PX:
        return np.zeros((0, 2), int), [np.zeros((0, 2), int)] * 3
    starts = [np.arange(1, length - _BLOCK_PX - 1, _BLOCK_PX) for length in shape]
    corners = np.stack(np.meshgrid(*starts, indexing="ij"), axis=-1).reshape(-1, 2)
    corners = generator.permutation(corners)[:_MAX_BLOCKS]
    moves, sound = [np.zeros_like(corners)], np.ones(len(corners), bool)
    before, middle, after = map(_grey, views)
    for grey in (before, after):
        flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(middle, grey, None)
        within = _windows(flow, corners, _BLOCK_PX).reshape(len(corners), 2, -1)
        median = np.median(within, axis=2)
        spread = np.abs(within - median[:, :, None]).mean(axis=2).max(axis=1, initial=0.0)
        move = np.rint(median[:, ::-1]).astype(int)
        first = corners + move
        sound &= (spread < _MAX_SPREAD_PX) & ((first >= 1) & (first + _BLOCK_PX + 1 <= shape)).all(axis=1)
        moves.append(move)
    return corners[sound], [moves[view][sound] for view in (1, 0, 2)]


def _grey(view: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return a view as 8-bit levels for optical flow, with noise about equal over all levels."""
    grey = view.mean(axis=2)
    low, high = np.quantile(grey[::4, ::4], [0.005, 0.995])
    return np.asarray(255 * np.sqrt(np.clip((grey - low) / max(high - low, 1e-9), 0, 1)), np.uint8)


def _windows(image: NDArray[np.float32], corners: NDArray[np.int64], side: int) -> NDArray[np.float32]:
    windows = np.lib.stride_tricks.sliding_window_view(image, (side, side), axis=(0, 1))
    return np.asarray(windows[corners[:, 0], corners[:, 1]])


def _residuals(
    views: Sequence[NDArray[np.float32]],
    colour: int,
    corners: NDArray[np.int64],
    moves: Sequence[NDArray[np.int64]],
    saturation_dn: float,
    floor_dn: float,
) -> tuple[Array, Array, Array]:
    """Return mean, variance and texture, the mean square of the gradient, (block,) of one colour."""
    parts = [
        _windows(view[:, :, colour], corners + move - 1, _BLOCK_PX + 2).astype(float)
        for view, move in zip(views, moves, strict=True)
    ]
    cut = np.max([(part <= floor_dn).mean(axis=(1, 2)) for part in parts], axis=0) > _MAX_AT_FLOOR
    kept = ~cut & (np.max(parts, axis=(0, 2, 3), initial=-np.inf) < saturation_dn)
    first, middle, last = (part[kept] for part in parts)
    total = first + middle + last
    terms = _explaining(total)
    residual = (first - 2 * middle + last)[:, 1:-1, 1:-1].reshape(-1, _BLOCK_PX**2)
    explained = np.linalg.solve(
        np.einsum("bpi,bpj->bij", terms, terms) + 1e-6 * _BLOCK_PX**2 * np.eye(_TERMS),
        np.einsum("bpi,bp->bi", terms, residual)[:, :, None],
    )
    left = residual - (terms @ explained)[:, :, 0]
    variance = np.sum(left**2, axis=1) / (_RESIDUAL_FACTOR * (_BLOCK_PX**2 - _TERMS))
    across, along = total[:, 1:-1, 2:] - total[:, 1:-1, :-2], total[:, 2:, 1:-1] - total[:, :-2, 1:-1]
    texture = np.asarray(np.mean(across**2 + along**2, axis=(1, 2)))
    return total[:, 1:-1, 1:-1].mean(axis=(1, 2)) / 3, variance, texture


def _explaining(total: Array) -> Array:
    """Return what movement and exposure can do to blocks, (block, pixel, term), each term with the mean square 1."""
    y, x = np.mgrid[-1 : 1 : _BLOCK_PX * 1j, -1 : 1 : _BLOCK_PX * 1j]
    centre = total[:, 1:-1, 1:-1]
    right, left, down, up = total[:, 1:-1, 2:], total[:, 1:-1, :-2], total[:, 2:, 1:-1], total[:, :-2, 1:-1]
    mixed = total[:, 2:, 2:] - total[:, 2:, :-2] - total[:, :-2, 2:] + total[:, :-2, :-2]
    curvatures = (right - 2 * centre + left, down - 2 * centre + up, mixed)
    planes = np.broadcast_arrays(1.0, x, y, centre)[:3]
    terms = np.stack([*planes, right - left, down - up, *curvatures], axis=-1)
    terms = terms.reshape(-1, _BLOCK_PX**2, _TERMS)
    return np.asarray(terms / (np.sqrt(np.mean(terms**2, axis=1, keepdims=True)) + 1e-9))


def estimate_view_noise(
    blocks: Sequence[ViewBlocks],
    *,
    least_variance_dn2: Callable[[Array], Array],
    flattest: float = 0.3,
    gain_dn: float | None = None,
) -> ViewNoise:
    """Return gain and read noise by photon transfer over blocks.

    Parameters
    ----------
    least_variance_dn2 : callable
        The variance that values of these means (point,) have at least: that of their rounding.
    flattest : float
        Share of the blocks of a brightness that are used, those of least texture.
    gain_dn : float, optional
        The gain, if it is known; the read noise alone is then estimated.

    Raises
    ------
    NotIdentifiable
        Too few blocks, or blocks of too few brightnesses, show the noise.
    """
    joined = ViewBlocks(*map(np.concatenate, zip(*blocks, strict=True))) if blocks else _NO_BLOCKS
    groups = _groups(joined, flattest)
    if len(groups) < _MIN_POINTS:
        raise NotIdentifiable(
            f"{len(joined.mean_dn)} blocks of {_BLOCK_PX} x {_BLOCK_PX} px that three neighbouring views share give "
            f"{len(groups)} points of variance against light, {_MIN_POINTS} are needed; "
            "give more views, or gain and read noise"
        )
    counts = np.array([len(group) for group in groups], float)
    mean_dn = np.array([joined.mean_dn[group].mean() for group in groups])
    least = least_variance_dn2(mean_dn)

    def curve(picked: Sequence[NDArray[np.int64]]) -> Array:
        return np.maximum([np.median(joined.variance_dn2[group]) for group in picked], least)

    variance = curve(groups)
    in_the_dark = float(least_variance_dn2(np.zeros(1))[0])
    line = _line(mean_dn, variance, counts, gain_dn, in_the_dark)
    generator = np.random.default_rng(1)
    draws = [curve([generator.choice(group, len(group)) for group in groups]) for _ in range(_DRAWS)]
    lines = np.array([_line(mean_dn, variances, counts, gain_dn, in_the_dark) for variances in draws])
    gain, read = (_estimate(value, draws) for value, draws in zip(line.tolist(), lines.T, strict=True))
    return ViewNoise(gain, read, mean_dn, variance, int(counts.sum()))


def _groups(blocks: ViewBlocks, flattest: float) -> list[NDArray[np.int64]]:
    root = np.sqrt(np.maximum(blocks.mean_dn, 0.0))
    edges = np.linspace(root.min(initial=0.0), root.max(initial=0.0), _BINS + 1)[1:-1]
    bins = np.digitize(root, edges)
    groups = []
    for index in range(_BINS):
        members = np.flatnonzero(bins == index)
        if len(members) >= _MIN_BLOCKS:
            count = max(_MIN_BLOCKS, int(flattest * len(members)))
            groups.append(members[np.argsort(blocks.texture[members])[:count]])
    return groups


def _line(mean_dn: Array, variance_dn2: Array, counts: Array, gain_dn: float | None, least_dn2: float) -> Array:
    """Return gain and read noise in DN, its square at least `least_dn2`, for errors relative to the variance."""
    usual = float(np.median(variance_dn2))
    scale = np.array([usual / max(float(mean_dn.max()), 1e-3 * np.sqrt(usual)), usual])
    known = None if gain_dn is None else gain_dn / scale[0]
    weight = np.sqrt(counts / counts.mean())

    def line(unknown: Array) -> Array:
        return np.asarray(scale * (unknown if known is None else np.array([known, unknown[0]])))

    def misfit(unknown: Array) -> Array:
        gain, read2 = line(unknown)
        return np.asarray(weight * np.log(np.maximum(gain * mean_dn + read2, 1e-12) / variance_dn2))

    lowest = min(least_dn2 / usual, 0.4)
    start, least = ([0.5, 0.5], [_MIN_LIGHT, lowest]) if known is None else ([0.5], [lowest])
    fit = least_squares(misfit, start, bounds=(least, np.inf), loss="soft_l1", f_scale=_USUAL_DEPARTURE)
    gain, read2 = line(np.asarray(fit.x))
    return np.array([gain, np.sqrt(read2)])


def _estimate(value: float, draws: Array) -> Estimate:
    low, high = np.quantile(draws, [0.025, 0.975]).tolist()
    return Estimate(value, float(np.std(draws)), (min(low, value), max(high, value)))
