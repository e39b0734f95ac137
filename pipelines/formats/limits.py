"""Limits beyond which the values in a file are refused: far above what any rig has, far below what overflows."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

# Size of the largest picture that is read, decoded: a plane in three colours of the largest detector, as float32.
MAX_FRAME_BYTES = 3_000_000_000

# Size of the largest picture on a page of results.
MAX_PREVIEW_BYTES = 200_000_000

# Longest exposure: eleven days.
MAX_EXPOSURE_S = 1e6

# Largest light of a pixel, a million times what a pixel holds; its square is far from the limit of float32.
MAX_LIGHT_E = 1e12

# Largest row or column of a node.
MAX_NODE = 100_000

# Largest rotation and translation in a pose; the unit of an imported model may be as small as a µm.
MAX_ANGLE_RAD, MAX_LENGTH_MM = 10.0, 1e9

# Largest period of a mosaic; the largest that is sold has 6.
MAX_PERIOD_PX = 8


def sound_pose(pose: ArrayLike) -> bool:
    """Return whether a pose (6,), Rodrigues rad and mm, is finite and within the limits."""
    numbers = np.abs(np.asarray(pose, np.float64))
    return bool((numbers[:3] <= MAX_ANGLE_RAD).all() and (numbers[3:] <= MAX_LENGTH_MM).all())


def sound_node(node: tuple[int, int]) -> bool:
    """Return whether the row and column of a node are within the limits."""
    return max(map(abs, node)) <= MAX_NODE


def sound_mosaic(mosaic: Sequence[str], letters: str | None = None) -> bool:
    """Return whether a mosaic has rows of equal length, is no larger than any camera's, and of these letters only."""
    widths = {len(row) for row in mosaic}
    if len(widths) != 1 or not 0 < min(widths) <= max(len(mosaic), *widths) <= MAX_PERIOD_PX:
        return False
    return letters is None or not set("".join(mosaic)) - set(letters)
