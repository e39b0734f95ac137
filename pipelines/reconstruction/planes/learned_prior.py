"""A small network that improves the picture of one plane, in units of the noise: `x = p + s · net(y, u, p, s)`.

training/README.md says what it was trained with, how, and where it fails.
"""

from collections.abc import Iterator
from importlib.resources import files
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.prior.evidence import Noise

_FILE = "networks/plane_prior.onnx"

# The network halves its pictures three times; tiles and margins are multiples of that, too. What is farther from a
# sample than the margin hardly changes it. Margins are computed twice, but larger tiles take more memory.
_MULTIPLE, _TILE, _MARGIN = 8, 320, 24

# One side has errors 1 to 4 % larger than four, two sides 0.2 to 0.7 %.
_SIDES = 2

# The network sees light in units of the noise divided by this, so that all its inputs are of the order of one.
_LIGHT_SCALE = 8.0

# What it was trained with: samples along a side, light in units of the noise, ratio of the noise of samples to its
# median. The noise of neighbours along rows and columns correlated by a quarter; where views are in phase that is 0 to
# 0.5, and the network was measured to help there, too.
_MIN_SIDE, _MAX_LIGHT, _NOISE_RATIOS = 32, 60.0, (0.6, 6.0)
_NEIGHBOURS = (-0.05, 0.55)

# Part of the samples that may be brighter, darker or noisier than those that it was trained with, and samples that are
# judged, about.
_ODD, _JUDGED = 0.01, 2**20

type _Tile = tuple[slice, slice]


def learned_estimate(picture: Image, pilot: Image, patches: Image, noise_variance: Image) -> NDArray[np.float32]:
    """Return p improved by the network (row, column), in electrons; p itself where no view sees the sample.

    The arrays (row, column) are y, the back-projection; u, a solution as blurred as y; p, y filtered in groups of
    patches, all in electrons; and s², the variance of the noise of y, infinite where no view sees the sample. The
    network sees the plane from two of its four sides, and its answers are averaged: what it says turns with the plane.
    """
    seen = _seen(noise_variance)
    if not seen.any():
        return patches.astype(np.float32)
    inputs, deviation = network_input(picture, pilot, patches, noise_variance)
    rows, columns = patches.shape
    padded = np.pad(inputs, ((0, 0), (0, -rows % _MULTIPLE), (0, -columns % _MULTIPLE)), mode="symmetric")
    # One network for each call, since it is no function but keeps its input
    network = cv2.dnn.readNetFromONNX(np.frombuffer(files(__package__).joinpath(_FILE).read_bytes(), np.uint8))
    answers = [np.rot90(_output(network, np.rot90(padded, turn, (1, 2))), -turn) for turn in range(_SIDES)]
    change = np.mean(answers, axis=0)[:rows, :columns]
    return np.where(seen, patches + deviation * change, patches).astype(np.float32)


def network_input(
    picture: Image, pilot: Image, patches: Image, noise_variance: Image
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return what the network sees (4, row, column), and s (row, column): `(y−p)/s`, `(u−p)/s`, `p/8s`, `ln s/median`.

    The arguments are those of `learned_estimate`. Where no view sees the sample, y and u are taken for p, and s is the
    largest of all.
    """
    seen = _seen(noise_variance)
    deviation = np.sqrt(np.where(seen, noise_variance, 0), dtype=np.float32)
    median = np.median(deviation[seen])
    deviation[~seen] = deviation.max()
    inputs = np.stack(
        [
            np.where(seen, picture - patches, 0) / deviation,
            np.where(seen, pilot - patches, 0) / deviation,
            patches / (_LIGHT_SCALE * deviation),
            np.log(deviation / median),
        ]
    )
    return inputs.astype(np.float32), deviation


def outside_range(patches: Image, noise: Noise) -> str | None:
    """Return why a plane p in electrons is unlike those that the network was trained with, None if it is like them."""
    seen = _seen(noise.variance)
    if min(patches.shape) < _MIN_SIDE:
        return f"the plane has {patches.shape[0]} x {patches.shape[1]} samples, fewer than {_MIN_SIDE} along a side"
    if not seen.any():
        return "no sample is seen by any view"
    some = np.flatnonzero(seen)[:: 1 + seen.size // _JUDGED]
    deviation = np.sqrt(noise.variance.ravel()[some])
    brightest = float(np.quantile(patches.ravel()[some] / deviation, 1 - _ODD))
    if not brightest <= _MAX_LIGHT:
        return f"the light is up to {brightest:.0f} times its noise, more than {_MAX_LIGHT:.0f}"
    least, most = np.quantile(deviation, (_ODD, 1 - _ODD)) / np.median(deviation)
    if not _NOISE_RATIOS[0] <= least <= most <= _NOISE_RATIOS[1]:
        return f"the noise of samples is {least:.2g} to {most:.2g} times its median, not {_NOISE_RATIOS}"
    low, high = sorted((float(noise.kernel[0, 1]), float(noise.kernel[1, 0])))
    if not _NEIGHBOURS[0] <= low <= high <= _NEIGHBOURS[1]:
        return f"the noise of neighbours correlates by {low:.2f} and {high:.2f}, not {_NEIGHBOURS}"
    return None


def _seen(noise_variance: Image) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(noise_variance) & (noise_variance > 0))


def _output(network: Any, inputs: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the network's output (row, column) for inputs (4, row, column), computed tile by tile."""
    output = np.empty(inputs.shape[1:], np.float32)
    for tile, around in _tiles(output.shape):
        network.setInput(np.ascontiguousarray(inputs[:, *around])[np.newaxis])
        within = tuple(slice(t.start - a.start, t.stop - a.start) for t, a in zip(tile, around, strict=True))
        output[tile] = network.forward()[0, 0][within]
    return output


def _tiles(shape: tuple[int, ...]) -> Iterator[tuple[_Tile, _Tile]]:
    for top, left in product(range(0, shape[0], _TILE), range(0, shape[1], _TILE)):
        at = ((top, shape[0]), (left, shape[1]))
        rows, columns = (slice(first, min(first + _TILE, length)) for first, length in at)
        more_rows, more_columns = (
            slice(max(first - _MARGIN, 0), min(first + _TILE + _MARGIN, length)) for first, length in at
        )
        yield (rows, columns), (more_rows, more_columns)
