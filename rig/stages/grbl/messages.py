"""The lines that GRBL 1.1 sends, each read strictly into one kind of message.

Responses (`ok`, `error:N`) answer commands; everything else is pushed and answers nothing. A line that is not exactly
of a known form is `Unknown`: a damaged line must never pass for an answer.
"""

import re
from dataclasses import dataclass

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
class Ok:
    """The command was parsed and accepted; motion may still be under way."""


@dataclass(frozen=True, slots=True)
class Error:
    """The command was refused."""

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
class Setting:
    """One `$` setting."""

    number: int
    value: str


@dataclass(frozen=True, slots=True)
class Feedback:
    """A bracketed message: its kind (`MSG`, `VER`, `OPT`, ...) and text."""

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
        Number after the state; `Hold:0` is a finished hold.
    position : tuple of float
        Machine position where `is_machine`, otherwise work position.
    offset : tuple of float or None
        Work coordinate offset, in those reports that carry it: machine = work + offset.
    pins : str
        Letters of the inputs that are active; an axis letter is its limit switch.
    """

    state: str
    substate: int | None
    position: tuple[float, ...]
    is_machine: bool
    offset: tuple[float, ...] | None
    pins: str


@dataclass(frozen=True, slots=True)
class Unknown:
    """Anything else, damaged lines included."""

    text: str


type Message = Ok | Error | Alarm | Banner | Setting | Feedback | Report | Unknown


def parse(line: str) -> Message:
    """Return what `line` says."""
    if line == "ok":
        return Ok()
    if found := _REPORT.fullmatch(line):
        return _report(found)
    if found := _ERROR.fullmatch(line):
        return Error(int(found[1]))
    if found := _ALARM.fullmatch(line):
        return Alarm(int(found[1]))
    if found := _SETTING.fullmatch(line):
        return Setting(int(found[1]), found[2])
    if found := _FEEDBACK.fullmatch(line):
        return Feedback(found[1], found[2])
    if found := _BANNER.fullmatch(line):
        return Banner(found[1], found[2])
    return Unknown(line)


def _report(found: re.Match[str]) -> Report:
    """Return the status report that the expression has taken apart."""
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
    """Return comma-separated numbers."""
    return tuple(float(number) for number in text.split(","))
