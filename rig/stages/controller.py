"""What the driver of one firmware must be able to do; `Gantry` adds trust, limits and verification."""

from collections.abc import Sequence
from typing import Protocol

from faintfield.rig.errors import StageLost
from faintfield.rig.stages.protocol import AxisIndex, Identity, Point


class Controller(Protocol):
    """Takes motions and reports positions. Every method is bounded in time and raises a `StageError`."""

    def connect(self) -> None:
        """Open the connection and wait until the controller answers."""
        ...

    def identify(self) -> Identity:
        """Read the firmware's version and settings; raises `WrongFirmware`."""
        ...

    def home(self, axis: AxisIndex | None, bound_s: float) -> float:
        """Home, and return how long the controller took, in seconds."""
        ...

    def follow(self, path: Sequence[Point], feed_mm_per_s: float, predicted_s: float) -> Point:
        """Move through the points of `path`, wait until the stage stands still, and return the reported position."""
        ...

    def jog(self, by: Point, feed_mm_per_s: float, predicted_s: float, *, unlock: bool) -> Point:
        """Move relative to the present position, first clearing a lock if `unlock`; return the new position."""
        ...

    def read_position(self) -> Point:
        """Return the reported position; raises unless the stage stands still."""
        ...

    def switches(self) -> frozenset[AxisIndex]:
        """Return the axes whose switch is closed."""
        ...

    def stop(self) -> bool:
        """Stop the motion, wait until it has ended, and return whether the position is kept."""
        ...

    def abort(self) -> bool:
        """Tell the stage to stop, without waiting and without raising; return whether the position is kept."""
        ...

    def recover(self) -> bool:
        """Make the controller accept commands again, without moving; return whether the position is kept."""
        ...

    def close(self) -> None:
        """Close the connection."""
        ...


def restart_failure() -> StageLost:
    """Return the exception for a controller that has reported a restart."""
    return StageLost("the controller has restarted, and its position is lost; check its power, then home it")
