"""Candidates of several scales: where light is scarce, means of 2 x 2 or 4 x 4 samples show more than samples do."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.numba_tools import compiled
from faintfield.recon.prior.evidence import Evidence, Noise
from faintfield.recon.threads import map_in_threads

# What candidates of each scale are named with: samples, means of 2 x 2 and of 4 x 4. Of 8 x 8 they are no use any more.
PREFIXES = ("", "half ", "quarter ")

# Samples along a side that the coarsest scale has at least.
_LEAST_SIDE = 32

# Rows of a strip that a thread interpolates.
_STRIP = 128

# Weights of the four samples along each axis of which a mean is made: the noise of neighbouring means then correlates
# by a quarter, as that of samples does where views fall on all phases, and as the network has learned.
_WEIGHTS = np.array([1, 6, 6, 1]) / 14


class Candidates(Protocol):
    """Candidates for a plane."""

    def __call__(self, evidence: Evidence, names: Collection[str] | None = None) -> dict[str, Image]:
        """Return candidates (row, column) by name, all as blurred as the evidence: those named, by default all."""


@dataclass(frozen=True)
class CandidatesOfScales:
    """Candidates of a plane, and those of its means of 2 x 2 and 4 x 4 samples, named "half …" and "quarter …".

    A candidate x of means changes the pilot u by what it says beyond its own pilot, `u + up(x − u of means)`, with the
    difference interpolated linearly: what changes from sample to sample stays that of u.

    Attributes
    ----------
    makers : sequence of callable
        Functions that make the candidates of each scale. The first candidate of each is its pilot.
    """

    makers: Sequence[Candidates]

    def __call__(self, evidence: Evidence, names: Collection[str] | None = None) -> dict[str, Image]:
        """Return candidates (row, column) by name, all as blurred as the evidence: those named, by default all."""
        found = {}
        pilots: list[Image] = []
        for prefix, make, coarse in zip(PREFIXES, self.makers, scales(evidence), strict=False):
            pilots.append(coarse.pilot)
            own = None if names is None else {name.removeprefix(prefix) for name in names if _scale(name) == prefix}
            if own is not None and not own:
                continue
            for name, picture in make(coarse, own).items():
                if not prefix or picture is not coarse.pilot:
                    found[prefix + name] = _raised(picture, pilots)
        return found


def is_of_samples(name: str) -> bool:
    """Return whether a candidate is of the samples themselves, and so takes longer than all those of means."""
    return _scale(name) == PREFIXES[0]


def _scale(name: str) -> str:
    return next((prefix for prefix in PREFIXES[1:] if name.startswith(prefix)), PREFIXES[0])


def scales(evidence: Evidence) -> Iterator[Evidence]:
    """Yield the evidence of a plane, then that of its means of 2 x 2 samples, and of 4 x 4, if it is large enough."""
    yield evidence
    for _ in PREFIXES[1:]:
        if min(evidence.pilot.shape) < 2 * _LEAST_SIDE:
            break
        evidence = halved(evidence)
        yield evidence


def halved(evidence: Evidence) -> Evidence:
    """Return the evidence of means of about 2 x 2 samples, weighted by how well each is seen."""
    coverage = _weighted(evidence.coverage)

    def mean(picture: Image) -> Image:
        sums = _weighted(evidence.coverage * picture)
        return np.divide(sums, coverage, out=sums, where=coverage > 0)

    variance = evidence.noise.variance
    seen = np.isfinite(variance)
    count = _weighted(seen.astype(np.float32))
    share, kernel = _noise_of_means(evidence.noise.kernel)
    of_mean = np.full(count.shape, np.inf, np.float32)
    np.divide(np.float32(share) * _weighted(np.where(seen, variance, 0)), count, out=of_mean, where=count > 0)
    others = evidence.other_colours
    return Evidence(
        mean(evidence.picture),
        mean(evidence.pilot),
        Noise(of_mean, kernel),
        coverage,
        None if others is None else mean(others),
    )


def _noise_of_means(kernel: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Return the variance of a mean of samples of variance one, and the correlation (3, 3) of neighbouring means."""
    lags = np.convolve(_WEIGHTS, _WEIGHTS)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(kernel, 4), (7, 7))[::2, ::2]
    covariance = np.einsum("ijkl,k,l->ij", around, lags, lags)
    return float(covariance[1, 1]), covariance / covariance[1, 1]


def _weighted(picture: Image) -> Image:
    """Return the weighted sums of samples around every second corner, of those that there are."""
    rows, columns = picture.shape
    sums = np.empty(((rows + 1) // 2, (columns + 1) // 2), picture.dtype)
    _sum_around(np.ascontiguousarray(picture), _WEIGHTS.astype(picture.dtype), sums)
    return sums


@compiled
def _sum_around(picture: Image, weights: Image, sums: Image) -> None:
    """Set the weighted sums of four rows and four columns, of those that there are, around every second corner."""
    rows, columns = picture.shape
    line = np.zeros(columns + 4, picture.dtype)  # a zero before the first column, and after the last
    for i in range(sums.shape[0]):
        for j in range(line.size):
            line[j] = 0
        for k in range(4):
            row = 2 * i - 1 + k
            if 0 <= row < rows:
                for j in range(columns):
                    line[1 + j] += weights[k] * picture[row, j]
        for j in range(sums.shape[1]):
            outer = weights[0] * line[2 * j] + weights[3] * line[2 * j + 3]
            sums[i, j] = outer + weights[1] * line[2 * j + 1] + weights[2] * line[2 * j + 2]


def _raised(picture: Image, pilots: Sequence[Image]) -> Image:
    """Return a candidate of the last pilot's scale as one of the first's."""
    for pilot, finer in zip(pilots[:0:-1], pilots[-2::-1], strict=True):
        picture = finer + _interpolated(picture - pilot, finer.shape)
    return picture


def _interpolated(picture: Image, shape: tuple[int, ...]) -> Image:
    """Return twice as many samples along both axes, interpolated linearly, cut to a shape."""
    rows, columns = picture.shape
    finer, padded = np.empty((2 * rows, 2 * columns), picture.dtype), np.pad(picture, 1, mode="edge")

    def fill(strip: range) -> None:
        lines = padded[strip.start : strip.stop + 2]
        for first, neighbours in ((0, lines[:-2]), (1, lines[2:])):
            between = (3 * lines[1:-1] + neighbours) / 4
            target = finer[2 * strip.start + first : 2 * strip.stop : 2]
            target[:, ::2] = (3 * between[:, 1:-1] + between[:, :-2]) / 4
            target[:, 1::2] = (3 * between[:, 1:-1] + between[:, 2:]) / 4

    map_in_threads(fill, [range(first, min(first + _STRIP, rows)) for first in range(0, rows, _STRIP)])
    return finer[: shape[0], : shape[1]]
