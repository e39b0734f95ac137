"""Types of command-line arguments, apart from the code that acts on them: numbers within limits, and words."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

# No quantity is larger, and computing with numbers up to it does not overflow.
_MAX_NUMBER = 1e9


def _within(minimum: float, maximum: float = _MAX_NUMBER) -> Parameter:
    """Return a parameter whose number, or each number of a tuple, must lie within limits."""

    def check(_: Any, value: float | str | tuple[float, ...] | None) -> None:
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int | float) and not minimum <= number <= maximum:
                limits = f"at least {minimum:g}" if number < minimum else f"a number of at most {maximum:g}"
                raise ValueError(f"Must be {limits}, got {number:g}.")

    return Parameter(validator=check)


type Count = Annotated[int, _within(1)]
type Seed = Annotated[int, _within(0)]
type Positive = Annotated[float, _within(1e-9)]
type NotNegative = Annotated[float, _within(0)]
type NotNegativeOrAuto = Annotated[float | Literal["auto"], _within(0)]
type Fraction = Annotated[float, _within(1e-9, 1)]
type SizePx = Annotated[tuple[int, int], _within(2)]

type Method = Literal["pmlem", "backprojection", "mlem", "pmlem-osl", "joint", "occlusion"]
type PriorName = Literal["tv", "patches", "learned", "auto"]
type SceneKind = Literal["dark_scene", "bright"]
type FigureNumber = Literal[2, 3, 4]
type LensName = Literal["opencv5", "opencv8", "opencv4", "pinhole"]
type PaperName = Literal["A4", "A3", "A2", "letter"]


@Parameter(name="*")
@dataclass(frozen=True)
class StageConnection:
    """The stage to use: a port, or the stage of a rig.toml.

    Parameters
    ----------
    port
        Serial device, pyserial URL, or simulated:grbl, simulated:grblhal, simulated:marlin.
    protocol
        Firmware of the controller at the port; grbl by default.
    baud
        Bits per second; 115200 by default.
    rig
        Use the [stage] table of this rig.toml instead, with its limits and keep-out boxes.
    """

    port: str | None = None
    protocol: Literal["grbl", "marlin"] | None = None
    baud: int | None = None
    rig: Path | None = None
