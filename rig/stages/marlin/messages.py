"""Parses the lines that Marlin sends, each into one type of message, and numbers the lines sent to it.

A line that does not match a known form exactly is `Unknown`, so that a damaged line is never taken for an answer.
"""

import re
from dataclasses import dataclass, field
from functools import reduce
from operator import xor

from faintfield.rig.stages.messages import Ok, Unknown

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
# Errors about a damaged line, which the controller has not executed and asks for again.
_TRANSMISSION = re.compile(r"checksum|line number|expected line", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class PositionReport:
    """A position in mm by axis letter; `is_ok` if the line is also the answer to a command."""

    axes_mm: dict[str, float]
    is_ok: bool


@dataclass(frozen=True, slots=True)
class Resend:
    """The controller asks for the line with this number; the `ok` that follows acknowledges nothing."""

    number: int


@dataclass(frozen=True, slots=True)
class Busy:
    """The controller is still executing the last command."""


@dataclass(frozen=True, slots=True)
class Start:
    """The controller has just started."""


@dataclass(frozen=True, slots=True)
class ErrorText:
    """An error; `in_transmission` if only a line was damaged on its way."""

    text: str
    in_transmission: bool


@dataclass(frozen=True, slots=True)
class Refusal:
    """The command was not executed, although an `ok` follows."""

    text: str


@dataclass(frozen=True, slots=True)
class Firmware:
    """Name and version of the firmware."""

    name: str


@dataclass(frozen=True, slots=True)
class Capability:
    """A feature that the firmware was built with or without."""

    name: str
    present: bool


@dataclass(frozen=True, slots=True)
class Limits:
    """The reachable positions: lower and upper end along x and y."""

    x_mm: tuple[float, float]
    y_mm: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Switch:
    """The state of one limit switch, such as `x_min`."""

    name: str
    closed: bool


@dataclass(frozen=True, slots=True)
class MarlinSetting:
    """One line of the settings report: a command and its parameters."""

    command: str
    parameters: dict[str, float] = field(default_factory=dict)


type Message = (
    Ok | PositionReport | Resend | Busy | Start | ErrorText | Refusal
    | Firmware | Capability | Limits | Switch | MarlinSetting | Unknown
)  # fmt: skip


def parse(line: str) -> Message:
    """Return `line` as a message."""
    return _parse_answer(line) or _parse_description(line) or Unknown(line)


def numbered(number: int, command: str) -> bytes:
    """Return `command` with its line number and the XOR of its bytes, so that Marlin recognises a damaged line."""
    line = f"N{number} {command}".encode("ascii")
    return line + b"*%d\n" % reduce(xor, line)


def _parse_answer(line: str) -> Message | None:
    """Return `line` as a message that answers a command or reports a problem, or None."""
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
        return ErrorText(found[1], in_transmission=_TRANSMISSION.search(found[1]) is not None)
    return None


def _parse_description(line: str) -> Message | None:
    """Return `line` as a message that describes the controller, or None."""
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
        return MarlinSetting(found[1], {word[0]: float(word[1:]) for word in found[2].split()})
    return None
