"""Parse the lines that Marlin sends, number the lines sent to it, and derive travel and rates from its settings.

A line that does not match a known form exactly is `Unknown`, so that a damaged line is never taken for an answer.
"""

import re
from collections.abc import Callable, Iterable
from functools import reduce
from operator import xor

from msgspec import Struct

from faintfield.rig.errors import WrongFirmware
from faintfield.rig.stages.protocol import MIN_HOMING_BOUND_S, Box, Identity, MotionLimits
from faintfield.rig.stages.transport import Ok, Unknown

_NUMBER = r"-?\d{1,7}(?:\.\d{1,16})?"
_AXES = rf"X:\s?{_NUMBER} Y:\s?{_NUMBER}(?: Z:\s?{_NUMBER})?"
_AREA_BOX = rf"min:\{{x:({_NUMBER}),y:({_NUMBER})[^}}]*\}},max:\{{x:({_NUMBER}),y:({_NUMBER})[^}}]*\}}"
_CORNER = rf"X:?({_NUMBER}) Y:?({_NUMBER})(?: Z:?{_NUMBER})?"
# Errors about a damaged line, which the controller has not executed and asks for again.
_TRANSMISSION = r"(?i)checksum|line number|expected line"
# Reports have two decimals and commands three; each rounds by up to half of its last digit.
_ROUNDING_MM = 0.0055


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
    return next((make(match) for form, make in _FORMS if (match := re.fullmatch(form, line))), Unknown(line))


def number_line(number: int, command: str) -> bytes:
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
_FORMS: tuple[tuple[str, Callable[[re.Match[str]], Message]], ...] = (
    (r"ok(?: N\d+| P\d+| B\d+)*", lambda _: Ok()),
    (rf"(ok )?({_AXES})(?: E:{_NUMBER})?(?: Count:? .*)?", _position),
    (r"Resend: ?(\d{1,9})", lambda match: Resend(int(match[1]))),
    (r"(?:echo:)?busy: ?(.*)", lambda match: Busy("paused" in match[1])),
    (r"start", lambda _: Start()),
    (r"(?i:echo:(Unknown command:.*|Home .*First.*))", lambda match: Refusal(match[1])),
    (r"(?:Error: ?|!! ?)(.+)", lambda match: ErrorText(match[1], bool(re.search(_TRANSMISSION, match[1])))),
    (r"FIRMWARE_NAME:(.+?)(?: [A-Z_]+:.*)?", lambda match: Firmware(match[1])),
    (r"Cap:([A-Z0-9_]+):([01])", lambda match: Capability(match[1], match[2] == "1")),
    (rf"area:\{{.*work:\{{{_AREA_BOX}.*", _limits),
    (rf"(?:echo:)?.*Min:\s+{_CORNER}\s+Max:\s+{_CORNER}", _limits),
    (r"([xyz]_(?:min|max)): (open|TRIGGERED)", lambda match: Switch(match[1], match[2] == "TRIGGERED")),
    (rf"(?:echo:)?\s*([MG]\d{{1,4}})((?: [A-Z]{_NUMBER})+)(?: ;.*)?", _setting),
)


def marlin_identity(messages: Iterable[Message], axes: tuple[str, str], travel_mm: Box | None) -> Identity:
    """Return firmware, travel, rates and tolerances by the answers about capabilities, settings and limits.

    `axes` are the controller's letters; `travel_mm` serves firmware that does not report its travel (M115, M211).
    Raises `WrongFirmware` if the firmware is not Marlin, or does not report a setting that is needed.
    """
    received = tuple(messages)
    firmware = next((message.name for message in received if isinstance(message, Firmware)), "")
    if "marlin" not in firmware.lower():
        raise WrongFirmware(f"the controller is {firmware or 'nameless'!r}, not Marlin; flash it or set stage.protocol")
    parameters = {message.command: message.parameters for message in received if isinstance(message, MarlinSetting)}

    def number(command: str, letter: str) -> float:
        value = parameters.get(command, {}).get(letter)
        if value is None or value <= 0.0:
            state = "not reported" if value is None else f"{value:g}"
            raise WrongFirmware(f"{command} {letter}={state}: the stage cannot be driven with it; set it in Marlin")
        return value

    limits = [message for message in received if isinstance(message, Limits)]
    warnings = []
    if not limits:
        warnings.append("no limits are reported: only stage.travel_mm keeps the stage inside its travel; check it")
    if Capability("EMERGENCY_PARSER", present=True) not in received:
        warnings.append("no emergency parser: a motion cannot be stopped half way; enable EMERGENCY_PARSER")
    if limits and axes == ("X", "Y"):
        try:
            travel_mm = reduce(Box.intersection, (Box(message.x_mm, message.y_mm) for message in limits))
        except ValueError as failure:
            raise WrongFirmware(f"the travel reported (M115, M211) is none: {failure}; set it in Marlin") from failure
    if travel_mm is None:
        raise WrongFirmware("the controller does not report its travel (M115, M211); set stage.travel_mm")
    x, y = axes
    limit = number("M204", "T")
    return Identity(
        firmware=firmware,
        travel_mm=travel_mm,
        motion=MotionLimits(
            rate_mm_per_s=(number("M203", x), number("M203", y)),
            acceleration_mm_per_s2=(min(limit, number("M201", x)), min(limit, number("M201", y))),
        ),
        # Half a motor step, and the rounding of reports
        tolerance_mm=(0.5 / number("M92", x) + _ROUNDING_MM, 0.5 / number("M92", y) + _ROUNDING_MM),
        homing_bound_s=MIN_HOMING_BOUND_S,  # the settings contain no homing speed to compute it from
        homes_together=False,
        pull_off_mm=0.0,
        settings={
            command: " ".join(f"{letter}{value:g}" for letter, value in letters.items())
            for command, letters in sorted(parameters.items())
        },
        warnings=tuple(warnings),
    )
