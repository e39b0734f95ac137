"""Reduce series to the sufficient statistics of the Gaussian likelihood.

Under Gaussian noise the likelihood depends on nothing else. With R rows, C columns and P pixels in use, removing
levels and profiles takes R + C − 1 of the P degrees of freedom. Of the rest,

- the sum of squares within pixels, W_j, is v_j χ² with (n_j − 1)(P − R − C + 1) degrees of freedom,
- the J × J scatter of the pixel means of the dark series is Wishart with P − R − C + 1,
- the mean of each dark series and the scatter of its frames' levels determine the dark signal and the frame jitter.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from faintfield.calib.noise.likelihood.groups import BLOCKS, SeriesNoise, group_noise
from faintfield.calib.noise.likelihood.response import Light, known_light
from faintfield.calib.noise.likelihood.rounding import dark_roundings, flat_rounding
from faintfield.calib.noise.series.statistics import Series
from faintfield.calib.noise.strips import Array, Mask, mean_over, total_of


@dataclass(frozen=True)
class DarkMoments:
    """Statistics of the J dark series over the P pixels in use.

    Attributes
    ----------
    exposure_s, frames : array (series,)
        Exposure time t_j at the temperature of reference, and number of frames n_j.
    mean_dn : array (series,)
        Mean over frames and pixels.
    within_dn2 : array (series,)
        W_j, the squared deviations of pixels from their means, summed over frames and pixels, as if rounding had
        added 1/12 DN² to each value's variance.
    level_scatter_dn2 : array (series,)
        Squared deviations of the frames' mean levels from the series' level, summed over frames.
    scatter_dn2 : array (series, series)
        S, the products of the pixels' patterns in two series, summed over pixels.
    rounding2 : array (series,)
        Square of the relative error of the noise that rounding may make; see `calib.noise.likelihood.rounding`.
    """

    exposure_s: Array
    frames: Array
    mean_dn: Array
    within_dn2: Array
    level_scatter_dn2: Array
    scatter_dn2: Array
    rounding2: Array


@dataclass(frozen=True)
class FlatMoments:
    """Statistics of the flat series, possibly none.

    Attributes
    ----------
    frames, mean_dn, within_dn2 : array (series,)
        As for the darks.
    evenness : array (series,)
        ⟨s⟩²/⟨s²⟩ of the signal s over the pixels: the factor on the degrees of freedom where brighter pixels are
        noisier than others.
    rounding2, exposure_s, level_scatter_dn2 : array (series,)
        As for the darks.
    light : Light
        Light of the flats, as far as it is known.
    range_dn, bend_se : float
        Signal at the end of the range, and the standard error of the bend there before it is measured.
    """

    frames: Array
    mean_dn: Array
    within_dn2: Array
    evenness: Array
    rounding2: Array
    exposure_s: Array = field(default_factory=lambda: np.zeros(0))
    light: Light = field(default_factory=lambda: known_light([]))
    level_scatter_dn2: Array = field(default_factory=lambda: np.zeros(0))
    range_dn: float = np.inf
    bend_se: float = np.inf


@dataclass(frozen=True)
class Excess:
    """Scatter that the model of the pixels does not explain; see `calib.noise.fit.scatter`.

    Attributes
    ----------
    darks, flats : float
        Squared deviations of variances over blocks of pixels, over those of normal noise.
    variance2 : float
        Relative variance of a series' noise about the model.
    drift_dn2 : float
        Variance of the level of a series of darks about the straight line.
    light2 : float
        Relative variance of the level of a series of flats about the response.
    """

    darks: float = 1.0
    flats: float = 1.0
    variance2: float = 0.0
    drift_dn2: float = 0.0
    light2: float = 0.0

    def dispersion(self, freedom: float, rounding2: float, *, flat: bool) -> float:
        """Return the variance of a sum of squares over that of χ² with `freedom` degrees of freedom."""
        return (self.flats if flat else self.darks) + 0.5 * freedom * (self.variance2 + rounding2)


NO_EXCESS = Excess()


@dataclass(frozen=True)
class Moments:
    """Sufficient statistics of all series, from `pixels` pixels in use with `freedom` degrees of freedom.

    `noise` are the sums of the noise of each series over groups of pixels, darks first.
    """

    pixels: float
    freedom: float
    darks: DarkMoments
    flats: FlatMoments
    excess: Excess = NO_EXCESS
    noise: tuple[SeriesNoise, ...] = ()


def gather_moments(darks: Sequence[Series], flats: Sequence[Series], used: Mask) -> Moments:
    """Sum the statistics of the series over the pixels in use.

    Parameters
    ----------
    darks, flats : sequence of Series
        At least one dark series; all of one size.
    used : array (row, column), bool
        Pixels that are neither defective nor suspect.
    """
    rows, columns = used.shape
    pixels = float(used.sum())
    freedom = max(pixels - rows - columns + 1.0, 1.0)
    mean_dn = [mean_over(item.mean_of, used) for item in (*darks, *flats)]
    floor_dn = min(mean_dn[: len(darks)])
    noise = tuple(group_noise(item, used, floor_dn, (BLOCKS, BLOCKS)) for item in (*darks, *flats))
    roundings = dark_roundings(darks, used)

    def work(strip: slice) -> Array:
        at = used[strip]
        patterns = np.array([dark.pattern_dn[strip][at] for dark in darks], np.float64)
        return patterns @ patterns.T

    pairs = zip(noise, roundings, strict=False)  # the darks come first
    within_dn2 = [item.within_dn2 - rounding.excess_dn2 * (item.frames - 1) * freedom for item, rounding in pairs]
    return Moments(
        pixels=pixels,
        freedom=freedom,
        darks=DarkMoments(
            exposure_s=np.array([series.conditions.dark_time_s for series in darks]),
            frames=np.array([series.frames for series in darks], np.float64),
            mean_dn=np.array(mean_dn[: len(darks)]),
            within_dn2=np.array(within_dn2),
            level_scatter_dn2=np.array([series.levels_dn.var() * series.frames for series in darks]),
            scatter_dn2=total_of(work, used.shape),
            rounding2=np.array([rounding.error**2 for rounding in roundings]),
        ),
        flats=FlatMoments(
            frames=np.array([series.frames for series in flats], np.float64),
            mean_dn=np.array(mean_dn[len(darks) :]),
            within_dn2=np.array([group.within_dn2 for group in noise[len(darks) :]]),
            evenness=np.array([_evenness(series, darks[0], used) for series in flats]),
            exposure_s=np.array([series.conditions.dark_time_s for series in flats]),
            light=known_light(flats),
            level_scatter_dn2=np.array([series.levels_dn.var() * series.frames for series in flats]),
            rounding2=np.array([flat_rounding(series, used).error ** 2 for series in flats]),
        ),
        noise=noise,
    )


def _evenness(flat: Series, dark: Series, used: Mask) -> float:
    """Return ⟨s⟩²/⟨s²⟩ of the signal s of a flat over a dark."""

    def work(rows: slice) -> Array:
        signal = (flat.mean_of(rows) - dark.mean_of(rows))[used[rows]]
        return np.array([signal.sum(), signal @ signal])

    mean, square = total_of(work, used.shape) / float(used.sum())
    return float(mean**2 / max(square, 1e-12))
