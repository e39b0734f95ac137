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

from faintfield.calib.noise.likelihood.response import charge_dn, charge_slope
from faintfield.calib.noise.likelihood.rounding import ROUNDING_DN2
from faintfield.calib.noise.maps.photo_response import Response
from faintfield.calib.noise.maps.read_noise_map import kept_of
from faintfield.calib.noise.maps.seams import Seam, find_seams, share_of_seam
from faintfield.calib.noise.series import Series
from faintfield.calib.noise.strips import Array, Map, Mask, map_of, maps_of, mean_over, total_of, variance_over

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

    relative: Map
    se: Map
    seams: tuple[Seam, ...]
    share: float


@dataclass(frozen=True)
class PhotonTransfer:
    """ε by the photon transfer of each pixel alone (row, column), and its inverse variance given the read noise.

    `of_read` is the variance that the error of the read noise adds to the mean of many pixels, over that of ε itself.
    """

    epsilon: Map
    information: Map
    of_read: float


def photon_transfer(
    flats: Sequence[Series], offset_dn: Map, read_dn: Map, values: Mapping[str, float], dark_freedom: float
) -> PhotonTransfer:
    """Return ε by the photon transfer of each pixel alone.

    Parameters
    ----------
    flats, values : sequence of Series, mapping
        Flat series of two frames at least, and parameters of the fit.
    offset_dn, read_dn : array (row, column)
        Offset and read noise of each pixel.
    dark_freedom : float
        Degrees of freedom of the darks' variance of a pixel, from which its read noise is known.
    """
    gain = float(np.exp(values["log_gain"]))

    def noise(flat: Series, rows: slice) -> tuple[Array, Array]:
        """Return shot noise and all noise of some rows of a flat."""
        signal = flat.mean_of(rows) - offset_dn[rows]
        slope2 = np.square(charge_slope(values, signal))
        shot = gain * np.maximum(charge_dn(values, signal), 0.0) / slope2
        return shot, shot + np.square(read_dn[rows], dtype=np.float64) / slope2 + ROUNDING_DN2

    kept = [kept_of(lambda rows, flat=flat: noise(flat, rows)[1], ~flat.suspect) for flat in flats]  # type: ignore[misc]

    def work(rows: slice) -> tuple[Array, Array, Array]:
        gains, information, per_dn2 = np.zeros((3, *offset_dn[rows].shape))
        for flat, of_strip in zip(flats, kept, strict=True):
            shot, variance = noise(flat, rows)
            share = shot / variance
            weight = 0.5 * (flat.frames - 1) * share
            gains += weight * (flat.within_dn2[rows] / ((flat.frames - 1) * of_strip(rows, variance)) - 1)
            information += weight * share
            per_dn2 += weight / variance
        # A variance of χ² over its freedom has the variance 2/freedom, relative to its square
        read_dn2 = np.square(read_dn[rows], dtype=np.float64)
        of_read = 2 / dark_freedom * np.square(per_dn2 * read_dn2) / np.maximum(information, 1e-12)
        return gains / np.maximum(information, 1e-12), information, of_read

    epsilon, information, of_read = maps_of(work, offset_dn.shape, (np.float32, np.float32, np.float32))
    return PhotonTransfer(epsilon, information, float(of_read.mean(dtype=np.float64)))


def measure_gain(
    transfer: PhotonTransfer, usable: Mask, even: Response, response: Callable[[Map], Response]
) -> tuple[PixelGain | None, str]:
    """Return the gain of every pixel, or None and the reason why the frames do not determine it.

    Parameters
    ----------
    transfer : PhotonTransfer
        Of all flats.
    usable : array (row, column), bool
        Pixels in use.
    even : Response
        The response to light.
    response : callable
        Returns it given relative gains (row, column) by which the signals are divided first.
    """
    measured, information = transfer.epsilon, transfer.information
    shape = usable.shape
    weight = map_of(lambda rows: np.where(usable[rows], information[rows], 0.0), shape)

    def sums(rows: slice) -> Array:
        weights = weight[rows].astype(np.float64)
        return np.array([(weights * measured[rows]).sum(), weights.sum()])

    total, weights = total_of(sums, shape)
    mean = float(total / weights)

    def clipped(rows: slice) -> Array:
        limit = _CLIP_SIGMA / np.sqrt(np.maximum(information[rows], 1e-12))
        return np.clip(np.subtract(measured[rows], mean, dtype=np.float64), -limit, limit)

    epsilon = map_of(clipped, shape)
    seams = _gain_seams(epsilon, weight, 1 / (1 + transfer.of_read), even, response)
    known = response(gain_of_regions(seams, shape)) if seams else even

    def part(rows: slice) -> Array:
        relative = np.divide(known.relative[rows], np.maximum(known.vignetting[rows], 1e-6), dtype=np.float64)
        return np.where(usable[rows], relative - 1, 0.0)

    def beyond(rows: slice) -> Array:
        return np.asarray(epsilon[rows] - _of_regions(seams, rows))

    share, share_se = _share(beyond, part, weight)

    def rest(rows: slice) -> Array:
        return np.asarray(beyond(rows) - share * part(rows))

    scatter2, scatter_se = _scatter(rest, information, usable)
    if not seams and not share and not scatter2:
        return None, _why(mean_over(lambda rows: information[rows], usable), known, share_se, scatter_se)
    of_seams = sum((0.5 * seam.se) ** 2 for seam in seams)

    def work(rows: slice) -> tuple[Array, Array]:
        kept = scatter2 / (scatter2 + 1 / np.maximum(information[rows], 1e-12)) * usable[rows]
        # What is neither response nor found may differ by as much as the response leaves open.
        open2 = scatter2 * (1 - kept) if scatter2 else known.prnu**2 * (share * (1 - share) if share else 1.0)
        of_response = part(rows)
        variance = open2 + ((share_se if share else 0.0) * of_response) ** 2 + of_seams
        relative = 1 + _of_regions(seams, rows) + share * of_response + kept * rest(rows)
        return np.maximum(relative, 0.1), np.sqrt(variance)

    relative, se = maps_of(work, shape, (np.float32, np.float32))
    return PixelGain(relative, se, seams, share), ""


def _of_regions(seams: Sequence[Seam], rows: slice) -> Array:
    return np.asarray(sum((seam.of(rows) for seam in seams), np.zeros((1, 1))))


def gain_of_regions(seams: Sequence[Seam], shape: tuple[int, ...]) -> Map:
    """Return the gain of the region of each pixel over the mean (row, column)."""
    return map_of(lambda rows: 1 + _of_regions(seams, rows), shape)


def _gain_seams(
    epsilon: Map, weight: Map, precision: float, even: Response, response: Callable[[Map], Response]
) -> tuple[Seam, ...]:
    """Return the seams of the gain: those of the response that are of the gain, and others that photon transfer shows.

    The response tells the size of a step ten times better than photon transfer, but not whether gain makes it.
    """
    seams = {seam.lines: seam for seam in find_seams(epsilon, weight, precision)}
    steps = [
        step
        for step in find_seams(*_over_mean(even, weight))
        if np.greater(*np.multiply((1, _MIN_SIGMA), share_of_seam(step, epsilon, weight, precision)))
    ]
    if steps:
        # The response is smoothed and shrunk across a seam: what remains once a step is taken out belongs to the step
        rest = _over_mean(response(gain_of_regions(steps, weight.shape)), weight)
        steps = [replace(step, effect=(1 + share_of_seam(step, *rest)[0]) * step.effect) for step in steps]
    for seam in steps:
        share, se = share_of_seam(seam, epsilon, weight, precision)
        if share > _MIN_SIGMA * se:
            whole = abs(share - 1) < _ONE_SIGMA * se
            measured = replace(seam, effect=share * seam.effect, se=se * seam.difference)
            seams[seam.lines] = seam if whole else measured
    return tuple(seam for seam in seams.values() if seam.difference > _MIN_SEAM)


def _over_mean(response: Response, weight: Map) -> tuple[Map, Mask, float]:
    counts = map_of(lambda rows: weight[rows] > 0, weight.shape, bool)
    mean = mean_over(lambda rows: response.relative[rows], counts)
    relative = map_of(lambda rows: response.relative[rows] / mean, weight.shape)
    return relative, counts, max(response.prnu, 1e-4) ** -2


def _share(epsilon: Callable[[slice], Array], part: Callable[[slice], Array], weight: Map) -> tuple[float, float]:
    """Return β within 0…1 and its standard error; 0 if it is not significant."""

    def work(rows: slice) -> Array:
        of_response = part(rows)
        weighted = weight[rows] * of_response
        return np.array([(weighted * of_response).sum(), (weighted * epsilon(rows)).sum()])

    information, product = total_of(work, weight.shape).tolist()
    if information <= 0:
        return 0.0, np.inf
    share, se = product / information, information**-0.5
    return (float(np.clip(share, 0.0, 1.0)) if share > _MIN_SIGMA * se else 0.0), se


def _scatter(rest: Callable[[slice], Array], information: Map, usable: Mask) -> tuple[float, float]:
    """Return the variance of ε beyond chance, 0 if it is not significant, and its standard error."""
    chance = mean_over(lambda rows: 1 / information[rows].astype(np.float64), usable)
    se = chance * float(np.sqrt(2 / usable.sum()))
    excess = variance_over(rest, usable) - chance
    return (excess if excess > _MIN_SCATTER_SIGMA * se else 0.0), se


def _why(information: float, response: Response, share_se: float, scatter_se: float) -> str:
    why = (
        f"photon transfer tells the gain of one pixel to ±{information**-0.5:.0%}, and nothing shows that "
        f"gains differ; differences of {np.sqrt(_MIN_SCATTER_SIGMA * scatter_se):.1%} would show"
    )
    if not np.isfinite(share_se) or _MIN_SIGMA * share_se < 1:
        return why
    more = (_MIN_SIGMA * share_se) ** 2
    return f"{why}, or those that make the response ({response.prnu:.1%}) with {more:.3g} times as many flats"
