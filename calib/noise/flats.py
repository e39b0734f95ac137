"""Flats that can be used: of one light each, and within the range of the sensor.

A converter at its end leaves a mode of values there. A full well leaves none, because every pixel fills at another
level, but the noise of the pixels falls: EMVA 1288 release 4.0 calls the mean of the noisiest series the saturation. It
counts only if it shows without any one of the series.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from faintfield.calib.errors import BadFrame, SaturatedFlat
from faintfield.calib.noise.series import Series
from faintfield.calib.noise.strips import Array

# Share of the values at a known end of the range beyond which the noise of a series is clipped: the variance of a
# normal law that loses this share of one tail falls by 0.05 %.
_MAX_CLIPPED_SHARE = 3e-4

# Share, and number, of the values on the highest one from which it is the end of the range though nobody states it.
_MIN_MODE_SHARE, _MIN_MODE_VALUES = 1e-3, 10

# Noise falls if a brighter series has this share less of variance, and is so many standard errors below.
_MIN_FALL, _MIN_SIGMAS = 0.1, 5.0

# Share of the full well up to which no pixel is full yet: the end of EMVA 1288's range of the photon transfer.
_MAX_FILLED = 0.7


# Range of the levels of a series, over their mean, beyond which they are of different light: at least, where at least
# two other series tell the flicker of the lamp, and so many times that flicker; and where none do.
_MIN_RANGE, _TIMES_FLICKER, _LONE_RANGE = 0.05, 8.0, 0.5


@dataclass(frozen=True)
class Saturation:
    """Saturation of a sensor, the flats within its range, and those beyond, each with the reason.

    Attributes
    ----------
    level_dn, interval_dn : float, tuple of float, optional
        The end of the converter's range, or the mean of the noisiest series, and its bounds, the means of the series
        next to it; None if no series reaches it.
    """

    limit: Literal["ADC", "full well", "not reached"]
    level_dn: float | None
    interval_dn: tuple[float, float] | None
    kept: tuple[Series, ...]
    left_out: tuple[tuple[Series, str], ...]


def check_flat_levels(darks: Sequence[Series], flats: Sequence[Series]) -> None:
    """Check that the frames of each series of flats are of one light.

    Raises
    ------
    BadFrame
        The levels within a series differ by far more than the lamp flickers.
    """
    dark = min(float(item.levels_dn.mean()) for item in darks)
    several = [flat for flat in flats if flat.frames > 1 and flat.levels_dn.mean() > dark]
    range_dn = np.array([np.ptp(item.levels_dn) for item in several])
    signal_dn = np.array([item.levels_dn.mean() - dark for item in several])
    # The black level jitters in darks, too; dim flats would take it for flicker.
    jitter_dn = max(float(np.ptp(item.levels_dn)) for item in darks)
    share = np.maximum(range_dn - _TIMES_FLICKER * jitter_dn, 0.0) / np.maximum(signal_dn, 1e-9)
    for index, item in enumerate(several):
        rest = np.delete(share, index)
        limit = max(_MIN_RANGE, _TIMES_FLICKER * float(np.median(rest))) if rest.size > 1 else _LONE_RANGE
        if share[index] > limit:
            low, high = int(item.levels_dn.argmin()), int(item.levels_dn.argmax())
            raise BadFrame(
                f"{item.names[high]}: mean {item.levels_dn[high]:.1f} DN, where {item.names[low]} of the same "
                f"{item.conditions} has {item.levels_dn[low]:.1f} DN: {range_dn[index] / signal_dn[index]:.0%} of "
                f"their signal apart (limit {limit:.0%}{', by the flicker of the others' * (rest.size > 1)}); they are "
                "of different light or exposure: correct `exposure_s`, `level` or `photons` of the wrong one, or leave "
                "it out"
            )


def find_saturation(darks: Sequence[Series], flats: Sequence[Series], saturation_dn: float) -> Saturation:
    """Separate the flats within the range from those beyond.

    `saturation_dn` is the end of the converter's range as far as it is stated, else infinity.

    Raises
    ------
    SaturatedFlat
        No flat is left.
    """
    ceiling = _ceiling_dn(flats, saturation_dn)
    clipped = np.array([flat.clipped_share(ceiling) for flat in flats])
    # From dim to bright; a lone frame shows no noise.
    order = [j for j in np.argsort([flat.levels_dn.mean() for flat in flats]).tolist() if flats[j].frames > 1]
    noisiest, falls = _noisiest(flats, order)
    if falls and clipped[order[noisiest:]].max(initial=0.0) <= _MAX_CLIPPED_SHARE:
        saturation = _full_well(darks, flats, order, noisiest)
    else:
        saturation = _converter_end(flats, clipped, ceiling)
    if flats and not saturation.kept:
        first, why = saturation.left_out[0]
        raise SaturatedFlat(
            f"{first.names[0]}: {why}, and no other flat is below; shorten the exposure or dim the light"
        )
    return saturation


def _ceiling_dn(flats: Sequence[Series], saturation_dn: float) -> float:
    """Return the end of the range: the highest value where many values stand on it, else the stated one."""
    modes = [
        flat.top_dn
        for flat in flats
        if flat.at_top > max(_MIN_MODE_SHARE * flat.counted, _MIN_MODE_VALUES * flat.frames, flat.below_top)
    ]
    return min(float(max(modes, default=np.inf)), saturation_dn)


def _converter_end(flats: Sequence[Series], clipped: Array, ceiling: float) -> Saturation:
    left_out = tuple(
        (flat, f"{share:.2%} of the flat's pixels stand at {ceiling:g} DN, the end of the range")
        for flat, share in zip(flats, clipped, strict=True)
        if share > _MAX_CLIPPED_SHARE
    )
    kept = tuple(flat for flat, share in zip(flats, clipped, strict=True) if share <= _MAX_CLIPPED_SHARE)
    if not left_out:
        return Saturation("not reached", None, None, kept, left_out)
    return Saturation("ADC", ceiling, (ceiling, ceiling), kept, left_out)


def _noisiest(flats: Sequence[Series], order: list[int]) -> tuple[int, bool]:
    """Return the place in the order of the noisiest series, and whether noise falls beyond."""
    if len(order) < 2:
        return 0, False
    freedom = [float((flats[j].frames - 1) * (~flats[j].suspect).sum()) for j in order]
    regular = [float(flats[j].within_dn2.mean(where=~flats[j].suspect)) / (flats[j].frames - 1) for j in order]
    variance, se = np.array(regular), np.array(regular) * np.sqrt(2 / np.array(freedom))
    at = int(variance.argmax())
    brighter, error = variance[at + 1 :], np.hypot(se[at], se[at + 1 :])
    falls = (brighter < (1 - _MIN_FALL) * variance[at]) & (variance[at] - brighter > _MIN_SIGMAS * error)
    return at, bool(falls.any())


def _full_well(darks: Sequence[Series], flats: Sequence[Series], order: list[int], noisiest: int) -> Saturation:
    """Return the flats in which no well is full, unless the noise falls by a single series alone.

    The noise of one series may be anything: its frames may be of different light, or the readout has failed.
    """
    suspects = [order[noisiest], *(j for j in reversed(order) if j != order[noisiest])]
    odd = next((j for j in suspects if not _noisiest(flats, [index for index in order if index != j])[1]), None)
    if odd == order[noisiest]:
        why = "its noise is larger than that of brighter flats, and it is the only one; record it again"
        kept = tuple(flat for j, flat in enumerate(flats) if j != odd)
        return Saturation("not reached", None, None, kept, ((flats[odd], why),))
    level = [float(flats[j].levels_dn.mean()) for j in order]
    full = level[noisiest]
    dark = min(float(item.levels_dn.mean()) for item in darks)
    below = {j for j, mean in zip(order, level, strict=True) if mean <= dark + _MAX_FILLED * (full - dark)}
    kept = tuple(flats[j] for j in sorted(below))
    beyond = [flat for j, flat in enumerate(flats) if j not in below]
    if odd is not None:
        why = (
            f"the noise of the flats of {flats[odd].levels_dn.mean():.1f} DN alone is less than that of dimmer ones, "
            "as beyond a full well; record two more levels as bright"
        )
        return Saturation("not reached", None, None, kept, tuple((flat, why) for flat in beyond))
    left_out = tuple(
        (flat, f"its mean of {flat.levels_dn.mean():.1f} DN is over {_MAX_FILLED:.0%} of the full well, {full:.1f} DN")
        for flat in beyond
    )
    return Saturation("full well", full, (level[max(noisiest - 1, 0)], level[noisiest + 1]), kept, left_out)
