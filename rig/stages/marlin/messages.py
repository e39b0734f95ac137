"""Parses the lines that Marlin sends, and numbers the lines sent to it.

A line that does not match a known form exactly is `Unknown`, so that a damaged line is never taken for an answer.
"""

import re
from collections.abc import Callable
from functools import reduce
from operator import xor

from msgspec import Struct

from faintfield.rig.stages.transport import Ok, Unknown

_NUMBER = r"-?\d{1,7}(?:\.\d{1,16})?"
_AXES = rf"X:\s?{_NUMBER} Y:\s?{_NUMBER}(?: Z:\s?{_NUMBER})?"
_AREA_BOX = rf"min:\{{x:({_NUMBER}),y:({_NUMBER})[^}}]*\}},max:\{{x:({_NUMBER}),y:({_NUMBER})[^}}]*\}}"
# Errors about a damaged line, which the controller has not executed and asks for again.
_TRANSMISSION = re.compile(r"checksum|line number|expected line", re.IGNORECASE)


class PositionReport(Struct, frozen=True):
    """A position in mm by axis letter; `is_ok` if the line is also the answer to a command."""

    axes_mm: dict[str, float]
    is_ok: bool


class Resend(Struct, frozen=True):
    """The controller asks for the line with this number; the `ok` that follows acknowledges nothing."""

    number: int


class Busy(Struct, frozen=True):
    """The controller is still executing the last command, or waits for somebody to press its button."""

    for_user: bool


class Start(Struct, frozen=True):
    """The controller has just started."""


class ErrorText(Struct, frozen=True):
    """An error; `in_transmission` if only a line was damaged on its way."""

    text: str
    in_transmission: bool


class Refusal(Struct, frozen=True):
    """The command was not executed, although an `ok` follows."""

    text: str


class Firmware(Struct, frozen=True):
    """Name and version of the firmware."""

    name: str


class Capability(Struct, frozen=True):
    """A feature that the firmware was built with or without."""

    name: str
    present: bool


class Limits(Struct, frozen=True):
    """The reachable positions: lower and upper end along x and y."""

    x_mm: tuple[float, float]
    y_mm: tuple[float, float]


class Switch(Struct, frozen=True):
    """The state of one limit switch, such as `x_min`."""

    name: str
    closed: bool


class MarlinSetting(Struct, frozen=True):
    """One line of the settings report: a command and its parameters."""

    command: str
    parameters: dict[str, float]


type Message = (
    Ok | PositionReport | Resend | Busy | Start | ErrorText | Refusal
    | Firmware | Capability | Limits | Switch | MarlinSetting | Unknown
)  # fmt: skip


def parse(line: str) -> Message:
    """Return `line` as a message."""
    return next((make(match) for form, make in _FORMS if (match := form.fullmatch(line))), Unknown(line))


def numbered(number: int, command: str) -> bytes:
    """Return `command` with its line number and the XOR of its bytes, so that Marlin recognises a damaged line."""
    line = f"N{number} {command}".encode("ascii")
    return line + b"*%d\n" % reduce(xor, line)


def _position(match: re.Match[str]) -> PositionReport:
    axes = re.findall(rf"([XYZ]):\s?({_NUMBER})", match[2])
    return PositionReport({axis: float(value) for axis, value in axes}, is_ok=match[1] is not None)


def _limits(match: re.Match[str]) -> Limits:
    x_min, y_min, x_max, y_max = map(float, match.groups())
    return Limits((x_min, x_max), (y_min, y_max))


def _setting(match: re.Match[str]) -> MarlinSetting:
    return MarlinSetting(match[1], {word[0]: float(word[1:]) for word in match[2].split()})


# The forms of lines, each with the function that makes its message of a match.
_FORMS: tuple[tuple[re.Pattern[str], Callable[[re.Match[str]], Message]], ...] = (
    (re.compile(r"ok(?: N\d+| P\d+| B\d+)*"), lambda _: Ok()),
    (re.compile(rf"(ok )?({_AXES})(?: E:{_NUMBER})?(?: Count:? .*)?"), _position),
    (re.compile(r"Resend: ?(\d{1,9})"), lambda match: Resend(int(match[1]))),
    (re.compile(r"(?:echo:)?busy: ?(.*)"), lambda match: Busy("paused" in match[1])),
    (re.compile(r"start"), lambda _: Start()),
    (re.compile(r"echo:(Unknown command:.*|Home .*First.*)", re.IGNORECASE), lambda match: Refusal(match[1])),
    (re.compile(r"(?:Error: ?|!! ?)(.+)"), lambda match: ErrorText(match[1], bool(_TRANSMISSION.search(match[1])))),
    (re.compile(r"FIRMWARE_NAME:(.+?)(?: [A-Z_]+:.*)?"), lambda match: Firmware(match[1])),
    (re.compile(r"Cap:([A-Z0-9_]+):([01])"), lambda match: Capability(match[1], match[2] == "1")),
    (re.compile(rf"area:\{{.*work:\{{{_AREA_BOX}.*"), _limits),
    (
        re.compile(
            rf"(?:echo:)?.*Min:\s+X:?({_NUMBER}) Y:?({_NUMBER})(?: Z:?{_NUMBER})?"
            rf"\s+Max:\s+X:?({_NUMBER}) Y:?({_NUMBER})(?: Z:?{_NUMBER})?"
        ),
        _limits,
    ),
    (re.compile(r"([xyz]_(?:min|max)): (open|TRIGGERED)"), lambda match: Switch(match[1], match[2] == "TRIGGERED")),
    (re.compile(rf"(?:echo:)?\s*([MG]\d{{1,4}})((?: [A-Z]{_NUMBER})+)(?: ;.*)?"), _setting),
)
