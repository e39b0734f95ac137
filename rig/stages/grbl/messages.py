"""Parses the lines that GRBL 1.1 sends.

Responses (`ok`, `error:N`) answer commands; GRBL sends all other lines unasked. A line that does not match a known form
exactly is `Unknown`, so that a damaged line is never taken for a response.
"""

import re
from collections.abc import Callable

from msgspec import Struct

from faintfield.rig.stages.transport import Ok, Unknown

_NUMBER = r"-?\d{1,7}(?:\.\d{1,6})?"
_VECTOR = rf"{_NUMBER}(?:,{_NUMBER}){{1,5}}"
_OFFSET = re.compile(rf"\|WCO:({_VECTOR})(?=\||$)")
_PINS = re.compile(r"\|Pn:([A-Z]+)(?=\||$)")


class ErrorCode(Struct, frozen=True):
    """The controller has refused a command."""

    code: int


class Alarm(Struct, frozen=True):
    """The controller has stopped."""

    code: int


class Banner(Struct, frozen=True):
    """The controller has just started."""

    name: str
    version: str


class GrblSetting(Struct, frozen=True):
    """One `$` setting."""

    number: int
    value: str


class Feedback(Struct, frozen=True):
    """A message in brackets: its kind (`MSG`, `VER`, `OPT`, ...) and text."""

    kind: str
    text: str


class Report(Struct, frozen=True):
    """A real-time status report.

    Parameters
    ----------
    state : str
        Machine state, such as `Idle` or `Jog`.
    substate : int or None
        Number after the state; `Hold:0` means that the stage has come to rest.
    position : tuple of float
        Machine position if `is_machine`, otherwise work position (mm).
    is_machine : bool
        Whether `position` is in machine coordinates.
    offset : tuple of float or None
        Work coordinate offset (mm), which only some reports carry: machine = work + offset.
    pins : str
        Letters of the active inputs; the letter of an axis stands for its limit switch.
    """

    state: str
    substate: int | None
    position: tuple[float, ...]
    is_machine: bool
    offset: tuple[float, ...] | None
    pins: str

    @property
    def emergency_stop(self) -> bool:
        """Return whether the emergency stop is pressed, which grblHAL reports among the inputs."""
        return "E" in self.pins

    @property
    def is_moving(self) -> bool:
        """Return whether the stage moves or slows down."""
        slowing = (self.state, self.substate) in (("Hold", 1), ("Door", 2), ("Door", 3))
        return self.state in ("Jog", "Run") or slowing


type Message = Ok | ErrorCode | Alarm | Banner | GrblSetting | Feedback | Report | Unknown


def parse(line: str) -> Message:
    """Return `line` as a message."""
    return next((make(match) for form, make in _FORMS if (match := form.fullmatch(line))), Unknown(line))


def _report(match: re.Match[str]) -> Report:
    state, substate, frame, position, fields = match.groups()
    offset, pins = _OFFSET.search(fields), _PINS.search(fields)
    return Report(
        state=state,
        substate=None if substate is None else int(substate),
        position=tuple(map(float, position.split(","))),
        is_machine=frame == "M",
        offset=None if offset is None else tuple(map(float, offset[1].split(","))),
        pins="" if pins is None else pins[1],
    )


# The forms of lines, each with the function that makes its message of a match.
_FORMS: tuple[tuple[re.Pattern[str], Callable[[re.Match[str]], Message]], ...] = (
    (re.compile("ok"), lambda _: Ok()),
    (
        re.compile(
            r"<(Idle|Run|Hold|Jog|Alarm|Door|Check|Home|Sleep|Tool)(?::(\d{1,2}))?"
            rf"\|([MW])Pos:({_VECTOR})((?:\|[^|<>]*)*)>"
        ),
        _report,
    ),
    (re.compile(r"error:(\d{1,3})"), lambda match: ErrorCode(int(match[1]))),
    (re.compile(r"ALARM:(\d{1,3})"), lambda match: Alarm(int(match[1]))),
    (re.compile(rf"\$(\d{{1,3}})=({_NUMBER})"), lambda match: GrblSetting(int(match[1]), match[2])),
    (re.compile(r"\[([A-Za-z0-9]+):(.*)\]"), lambda match: Feedback(match[1], match[2])),
    (re.compile(r"(Grbl|GrblHAL) (\d{1,2}\.\d{1,2}[a-z]?)(?: .*)?"), lambda match: Banner(match[1], match[2])),
)
