"""Candidates of several scales: where light is scarce, means of 2 x 2 or 4 x 4 samples show more than samples do."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.signal import convolve2d

from faintfield.recon.likelihood.images import Image
from faintfield.recon.prior.evidence import Evidence, Noise

# What candidates of each scale are named with: samples, means of 2 x 2 and of 4 x 4. Of 8 x 8 they are no use any more.
PREFIXES = ("", "half ", "quarter ")

# Samples along a side that the coarsest scale has at least.
_LEAST_SIDE = 32

# Covariance of the sums of two neighbouring samples, of lags −1, 0 and 1 within and between them.
_PAIRS = np.outer([1, 2, 1], [1, 2, 1])


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
        What makes the candidates of each scale. The first candidate of each is its pilot.
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
    for _ in PREFIXES:
        yield evidence
        if min(evidence.pilot.shape) < 2 * _LEAST_SIDE:
            break
        evidence = halved(evidence)


def halved(evidence: Evidence) -> Evidence:
    """Return the evidence of means of 2 x 2 samples, weighted by how well each is seen."""
    coverage = _sums(evidence.coverage)

    def mean(picture: Image) -> Image:
        sums = _sums(evidence.coverage * picture)
        return np.divide(sums, coverage, out=sums, where=coverage > 0)

    variance = evidence.noise.variance
    seen = np.isfinite(variance)
    count = _sums(seen.astype(np.float32))
    share, kernel = _noise_of_means(evidence.noise.kernel)
    of_mean = np.full(count.shape, np.inf, np.float32)
    np.divide(np.float32(share) * _sums(np.where(seen, variance, 0)), count, out=of_mean, where=count > 0)
    others = evidence.other_colours
    return Evidence(
        mean(evidence.picture),
        mean(evidence.pilot),
        Noise(of_mean, kernel),
        coverage,
        None if others is None else mean(others),
    )


def _noise_of_means(kernel: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Return the variance of a mean of 2 x 2 samples of variance one, and the correlation (3, 3) of such means."""
    covariance = convolve2d(kernel, _PAIRS)[::2, ::2] / 16
    return float(covariance[1, 1]), covariance / covariance[1, 1]


def _sums(picture: Image) -> Image:
    """Return the sums of 2 x 2 samples; at an odd edge, of those that there are."""
    rows, columns = picture.shape
    padded = np.pad(picture, ((0, rows % 2), (0, columns % 2))) if rows % 2 or columns % 2 else picture
    sums = padded[::2, ::2] + padded[1::2, ::2]
    sums += padded[::2, 1::2]
    sums += padded[1::2, 1::2]
    return sums


def _raised(picture: Image, pilots: Sequence[Image]) -> Image:
    """Return a candidate of the last pilot's scale as one of the first's."""
    for pilot, finer in zip(pilots[:0:-1], pilots[-2::-1], strict=True):
        picture = finer + _interpolated(picture - pilot, finer.shape)
    return picture


def _interpolated(picture: Image, shape: tuple[int, ...]) -> Image:
    """Return twice as many samples along both axes, interpolated linearly, cut to a shape."""
    for axis in (0, 1):
        lines = np.moveaxis(picture, axis, 0)
        finer = np.empty((2 * len(lines), lines.shape[1]), picture.dtype)
        before, after = (lines[np.clip(np.arange(len(lines)) + step, 0, len(lines) - 1)] for step in (-1, 1))
        finer[::2] = (3 * lines + before) / 4
        finer[1::2] = (3 * lines + after) / 4
        picture = np.moveaxis(finer, 0, axis)
    return picture[: shape[0], : shape[1]]
