"""Parses the lines that Marlin sends, numbers the lines sent to it, and derives travel, rates and tolerances.

A line that does not match a known form exactly is `Unknown`, so that a damaged line is never taken for an answer.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import reduce
from operator import xor
from typing import Self

from faintfield.rig.errors import WrongFirmware
from faintfield.rig.stages.protocol import Box, Identity, MotionLimits
from faintfield.rig.stages.transport import Ok, Unknown

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


# Reports have two decimals and commands three; each rounds by up to half of its last digit.
_ROUNDING_MM = 0.0055

# Homing may take this long (s); the settings that are read contain no homing speed to compute it from.
_HOMING_BOUND_S = 240.0


@dataclass(frozen=True)
class MarlinSettings:
    """What one controller has reported.

    Parameters
    ----------
    firmware : str
        Name and version.
    capabilities : dict
        Features that it was built with or without (M115).
    parameters : dict
        Parameters by command, from the settings report (M503).
    limits : tuple of Limits
        Reachable positions (M115, M211).
    """

    firmware: str
    capabilities: dict[str, bool]
    parameters: dict[str, dict[str, float]]
    limits: tuple[Limits, ...]

    @classmethod
    def from_messages(cls, messages: Iterable[Message]) -> Self:
        """Collect the settings from messages."""
        received = tuple(messages)
        names = [m.name for m in received if isinstance(m, Firmware)]
        return cls(
            firmware=names[0] if names else "",
            capabilities={m.name: m.present for m in received if isinstance(m, Capability)},
            parameters={m.command: m.parameters for m in received if isinstance(m, MarlinSetting)},
            limits=tuple(m for m in received if isinstance(m, Limits)),
        )

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
        if "marlin" not in self.firmware.lower():
            raise WrongFirmware(
                f"the controller is {self.firmware or 'of no stated name'!r}; Marlin is needed; "
                "flash it, or set stage.protocol"
            )
        x, y = axes
        travel_acceleration = self._number("M204", "T")
        return Identity(
            firmware=self.firmware,
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
        boxes = [Box(limits.x_mm, limits.y_mm) for limits in self.limits] if axes == ("X", "Y") else []
        if boxes:
            return reduce(Box.intersection, boxes)
        if configured is None:
            raise WrongFirmware("the controller does not report its travel (M115, M211); set stage.travel_mm")
        return configured

    def _warnings(self) -> list[str]:
        """Return settings that should be changed, each with its remedy."""
        warnings = []
        if not self.limits:
            warnings.append(
                "the controller reports no limits: only stage.travel_mm keeps the stage inside its travel; check it"
            )
        if not self.capabilities.get("EMERGENCY_PARSER", False):
            warnings.append("no emergency parser: a motion cannot be stopped half way; enable EMERGENCY_PARSER")
        return warnings

    def _tolerance(self, axis: str) -> float:
        """Return half a motor step plus the rounding of reports, in mm."""
        return 0.5 / self._number("M92", axis) + _ROUNDING_MM

    def _as_text(self) -> dict[str, str]:
        """Return the parameters as text, by command."""
        return {
            command: " ".join(f"{letter}{value:g}" for letter, value in parameters.items())
            for command, parameters in sorted(self.parameters.items())
        }

    def _number(self, command: str, letter: str) -> float:
        """Return one parameter; raises `WrongFirmware` if it was not reported or has an impossible value."""
        value = self.parameters.get(command, {}).get(letter)
        if value is None or value <= 0.0:
            raise WrongFirmware(
                f"{command} {letter}={'not reported' if value is None else f'{value:g}'}: "
                "the stage cannot be driven with it; set it in the controller"
            )
        return value
