"""Parses the lines that Marlin sends, numbers the lines sent to it, and derives travel, rates and tolerances.

A line that does not match a known form exactly is `Unknown`, so that a damaged line is never taken for an answer.
"""

import re
from collections.abc import Callable, Iterable
from functools import reduce
from operator import xor

from msgspec import Struct

from faintfield.rig.errors import WrongFirmware
from faintfield.rig.stages.protocol import Box, Identity, MotionLimits
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
    """The controller is still executing the last command."""


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
    return next((make(found) for form, make in _FORMS if (found := form.fullmatch(line))), Unknown(line))


def numbered(number: int, command: str) -> bytes:
    """Return `command` with its line number and the XOR of its bytes, so that Marlin recognises a damaged line."""
    line = f"N{number} {command}".encode("ascii")
    return line + b"*%d\n" % reduce(xor, line)


def _position(found: re.Match[str]) -> PositionReport:
    """Return the positions of a match, by axis."""
    axes = re.findall(rf"([XYZ]):\s?({_NUMBER})", found[2])
    return PositionReport({axis: float(value) for axis, value in axes}, is_ok=found[1] is not None)


def _limits(found: re.Match[str]) -> Limits:
    """Return the reachable positions of a match."""
    x_min, y_min, x_max, y_max = map(float, found.groups())
    return Limits((x_min, x_max), (y_min, y_max))


def _setting(found: re.Match[str]) -> MarlinSetting:
    """Return the command and the parameters of a match."""
    return MarlinSetting(found[1], {word[0]: float(word[1:]) for word in found[2].split()})


# The forms of lines, each with the function that makes its message of a match.
_FORMS: tuple[tuple[re.Pattern[str], Callable[[re.Match[str]], Message]], ...] = (
    (re.compile(r"ok(?: N\d+| P\d+| B\d+)*"), lambda _: Ok()),
    (re.compile(rf"(ok )?({_AXES})(?: E:{_NUMBER})?(?: Count:? .*)?"), _position),
    (re.compile(r"Resend: ?(\d{1,9})"), lambda found: Resend(int(found[1]))),
    (re.compile(r"(?:echo:)?busy: ?(.*)"), lambda _: Busy()),
    (re.compile(r"start"), lambda _: Start()),
    (re.compile(r"echo:(Unknown command:.*|Home .*First.*)", re.IGNORECASE), lambda found: Refusal(found[1])),
    (re.compile(r"(?:Error: ?|!! ?)(.+)"), lambda found: ErrorText(found[1], bool(_TRANSMISSION.search(found[1])))),
    (re.compile(r"FIRMWARE_NAME:(.+?)(?: [A-Z_]+:.*)?"), lambda found: Firmware(found[1])),
    (re.compile(r"Cap:([A-Z0-9_]+):([01])"), lambda found: Capability(found[1], found[2] == "1")),
    (re.compile(rf"area:\{{.*work:\{{{_AREA_BOX}.*"), _limits),
    (
        re.compile(
            rf"(?:echo:)?.*Min:\s+X:?({_NUMBER}) Y:?({_NUMBER})(?: Z:?{_NUMBER})?"
            rf"\s+Max:\s+X:?({_NUMBER}) Y:?({_NUMBER})(?: Z:?{_NUMBER})?"
        ),
        _limits,
    ),
    (re.compile(r"([xyz]_(?:min|max)): (open|TRIGGERED)"), lambda found: Switch(found[1], found[2] == "TRIGGERED")),
    (re.compile(rf"(?:echo:)?\s*([MG]\d{{1,4}})((?: [A-Z]{_NUMBER})+)(?: ;.*)?"), _setting),
)


# Reports have two decimals and commands three; each rounds by up to half of its last digit.
_ROUNDING_MM = 0.0055

# Homing may take this long (s); the settings that are read contain no homing speed to compute it from.
_HOMING_BOUND_S = 240.0


class MarlinSettings:
    """What one controller has reported.

    Parameters
    ----------
    messages : iterable of Message
        Answers about its capabilities (M115), settings (M503) and limits (M211).
    """

    def __init__(self, messages: Iterable[Message]) -> None:
        received = tuple(messages)
        self._firmware = next((m.name for m in received if isinstance(m, Firmware)), "")
        self._capabilities = {m.name: m.present for m in received if isinstance(m, Capability)}
        self._parameters = {m.command: m.parameters for m in received if isinstance(m, MarlinSetting)}
        self._limits = [m for m in received if isinstance(m, Limits)]

    def identity(self, axes: tuple[str, str], travel_mm: Box | None) -> Identity:
        """Return firmware, travel, rates and tolerances of the controller.

        Parameters
        ----------
        axes : (str, str)
            The controller's letters for the two axes.
        travel_mm : Box, optional
            The travel, for firmware that does not report it.

        Raises
        ------
        WrongFirmware
            The firmware is not Marlin, or does not report a setting that is needed.
        """
        if "marlin" not in self._firmware.lower():
            raise WrongFirmware(
                f"the controller is {self._firmware or 'of no stated name'!r}; Marlin is needed; "
                "flash it, or set stage.protocol"
            )
        x, y = axes
        travel_acceleration = self._number("M204", "T")
        return Identity(
            firmware=self._firmware,
            travel_mm=self._travel(axes, travel_mm),
            motion=MotionLimits(
                rate_mm_per_s=(self._number("M203", x), self._number("M203", y)),
                acceleration_mm_per_s2=(
                    min(travel_acceleration, self._number("M201", x)),
                    min(travel_acceleration, self._number("M201", y)),
                ),
            ),
            tolerance_mm=(self._tolerance(x), self._tolerance(y)),
            homing_bound_s=_HOMING_BOUND_S,
            homes_together=False,
            pull_off_mm=0.0,
            settings=self._as_text(),
            warnings=tuple(self._warnings()),
        )

    def _travel(self, axes: tuple[str, str], configured: Box | None) -> Box:
        """Return the positions that all reported limits allow."""
        boxes = [Box(limits.x_mm, limits.y_mm) for limits in self._limits] if axes == ("X", "Y") else []
        if boxes:
            return reduce(Box.intersection, boxes)
        if configured is None:
            raise WrongFirmware("the controller does not report its travel (M115, M211); set stage.travel_mm")
        return configured

    def _warnings(self) -> list[str]:
        """Return settings that should be changed, each with its remedy."""
        warnings = []
        if not self._limits:
            warnings.append(
                "the controller reports no limits: only stage.travel_mm keeps the stage inside its travel; check it"
            )
        if not self._capabilities.get("EMERGENCY_PARSER", False):
            warnings.append("no emergency parser: a motion cannot be stopped half way; enable EMERGENCY_PARSER")
        return warnings

    def _tolerance(self, axis: str) -> float:
        """Return half a motor step plus the rounding of reports, in mm."""
        return 0.5 / self._number("M92", axis) + _ROUNDING_MM

    def _as_text(self) -> dict[str, str]:
        """Return the parameters as text, by command."""
        return {
            command: " ".join(f"{letter}{value:g}" for letter, value in parameters.items())
            for command, parameters in sorted(self._parameters.items())
        }

    def _number(self, command: str, letter: str) -> float:
        """Return one parameter; raises `WrongFirmware` if it was not reported or has an impossible value."""
        value = self._parameters.get(command, {}).get(letter)
        if value is None or value <= 0.0:
            raise WrongFirmware(
                f"{command} {letter}={'not reported' if value is None else f'{value:g}'}: "
                "the stage cannot be driven with it; set it in the controller"
            )
        return value
