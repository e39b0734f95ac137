"""The `[stage]` table of rig.toml."""

from typing import Literal

from msgspec import Struct

from faintfield.rig.stages.protocol import Box

type ProtocolName = Literal["grbl", "marlin", "simulated"]


class StageSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """Connection and limits of the stage.

    Parameters
    ----------
    protocol : str
        Firmware of the controller; `simulated` needs no port and no hardware.
    port : str
        Serial device or pyserial URL, such as `socket://127.0.0.1:7000`.
    baud : int
        Bits per second.
    axes : (str, str)
        The controller's letters for the two axes of the grid, columns first.
    feed_mm_per_min : float, optional
        Speed of motions; by default the highest rate of the slower axis.
    approach_mm : float
        How far an axis goes past a position to arrive from below; must exceed the play of the drive.
    travel_mm : Box, optional
        Allowed positions, if the controller allows more or does not report its travel.
    keep_out : tuple of Box
        Boxes that the stage must neither enter nor cross.
    """

    protocol: ProtocolName
    port: str = ""
    baud: int = 115200
    axes: tuple[str, str] = ("X", "Y")
    feed_mm_per_min: float | None = None
    approach_mm: float = 2.0
    travel_mm: Box | None = None
    keep_out: tuple[Box, ...] = ()

    def __post_init__(self) -> None:
        if not self.port and self.protocol != "simulated":
            raise ValueError("stage.port is missing; give the serial device, such as /dev/ttyUSB0")
        if self.axes[0] == self.axes[1] or not set(self.axes) <= set("XYZ"):
            raise ValueError(f"stage.axes must be two different letters of X, Y, Z; got {', '.join(self.axes)}")
        if self.approach_mm < 0.0:
            raise ValueError(f"stage.approach_mm must not be negative; got {self.approach_mm:g}")
        if self.feed_mm_per_min is not None and not self.feed_mm_per_min > 0.0:
            raise ValueError(f"stage.feed_mm_per_min must be positive; got {self.feed_mm_per_min:g}")
