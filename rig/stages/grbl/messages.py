"""Parses the lines that GRBL 1.1 sends, each into one type of message.

Responses (`ok`, `error:N`) answer commands; GRBL sends all other lines unasked. A line that does not match a known form
exactly is `Unknown`, so that a damaged line is never taken for a response.
"""

import re
from dataclasses import dataclass

from faintfield.rig.stages.messages import Ok, Unknown

_NUMBER = r"-?\d{1,7}(?:\.\d{1,6})?"
_VECTOR = rf"{_NUMBER}(?:,{_NUMBER}){{1,5}}"
_ERROR = re.compile(r"error:(\d{1,3})")
_ALARM = re.compile(r"ALARM:(\d{1,3})")
_SETTING = re.compile(rf"\$(\d{{1,3}})=({_NUMBER})")
_BANNER = re.compile(r"(Grbl|GrblHAL) (\d{1,2}\.\d{1,2}[a-z]?)(?: .*)?")
_FEEDBACK = re.compile(r"\[([A-Za-z0-9]+):(.*)\]")
_REPORT = re.compile(
    rf"<(Idle|Run|Hold|Jog|Alarm|Door|Check|Home|Sleep|Tool)(?::(\d{{1,2}}))?\|([MW])Pos:({_VECTOR})((?:\|[^|<>]*)*)>"
)
_OFFSET = re.compile(rf"\|WCO:({_VECTOR})(?=\||$)")
_PINS = re.compile(r"\|Pn:([A-Z]+)(?=\||$)")


@dataclass(frozen=True, slots=True)
class ErrorCode:
    """The controller has refused a command."""

    code: int


@dataclass(frozen=True, slots=True)
class Alarm:
    """The controller has stopped."""

    code: int


@dataclass(frozen=True, slots=True)
class Banner:
    """The controller has just started."""

    name: str
    version: str


@dataclass(frozen=True, slots=True)
class GrblSetting:
    """One `$` setting."""

    number: int
    value: str


@dataclass(frozen=True, slots=True)
class Feedback:
    """A message in brackets: its kind (`MSG`, `VER`, `OPT`, ...) and text."""

    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class Report:
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


type Message = Ok | ErrorCode | Alarm | Banner | GrblSetting | Feedback | Report | Unknown


def parse(line: str) -> Message:
    """Return `line` as a message."""
    if line == "ok":
        return Ok()
    if found := _REPORT.fullmatch(line):
        return _report(found)
    if found := _ERROR.fullmatch(line):
        return ErrorCode(int(found[1]))
    if found := _ALARM.fullmatch(line):
        return Alarm(int(found[1]))
    if found := _SETTING.fullmatch(line):
        return GrblSetting(int(found[1]), found[2])
    if found := _FEEDBACK.fullmatch(line):
        return Feedback(found[1], found[2])
    if found := _BANNER.fullmatch(line):
        return Banner(found[1], found[2])
    return Unknown(line)


def _report(found: re.Match[str]) -> Report:
    """Return the status report of a match of `_REPORT`."""
    state, substate, frame, position, fields = found.groups()
    offset, pins = _OFFSET.search(fields), _PINS.search(fields)
    return Report(
        state=state,
        substate=None if substate is None else int(substate),
        position=_vector(position),
        is_machine=frame == "M",
        offset=None if offset is None else _vector(offset[1]),
        pins="" if pins is None else pins[1],
    )


def _vector(text: str) -> tuple[float, ...]:
    """Return the numbers of a comma-separated list."""
    return tuple(float(number) for number in text.split(","))
