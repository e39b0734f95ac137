"""Find flats whose frames cannot be of one light: their levels differ by far more than those of the other flats."""

from collections.abc import Sequence

import numpy as np

from faintfield.calib.errors import BadFrame
from faintfield.calib.noise.series.statistics import Series

# Range of the levels of a series, over their mean, beyond which they are of different light: at least, where at least
# two other series tell the flicker of the lamp, and so many times that flicker; and where none do.
_MIN_RANGE, _TIMES_FLICKER, _LONE_RANGE = 0.05, 8.0, 0.5


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
    jitter_dn = max((float(np.ptp(dark.levels_dn)) for dark in darks), default=0.0)
    share = np.maximum(range_dn - _TIMES_FLICKER * jitter_dn, 0.0) / np.maximum(signal_dn, 1e-9)
    for index, item in enumerate(several):
        others = np.delete(share, index)
        limit = max(_MIN_RANGE, _TIMES_FLICKER * float(np.median(others))) if others.size > 1 else _LONE_RANGE
        if share[index] > limit:
            raise BadFrame(_message(item, float(range_dn[index] / signal_dn[index]), limit))


def _message(one: Series, share: float, limit: float) -> str:
    """Return which frames differ, by how much, and what to do."""
    low, high = int(one.levels_dn.argmin()), int(one.levels_dn.argmax())
    return (
        f"{one.names[high]}: mean {one.levels_dn[high]:.1f} DN, where {one.names[low]} of the same {one.conditions} "
        f"has {one.levels_dn[low]:.1f} DN: {share:.0%} of their signal apart (limit {limit:.0%}, by the flicker of the "
        "others); they are of different light or exposure: correct `exposure_s`, `level` or `photons` of the wrong "
        "one, or leave it out"
    )
