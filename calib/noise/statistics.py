"""What a series of frames says about the noise, gathered in one pass: each frame is seen once and forgotten.

A *series* is all frames of one kind, exposure and light level. Within it only noise differs from frame to frame, so
its sufficient statistics are, for every pixel, the mean and the sum of squared deviations over the frames. What all
pixels of a frame, a row or a column share (a jittering black level, banding) is taken out of each frame first and
kept apart; otherwise it would count as pixel noise.
"""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.errors import BadFrame, LightLeak, SaturatedFlat

# Pixels this many robust standard deviations off in the first frame of a series are left out of its row and column
# means: a hot pixel's shot noise would otherwise spread along its row.
_SUSPECT_SIGMA = 8.0

# A dark brighter than its series by this multiple of the pixel noise has seen light; one brighter by the smaller
# multiple, when the black level's own jitter would do so less often than the chance given.
_LEAK_SURELY, _LEAK_FRACTION, _LEAK_CHANCE = 5.0, 0.25, 1e-7

# A flat with a larger fraction of its pixels (and more than so many) on its highest value has reached the end.
_SATURATED_FRACTION, _SATURATED_PX = 1e-3, 10

# The exact likelihoods and the histograms need the values themselves; so many pixels are kept, spread evenly.
SAMPLE_PX = 65_536


@dataclass(frozen=True)
class Conditions:
    """What the frames of one series have in common.

    Attributes
    ----------
    kind : {"dark", "flat"}
        Lens covered, or evenly lit.
    exposure_s : float
        Exposure time.
    level : int
        Which light level a flat was taken at; 0 for darks.
    photons : float, optional
        Mean photons per pixel and exposure, where a radiometer told.
    """

    kind: Literal["dark", "flat"]
    exposure_s: float
    level: int = 0
    photons: float | None = None

    def __str__(self) -> str:
        light = f" at level {self.level}" if self.kind == "flat" else ""
        return f"{self.kind}s of {self.exposure_s:g} s{light}"


@dataclass(frozen=True)
class Series:
    """Sufficient statistics of one series.

    Attributes
    ----------
    conditions : Conditions
        Kind, exposure and light level.
    names : tuple of str
        The frames, as the caller calls them; they appear in messages.
    digests : tuple of bytes
        Fingerprint of each frame's pixels, by which copies are found.
    levels_dn : array (frame,)
        Mean of each frame.
    row_dn, column_dn : array (row,), array (column,)
        Mean profile over the frames, less the mean level.
    row_noise_dn2, column_noise_dn2 : float
        Variance over the frames of a row's and a column's mean; pixel noise has its part in them.
    pattern_dn : array (row, column), float32
        Mean over the frames of what remains of each pixel once level and profiles are taken out.
    within_dn2 : array (row, column), float32
        Sum over the frames of its squared deviations from that mean.
    suspect : array (row, column), bool
        Left out of levels and profiles.
    sample_dn : array (frame, pixel), int32
        The values themselves at `sample_index(shape)`.
    floor_dn : int
        Lowest value of all frames.
    """

    conditions: Conditions
    names: tuple[str, ...]
    digests: tuple[bytes, ...]
    levels_dn: NDArray[np.float64]
    row_dn: NDArray[np.float64]
    column_dn: NDArray[np.float64]
    row_noise_dn2: float
    column_noise_dn2: float
    pattern_dn: NDArray[np.float32]
    within_dn2: NDArray[np.float32]
    suspect: NDArray[np.bool_]
    sample_dn: NDArray[np.int32]
    floor_dn: int

    @property
    def frames(self) -> int:
        """How many frames the series has."""
        return len(self.names)

    @property
    def mean_dn(self) -> NDArray[np.float64]:
        """Mean over the frames (row, column), nothing taken out."""
        return self.pattern_dn + self.row_dn[:, None] + self.column_dn[None, :] + self.levels_dn.mean()


class SeriesSums:
    """The running sums of one series; frames are given one by one, in DN (row, column), and forgotten.

    Parameters
    ----------
    conditions : Conditions
        What the frames have in common.
    saturation_dn : float
        Value from which a pixel is saturated.
    """

    def __init__(self, conditions: Conditions, saturation_dn: float = np.inf) -> None:
        self.conditions = conditions
        self.saturation_dn = saturation_dn
        self._names: list[str] = []
        self._digests: list[bytes] = []
        self._samples: list[NDArray[np.int32]] = []
        self._levels_dn: list[float] = []
        self._spreads_dn2: list[float] = []
        self._rows: list[NDArray[np.float64]] = []
        self._columns: list[NDArray[np.float64]] = []
        self._floor_dn = np.iinfo(np.int64).max

    def add(self, name: str, frame_dn: NDArray[Any]) -> None:
        """Take one frame in.

        Raises
        ------
        SaturatedFlat
            More than 0.1 % of a flat's pixels stand at the end of the range.
        ValueError
            The frame differs in size from those before.
        """
        if self.conditions.kind == "flat":
            _check_range(name, frame_dn, self.saturation_dn)
        if not self._names:
            self._begin(frame_dn)
        if frame_dn.shape != self._suspect.shape:
            raise ValueError(f"{name}: {frame_dn.shape} pixels, where the series began with {self._suspect.shape}")
        self._names.append(name)
        self._digests.append(hashlib.blake2b(np.ascontiguousarray(frame_dn), digest_size=16).digest())
        self._samples.append(frame_dn.ravel()[self._sampled].astype(np.int32))
        self._floor_dn = min(self._floor_dn, int(frame_dn.min()))
        self._add_residual(frame_dn.astype(np.float64))

    def _begin(self, first_dn: NDArray[Any]) -> None:
        """Make room for frames like the first."""
        self._suspect = _suspects(first_dn)
        self._regular = ~self._suspect
        self._row_count = np.maximum(self._regular.sum(1), 1)
        self._column_count = np.maximum(self._regular.sum(0), 1)
        self._sampled = sample_index(first_dn.shape)
        self._pattern, self._squares = np.zeros(first_dn.shape), np.zeros(first_dn.shape)

    def _add_residual(self, residual_dn: NDArray[np.float64]) -> None:
        """Take level, row and column means out of a frame (which is overwritten), and sum the rest."""
        level = residual_dn.mean(where=self._regular)
        residual_dn -= level
        rows = residual_dn.sum(1, where=self._regular) / self._row_count
        residual_dn -= rows[:, None]
        columns = residual_dn.sum(0, where=self._regular) / self._column_count
        residual_dn -= columns
        self._levels_dn.append(float(level))
        self._rows.append(rows)
        self._columns.append(columns)
        self._pattern += residual_dn
        residual_dn *= residual_dn
        self._squares += residual_dn
        self._spreads_dn2.append(float(residual_dn.mean(where=self._regular)))

    def series(self) -> Series:
        """Close the sums.

        Raises
        ------
        LightLeak, BadFrame
            One dark's mean or spread departs from the others'.
        ValueError
            No frame was given.
        """
        frames = len(self._names)
        if not frames:
            raise ValueError("a series needs at least one frame, got none")
        mean = self._pattern / frames
        within = np.maximum(self._squares - frames * mean**2, 0.0)
        rows, columns = np.array(self._rows), np.array(self._columns)
        series = Series(
            conditions=self.conditions,
            names=tuple(self._names),
            digests=tuple(self._digests),
            levels_dn=np.array(self._levels_dn),
            row_dn=rows.mean(0),
            column_dn=columns.mean(0),
            row_noise_dn2=float(rows.var(0, ddof=1).mean()) if frames > 1 else 0.0,
            column_noise_dn2=float(columns.var(0, ddof=1).mean()) if frames > 1 else 0.0,
            pattern_dn=mean.astype(np.float32),
            within_dn2=within.astype(np.float32),
            suspect=self._suspect,
            sample_dn=np.array(self._samples),
            floor_dn=self._floor_dn,
        )
        _check_alike(series, np.array(self._spreads_dn2))
        return series


def measure_series(
    frames: Iterable[tuple[str, NDArray[Any]]], conditions: Conditions, saturation_dn: float = np.inf
) -> Series:
    """Gather the sufficient statistics of one series, given as (name, frame) pairs; see `SeriesSums`."""
    sums = SeriesSums(conditions, saturation_dn)
    for name, frame_dn in frames:
        sums.add(name, frame_dn)
    return sums.series()


def sample_index(shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the flat indices of the pixels whose values are kept: all, or `SAMPLE_PX` spread without a grid."""
    pixels = int(np.prod(shape))
    if pixels <= SAMPLE_PX:
        return np.arange(pixels)
    return np.sort(np.random.default_rng(1288).choice(pixels, SAMPLE_PX, replace=False))


def _suspects(frame_dn: NDArray[Any]) -> NDArray[np.bool_]:
    """Return the pixels that stand far out of their row and column."""
    residual = frame_dn - np.median(frame_dn, axis=1, keepdims=True)
    residual -= np.median(residual, axis=0)
    return np.asarray(np.abs(residual) > _SUSPECT_SIGMA * robust_sigma(residual) + 1.0)


def robust_sigma(values: NDArray[Any]) -> float:
    """Return the standard deviation that the median absolute deviation gives a normal distribution."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def _check_range(name: str, frame_dn: NDArray[Any], saturation_dn: float) -> None:
    """Refuse a flat that piles up at the end of the range, stated or not."""
    ceiling = min(float(frame_dn.max()), saturation_dn)
    at_end, next_below = int((frame_dn >= ceiling).sum()), int((frame_dn == ceiling - 1).sum())
    if at_end > max(_SATURATED_FRACTION * frame_dn.size, _SATURATED_PX, next_below):
        raise SaturatedFlat(
            f"{name}: {at_end / frame_dn.size:.2%} of the flat's pixels stand at {ceiling:g} DN, the end of the range "
            f"(at most {_SATURATED_FRACTION:.1%} may); shorten the exposure or dim the light"
        )


def _check_alike(series: Series, spreads_dn2: NDArray[np.float64]) -> None:
    """Refuse a dark that is brighter, or otherwise patterned, than the others of its series."""
    if series.conditions.kind != "dark" or series.frames < 2:
        return
    noise_dn = float(np.sqrt(np.median(series.within_dn2) / (series.frames - 1)))
    worst, excess_dn = _stands_out(series.levels_dn, least=_LEAK_FRACTION * noise_dn, surely=_LEAK_SURELY * noise_dn)
    if excess_dn > 0:
        raise LightLeak(
            f"{series.names[worst]}: mean {series.levels_dn[worst]:.1f} DN, {excess_dn:.1f} DN above the other "
            f"{series.conditions} (their pixels are {noise_dn:.1f} DN rms noisy): light leaked in; cover the lens and "
            "record it again, or leave it out"
        )
    odd, excess = _stands_out(spreads_dn2 / np.median(spreads_dn2), least=0.2, surely=1.0)
    if excess > 0:
        raise BadFrame(
            f"{series.names[odd]}: its pixels spread {np.sqrt(1 + excess):.2f} times as far as in the other "
            f"{series.conditions}: light leaked in or the readout failed; record it again, or leave it out"
        )


def _stands_out(values: NDArray[np.float64], least: float, surely: float) -> tuple[int, float]:
    """Return which value is the largest, and by how much it exceeds the rest where chance is ruled out, else 0.

    An excess above `surely` counts by itself; one above `least` counts when Student's t of the others allows it but
    once in `_LEAK_CHANCE` times.
    """
    largest = int(values.argmax())
    others = np.delete(values, largest)
    excess = float(values[largest] - others.mean())
    if excess > surely:
        return largest, excess
    if excess < least or others.size < 2:
        return largest, 0.0
    t = excess / max(float(others.std(ddof=1)) * np.sqrt(1 + 1 / others.size), 1e-12)
    return largest, excess if stats.t.sf(t, others.size - 1) < _LEAK_CHANCE else 0.0
