"""The lines that Marlin sends, each read strictly into one kind of message, and the lines that it is sent.

A line that is not exactly of a known form is `Unknown`: a damaged line must never pass for an answer.
"""

import re
from dataclasses import dataclass, field
from functools import reduce
from operator import xor

_NUMBER = r"-?\d{1,7}(?:\.\d{1,16})?"
_AXES = rf"X:\s?{_NUMBER} Y:\s?{_NUMBER}(?: Z:\s?{_NUMBER})?"
_POSITION = re.compile(rf"(ok )?({_AXES})(?: E:{_NUMBER})?(?: Count:? .*)?")
_OK = re.compile(r"ok(?: N\d+| P\d+| B\d+)*")
_RESEND = re.compile(r"Resend: ?(\d{1,9})")
_BUSY = re.compile(r"(?:echo:)?busy: ?(.*)")
_ERROR = re.compile(r"(?:Error: ?|!! ?)(.+)")
_FIRMWARE = re.compile(r"FIRMWARE_NAME:(.+?)(?: [A-Z_]+:.*)?")
_CAPABILITY = re.compile(r"Cap:([A-Z0-9_]+):([01])")
_AREA_BOX = rf"min:\{{x:({_NUMBER}),y:({_NUMBER})[^}}]*\}},max:\{{x:({_NUMBER}),y:({_NUMBER})[^}}]*\}}"
_AREA = re.compile(rf"area:\{{.*work:\{{{_AREA_BOX}.*")
_ENDSTOPS = re.compile(
    rf"(?:echo:)?.*Min:\s+X:?({_NUMBER}) Y:?({_NUMBER})(?: Z:?{_NUMBER})?"
    rf"\s+Max:\s+X:?({_NUMBER}) Y:?({_NUMBER})(?: Z:?{_NUMBER})?"
)
_SWITCH = re.compile(r"([xyz]_(?:min|max)): (open|TRIGGERED)")
_SETTING = re.compile(rf"(?:echo:)?\s*([MG]\d{{1,4}})((?: [A-Z]{_NUMBER})+)(?: ;.*)?")
_REFUSAL = re.compile(r"echo:(Unknown command:.*|Home .*First.*)", re.IGNORECASE)
_START = re.compile(r"start")
# Errors about a line that arrived damaged: the controller asks for it again and has not executed it.
_TRANSMISSION = re.compile(r"checksum|line number|expected line", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Ok:
    """The command was taken, and the next may come."""


@dataclass(frozen=True, slots=True)
class PositionReport:
    """Where the controller says it is, per axis letter; `is_ok` when the line is the answer as well."""

    axes_mm: dict[str, float]
    is_ok: bool


@dataclass(frozen=True, slots=True)
class Resend:
    """The controller waits for the line with this number; the `ok` that follows acknowledges nothing."""

    number: int


@dataclass(frozen=True, slots=True)
class Busy:
    """Still at work on the last command."""


@dataclass(frozen=True, slots=True)
class Start:
    """The controller has just started."""


@dataclass(frozen=True, slots=True)
class Error:
    """An error; `in_transmission` when a line was damaged on its way and nothing else is wrong."""

    text: str
    in_transmission: bool


@dataclass(frozen=True, slots=True)
class Refusal:
    """The command was not executed, although an `ok` will follow."""

    text: str


@dataclass(frozen=True, slots=True)
class Firmware:
    """Name and version of the firmware."""

    name: str


@dataclass(frozen=True, slots=True)
class Capability:
    """Something that the firmware was built with or without."""

    name: str
    present: bool


@dataclass(frozen=True, slots=True)
class Limits:
    """The reachable positions: lower and upper x and y."""

    x_mm: tuple[float, float]
    y_mm: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Switch:
    """The state of one limit switch, such as `x_min`."""

    name: str
    closed: bool


@dataclass(frozen=True, slots=True)
class Setting:
    """One line of the settings report: a command and its parameters."""

    command: str
    parameters: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Unknown:
    """Anything else, damaged lines included."""

    text: str


type Message = (
    Ok | PositionReport | Resend | Busy | Start | Error | Refusal
    | Firmware | Capability | Limits | Switch | Setting | Unknown
)  # fmt: skip


def parse(line: str) -> Message:
    """Return what `line` says."""
    return _parse_answer(line) or _parse_description(line) or Unknown(line)


def numbered(number: int, command: str) -> bytes:
    """Return `command` as a line that arrives whole or is asked for again: its number and the XOR of its bytes."""
    line = f"N{number} {command}".encode("ascii")
    return line + b"*%d\n" % reduce(xor, line)


def _parse_answer(line: str) -> Message | None:
    """Return `line` as one of the messages that drive the exchange."""
    if _OK.fullmatch(line):
        return Ok()
    if found := _POSITION.fullmatch(line):
        axes = re.findall(rf"([XYZ]):\s?({_NUMBER})", found[2])
        return PositionReport({axis: float(value) for axis, value in axes}, is_ok=found[1] is not None)
    if found := _RESEND.fullmatch(line):
        return Resend(int(found[1]))
    if _BUSY.fullmatch(line):
        return Busy()
    if _START.fullmatch(line):
        return Start()
    if found := _REFUSAL.fullmatch(line):
        return Refusal(found[1])
    if found := _ERROR.fullmatch(line):
        return Error(found[1], in_transmission=_TRANSMISSION.search(found[1]) is not None)
    return None


def _parse_description(line: str) -> Message | None:
    """Return `line` as one of the messages by which the controller describes itself."""
    if found := _FIRMWARE.fullmatch(line):
        return Firmware(found[1])
    if found := _CAPABILITY.fullmatch(line):
        return Capability(found[1], found[2] == "1")
    if found := _AREA.fullmatch(line) or _ENDSTOPS.fullmatch(line):
        x_min, y_min, x_max, y_max = (float(value) for value in found.groups())
        return Limits((x_min, x_max), (y_min, y_max))
    if found := _SWITCH.fullmatch(line):
        return Switch(found[1], found[2] == "TRIGGERED")
    if found := _SETTING.fullmatch(line):
        return Setting(found[1], {word[0]: float(word[1:]) for word in found[2].split()})
    return None
