"""Checks paths against the travel of the stage and the keep-out boxes."""

from collections.abc import Sequence
from itertools import pairwise

from msgspec import Struct

from faintfield.rig.errors import KeepOutCrossed, OutsideTravel
from faintfield.rig.stages.protocol import Box, Point

# Tolerance in mm: positions computed from a pitch miss the edge that they should touch by rounding errors.
_ROUNDING_MM = 1e-6


class StageWorkspace(Struct, frozen=True):
    """The travel of the stage and its keep-out boxes.

    Parameters
    ----------
    travel_mm : Box
        Positions that the stage can reach.
    keep_out : tuple of Box
        Boxes that the stage must neither enter nor cross.
    """

    travel_mm: Box
    keep_out: tuple[Box, ...] = ()

    def check_path(self, path: Sequence[Point]) -> None:
        """Raise if a path leaves the travel or meets a keep-out box on any of its straight segments.

        Raises
        ------
        OutsideTravel, KeepOutCrossed
            The message names the position or segment.
        """
        for point in path:
            if not self.travel_mm.holds(point, _ROUNDING_MM):
                raise OutsideTravel(
                    f"position {point} is outside the travel {self.travel_mm}; "
                    "choose one inside, or move the grid's origin"
                )
        for start, end in pairwise(path):
            for box in self.keep_out:
                if segment_meets(box, start, end):
                    raise KeepOutCrossed(
                        f"the way from {start} to {end} meets the keep-out box {box}; "
                        "go around it by way of another position, or change the box"
                    )


def segment_meets(box: Box, start: Point, end: Point) -> bool:
    """Return whether the straight line from `start` to `end` touches `box`.

    The parameter of the segment is clipped against each pair of edges in turn (Liang and Barsky, 1984).
    """
    enter, leave = 0.0, 1.0
    for a, b, (low, high) in zip(start, end, (box.x_mm, box.y_mm), strict=True):
        if a == b:
            if not low <= a <= high:
                return False
            continue
        first, last = sorted(((low - a) / (b - a), (high - a) / (b - a)))
        enter, leave = max(enter, first), min(leave, last)
    return enter <= leave
