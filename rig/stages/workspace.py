"""Where the stage may go: its travel less the keep-out boxes, checked along the whole way."""

from collections.abc import Sequence
from itertools import pairwise

from msgspec import Struct

from faintfield.rig.errors import KeepOutCrossed, OutsideTravel
from faintfield.rig.stages.protocol import Box, Point

# Positions computed from a pitch end a few units in the last place off an edge that they mean to touch.
_ROUNDING_MM = 1e-6


class StageWorkspace(Struct, frozen=True):
    """The travel of the stage and the boxes that it must stay out of.

    Parameters
    ----------
    travel_mm : Box
        Positions that can be reached.
    keep_out : tuple of Box
        Positions that must be neither reached nor crossed.
    """

    travel_mm: Box
    keep_out: tuple[Box, ...] = ()

    def check_path(self, path: Sequence[Point]) -> None:
        """Refuse a path that leaves the travel or meets a keep-out box on any of its straight segments.

        Raises
        ------
        OutsideTravel, KeepOutCrossed
            With the offending position or segment.
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
    """Return whether the straight way from `start` to `end` touches `box`.

    The parameter of the segment is clipped against one pair of edges after the other (Liang and Barsky, 1984).
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
