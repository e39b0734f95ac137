"""Non-uniformity of pixels by EMVA 1288 release 4.0: row, column and pixel parts, spectrograms and histograms.

All functions take the mean image of a series (row, column) and the pixels to use. What temporal noise is left in a mean
over frames is known from the scatter of the frames, and is taken out.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.estimate import Estimate, root
from faintfield.calib.noise.maps.photo_response import kept_freedom, running_mean
from faintfield.calib.noise.series import Series
from faintfield.calib.noise.strips import Array, Mask, map_of, mean_over, over_strips, total_of

# Width of the box whose mean is subtracted from bright images before their histogram is taken.
_BOX_PX = 5

# Largest number of steps of an accumulated histogram.
_MAX_STEPS = 256

# Lines whose spectra are taken at a time, and pixels that are counted at a time.
_LINES, _CHUNK_PX = 128, 1 << 16


@dataclass(frozen=True)
class TemporalNoise:
    """Temporal noise that is left in a mean image.

    `variances` (3,) are those of a pixel, of the mean of a row and of that of a column, with their standard errors: of
    few frames, the noise is known no better than the pattern.
    """

    variances: Array
    errors: Array

    def __add__(self, other: "TemporalNoise") -> "TemporalNoise":
        errors = np.array([*map(math.hypot, self.errors, other.errors)])
        return TemporalNoise(self.variances + other.variances, errors)


@dataclass(frozen=True)
class Nonuniformity:
    """Standard deviations of an image: of its row, column and pixel parts, and of all, the root of their squares."""

    total: Estimate
    row: Estimate
    column: Estimate
    pixel: Estimate


def temporal_noise(series: Series, used: Mask, weight: Callable[[slice], Array] | None = None) -> TemporalNoise:
    """Return what temporal noise leaves in the mean image of a series of at least two frames.

    `weight` returns by what the image is multiplied, for some rows (row, column); bright pixels are noisier.
    """
    pixels, again, size = used.sum() * _freedom_share(used), series.frames - 1, float(used.sum())
    per_square = size / (again * pixels)
    within = mean_over(lambda strip: series.within_dn2[strip], used) * per_square
    # The level of a frame is subtracted from its rows, and takes one degree of freedom of each set of means
    rows, columns = (size - 1 for size in used.shape)
    row, column = series.row_noise_dn2 * (1 + 1 / rows), series.column_noise_dn2 * (1 + 1 / columns)
    if weight is not None:
        # What pixels of a line share is multiplied by the mean weight, what is left in means of pixels by their own
        weighted = mean_over(lambda strip: series.within_dn2[strip] * weight(strip) ** 2, used) * per_square
        shared = mean_over(weight, used) ** 2
        row, column = (
            shared * line + (weighted - shared * within) * count / size
            for line, count in zip((row, column), used.shape, strict=True)
        )
        within = weighted
    variances = np.array([within, row, column]) / series.frames
    return TemporalNoise(variances, variances * np.sqrt(2 / (again * np.array([pixels, rows, columns]))))


def nonuniformity(
    image: NDArray[Any], used: Mask, noise: TemporalNoise, scale: float = 1.0, *, smoothed: bool = False
) -> Nonuniformity:
    """Return the spreads of an image times a scale, each an unbiased difference of variances under its root.

    With the means of M rows and N columns subtracted, the rest has the variance s_pixel² + σ², where σ² is the temporal
    noise that is left; the means of rows have s_row² + s_pixel²/N and theirs. A difference has the errors of both. An
    image that is `smoothed` is one over its `smooth_part`, which takes some of each.
    """
    rows, columns, squares = _parts(image, used)
    freedom = _Freedom(used.sum() * _freedom_share(used), rows.size - 1, columns.size - 1)
    if smoothed:
        kept = kept_freedom(used)
        freedom = _Freedom(kept.pixels, kept.rows, kept.columns)
    across = used.sum() / rows.size, used.sum() / columns.size
    scatter = squares / freedom.pixels
    (of_pixel, of_row, of_column), errors = noise.variances.tolist(), noise.errors.tolist()
    pixel, pixel_se = scatter - of_pixel, math.hypot(scatter * math.sqrt(2 / freedom.pixels), errors[0])
    row, row_se = _of_means(rows, freedom.rows, of_row + pixel / across[0], errors[1])
    column, column_se = _of_means(columns, freedom.columns, of_column + pixel / across[1], errors[2])
    total_se = float(np.sqrt(pixel_se**2 + row_se**2 + column_se**2))
    return Nonuniformity(
        total=root(pixel + row + column, total_se, scale),
        row=root(row, row_se, scale),
        column=root(column, column_se, scale),
        pixel=root(pixel, pixel_se, scale),
    )


class _Freedom(NamedTuple):
    pixels: float
    rows: float
    columns: float


def _of_means(means: Array, freedom: float, noise: float, noise_se: float) -> tuple[float, float]:
    """Return the variance of means beyond their noise, with its standard error."""
    variance = float(np.sum((means - means.mean()) ** 2)) / freedom
    # Means that happen to scatter little are known no better than those that scatter as their noise does
    se = max(variance, noise) * math.sqrt(2 / freedom)
    return variance - noise, math.hypot(se, noise_se)


def _freedom_share(used: Mask) -> float:
    return max(float(used.sum()) - sum(used.shape) + 1, 1.0) / float(used.sum())


def _parts(image: NDArray[Any], used: Mask) -> tuple[Array, Array, float]:
    """Return the means of rows and columns with pixels in use, and the sum of squares of the rest."""
    mean = mean_over(lambda rows: image[rows], used)

    def deviation(rows: slice) -> Array:
        return np.where(used[rows], image[rows] - np.float64(mean), 0.0)

    sums = over_strips(lambda rows: ((part := deviation(rows)).sum(1), part.sum(0)), used.shape)
    of_rows, of_columns = zip(*sums, strict=True)
    per_row, per_column = used.sum(1), used.sum(0)
    row = np.concatenate(of_rows) / np.maximum(per_row, 1)
    column = np.sum(of_columns, axis=0) / np.maximum(per_column, 1)

    def squares(rows: slice) -> float:
        rest = deviation(rows) - row[rows, None] - column
        return float(np.square(rest).sum(where=used[rows]))

    return row[per_row > 0], column[per_column > 0], total_of(squares, used.shape)


@dataclass(frozen=True)
class Spectrogram:
    """Mean power spectrum of the lines of an image.

    Frequencies are in cycles per pixel, from above 0 to 1/2; the power is in the image's unit squared: the variance of
    the pixels where there is no pattern.
    """

    frequency: Array
    power: Array

    @property
    def white(self) -> float:
        """Variance without its patterns: the median of the power."""
        return float(np.median(self.power))


def spectrogram(image: NDArray[Any], used: Mask, axis: int) -> Spectrogram:
    """Return the spectrogram along an axis: 1 is the horizontal one, of the rows, 0 the vertical one.

    With ŷ the discrete Fourier transform of a line of N pixels, the mean subtracted, the power is the mean of |ŷ|²/N
    over the lines. Pixels that are not used count as the mean.
    """
    mean = mean_over(lambda rows: image[rows], used)
    lines, counts = (image, used) if axis == 1 else (image.T, used.T)

    def work(some: slice) -> Array:
        deviation = np.where(counts[some], lines[some] - np.float64(mean), 0.0)
        return np.asarray(np.square(np.abs(np.fft.rfft(deviation, axis=1))).sum(axis=0))

    total = total_of(work, lines.shape, -(-len(lines) // _LINES))
    power = total / lines.size / float(used.mean())
    return Spectrogram(np.fft.rfftfreq(lines.shape[1])[1:], power[1:])


@dataclass(frozen=True)
class AccumulatedHistogram:
    """Percentage of the pixels that deviate at least so far from the mean, in steps that ascend from 0.

    `sigma` is the robust standard deviation, that of the normal law to compare with.
    """

    deviation: Array
    percent: Array
    sigma: float


def accumulated_histogram(image: NDArray[Any], used: Mask) -> AccumulatedHistogram:
    """Return the accumulated histogram, which shows few outlying pixels on a logarithmic axis as well as many."""
    mean = mean_over(lambda rows: image[rows], used)
    deviation = np.concatenate(
        over_strips(lambda rows: np.abs(image[rows] - np.float64(mean))[used[rows]].astype(np.float32), used.shape)
    )
    steps = np.linspace(0.0, deviation.max(), min(_MAX_STEPS, deviation.size))
    parts = np.array_split(deviation, max(deviation.size // _CHUNK_PX, 1))
    reached = np.zeros(steps.size + 1, np.int64)
    for part in parts:
        reached += np.bincount(np.searchsorted(steps, part, side="right"), minlength=reached.size)
    beyond = np.cumsum(reached[::-1])[-2::-1]
    # Half of a normal law lies within 0.6745 standard deviations
    sigma = float(np.median(deviation, overwrite_input=True)) / 0.6745
    return AccumulatedHistogram(steps, 100.0 * beyond / deviation.size, sigma)


def high_pass(image: NDArray[Any], used: Mask) -> NDArray[Any]:
    """Return an image less its mean over 5 × 5 pixels, so that uneven light does not count as a deviation."""
    mean = running_mean(image, used, _BOX_PX)
    return map_of(lambda rows: np.where(used[rows], image[rows] - mean[rows], 0.0), image.shape, image.dtype)
