"""The gain of every pixel, by photon transfer in flats, shrunk by what all pixels have in common.

The variance of a flat grows with the gain of the pixel: W_ij over its expectation is 1 + h_j ε_i, for a gain that
differs by ε_i from the mean and the share h_j of shot noise in the variance. Chance scatters ε_i by √(2/frames), 13 %
with 120 frames, where the gains of pixels differ by 1 %. But all pixels together tell

- the gains of regions that are read apart (`seams`); where the response has a seam, too, whether it is one of gain,
- how much of the response to light of a pixel (PRNU, known to a fraction of a percent) is its gain: ε_i = β p_i. It is
  all, β = 1, if pixels differ by their amplifiers, and nothing, β = 0, if they differ by their quantum efficiency,
- and whether ε_i scatters more than all this explains: then each is shrunk by its share of chance.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise.likelihood.response import charge_dn, charge_slope
from faintfield.calib.noise.likelihood.rounding import ROUNDING_DN2
from faintfield.calib.noise.maps.photo_response import Response
from faintfield.calib.noise.maps.read_noise import kept_variance
from faintfield.calib.noise.maps.seams import Seam, find_seams, share_of_seam
from faintfield.calib.noise.series.statistics import Series

type Array = NDArray[np.float64]

# Standard errors from which a share is real, and a scatter; up to which a share counts as 1; at which a pixel is cut.
_MIN_SIGMA, _MIN_SCATTER_SIGMA, _ONE_SIGMA, _CLIP_SIGMA = 3.0, 4.0, 2.0, 5.0

# Differences between regions that matter, as a fraction of the gain.
_MIN_SEAM = 2e-3


@dataclass(frozen=True)
class PixelGain:
    """Gain of every pixel over the mean, arrays (row, column).

    Attributes
    ----------
    relative, se : array
        Posterior mean and standard error; without the error of the mean gain.
    seams : tuple of Seam
        Regions whose gains differ, relative to the mean.
    share : float
        β, the part of the response of a pixel that is its gain; 0 if that is not known.
    """

    relative: Array
    se: Array
    seams: tuple[Seam, ...]
    share: float

    @property
    def of_regions(self) -> Array:
        """Gain of the region of each pixel over the mean."""
        return 1 + _of_regions(self.seams, self.relative.shape)


def photon_transfer(
    flats: Sequence[Series], offset_dn: Array, read_dn2: Array, values: Mapping[str, float]
) -> tuple[Array, Array]:
    """Return ε by the photon transfer of each pixel alone, and its inverse variance, both (row, column).

    Parameters
    ----------
    flats : sequence of Series
        Flat series of two frames at least.
    offset_dn, read_dn2 : array (row, column)
        Offset and read variance of each pixel.
    values : mapping
        Parameters of the fit.
    """
    gain = float(np.exp(values["log_gain"]))
    found, information = np.zeros(offset_dn.shape), np.zeros(offset_dn.shape)
    for one in flats:
        signal = one.mean_dn - offset_dn
        slope2 = charge_slope(values, signal) ** 2
        shot = gain * np.maximum(charge_dn(values, signal), 0.0) / slope2
        variance = shot + read_dn2 / slope2 + ROUNDING_DN2
        share = shot / variance
        expected = (one.frames - 1) * kept_variance(variance, ~one.suspect)
        weight = 0.5 * (one.frames - 1) * share
        found += weight * (one.within_dn2 / expected - 1)
        information += weight * share
    return found / np.maximum(information, 1e-12), information


def measure_gain(
    transfer: tuple[Array, Array], usable: NDArray[np.bool_], even: Response, response: Callable[[Array], Response]
) -> tuple[PixelGain | None, str]:
    """Return the gain of every pixel, or None and the reason why the frames do not determine it.

    Parameters
    ----------
    transfer : tuple of arrays (row, column)
        ε and its inverse variance, see `photon_transfer`.
    usable : array (row, column), bool
        Pixels in use.
    even : Response
        The response to light.
    response : callable
        Returns it given relative gains (row, column) by which the signals are divided first.
    """
    epsilon, information = transfer
    weight = np.where(usable, information, 0.0)
    limit = _CLIP_SIGMA / np.sqrt(np.maximum(information, 1e-12))
    epsilon = np.clip(epsilon - np.average(epsilon, weights=weight), -limit, limit)
    seams = _gain_seams(epsilon, weight, even)
    region = _of_regions(seams, epsilon.shape)
    known = response(1 + region) if seams else even
    seams = tuple(_refined(seam, known, weight) for seam in seams)
    region = _of_regions(seams, epsilon.shape)
    part = np.where(usable, known.relative / np.maximum(known.vignetting, 1e-6) - 1, 0.0)
    share, share_se = _share(epsilon - region, part, weight)
    rest = epsilon - region - share * part
    scatter2, scatter_se = _scatter(rest, information, usable)
    if not seams and not share and not scatter2:
        return None, _why(information[usable], known, share_se, scatter_se)
    kept = scatter2 / (scatter2 + 1 / np.maximum(information, 1e-12)) * usable
    # What is neither response nor found may differ by as much as the response leaves open.
    open2 = scatter2 * (1 - kept) if scatter2 else known.prnu**2 * (share * (1 - share) if share else 1.0)
    variance = open2 + (share_se * part) ** 2 * bool(share) + sum((0.5 * seam.se) ** 2 for seam in seams)
    relative = 1 + region + share * part + kept * rest
    return PixelGain(np.maximum(relative, 0.1), np.sqrt(np.broadcast_to(variance, relative.shape)), seams, share), ""


def _of_regions(seams: Sequence[Seam], shape: tuple[int, ...]) -> Array:
    """Return by how much the gain of the region of each pixel differs from the mean (row, column)."""
    return np.asarray(sum((seam.map for seam in seams), np.zeros(shape)))


def _gain_seams(epsilon: Array, weight: Array, response: Response) -> tuple[Seam, ...]:
    """Return the seams of the gain: those of the response that are of the gain, and others that photon transfer shows.

    The response tells the size of a step ten times better than photon transfer, but not whether gain makes it.
    """
    found = {seam.lines: seam for seam in find_seams(epsilon, weight)}
    even = (weight > 0) / max(response.prnu, 1e-4) ** 2
    for seam in find_seams(response.relative / np.average(response.relative, weights=even), even):
        share, se = share_of_seam(seam, epsilon, weight)
        if share > _MIN_SIGMA * se:
            whole = abs(share - 1) < _ONE_SIGMA * se
            measured = replace(seam, effect=share * seam.effect, se=se * seam.difference)
            found[seam.lines] = replace(seam, of_response=True) if whole else measured
    return tuple(seam for seam in found.values() if seam.difference > _MIN_SEAM)


def _refined(seam: Seam, response: Response, weight: Array) -> Seam:
    """Return a seam of the whole response with what is left of it in the response divided by its gains.

    The response is smoothed and shrunk across a seam, so that the first value of a step is a little too small.
    """
    if not seam.of_response:
        return seam
    even = (weight > 0) / max(response.prnu, 1e-4) ** 2
    left, _ = share_of_seam(seam, response.relative / np.average(response.relative, weights=even), even)
    return replace(seam, effect=(1 + left) * seam.effect)


def _share(epsilon: Array, part: Array, weight: Array) -> tuple[float, float]:
    """Return β within 0…1 and its standard error; 0 if it is not significant."""
    information = float(np.sum(weight * part**2))
    if information <= 0:
        return 0.0, np.inf
    share, se = float(np.sum(weight * part * epsilon)) / information, information**-0.5
    return (float(np.clip(share, 0.0, 1.0)) if share > _MIN_SIGMA * se else 0.0), se


def _scatter(rest: Array, information: Array, usable: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the variance of ε beyond chance, 0 if it is not significant, and its standard error."""
    chance = float(np.mean(1 / information[usable]))
    se = chance * float(np.sqrt(2 / usable.sum()))
    excess = float(np.var(rest[usable])) - chance
    return (excess if excess > _MIN_SCATTER_SIGMA * se else 0.0), se


def _why(information: Array, response: Response, share_se: float, scatter_se: float) -> str:
    """Return why pixels have no gain of their own, and what to record."""
    found = (
        f"photon transfer tells the gain of one pixel to ±{np.mean(information) ** -0.5:.0%}, and nothing shows that "
        f"gains differ; differences of {np.sqrt(_MIN_SCATTER_SIGMA * scatter_se):.1%} would show"
    )
    if not np.isfinite(share_se) or _MIN_SIGMA * share_se < 1:
        return found
    more = (_MIN_SIGMA * share_se) ** 2
    return f"{found}, or those that make the response ({response.prnu:.1%}) with {more:.1f} times as many flats"
