"""Parse the lines that GRBL 1.1 sends, and derive travel, rates and tolerances from its settings.

Responses (`ok`, `error:N`) answer commands; GRBL sends all other lines unasked. A line that does not match a known form
exactly is `Unknown`, so that a damaged line is never taken for a response.
"""

import re
from collections.abc import Callable

from msgspec import Struct

from faintfield.rig.errors import WrongFirmware
from faintfield.rig.stages.motion import timeout_s
from faintfield.rig.stages.protocol import MIN_HOMING_BOUND_S, Box, Identity, MotionLimits
from faintfield.rig.stages.transport import Ok, Unknown

_NUMBER = r"-?\d{1,7}(?:\.\d{1,6})?"
_VECTOR = rf"{_NUMBER}(?:,{_NUMBER}){{1,5}}"
# Reports and commands have three decimals, and each rounds by up to half a micrometre.
_ROUNDING_MM = 0.001
# The soft limits of jogs, in the settings of grblHAL only.
_HAL_SETTING = 40
# The value of $1 that keeps the motors on between motions.
_KEEP_MOTORS_ON = 255
# The settings on which motion depends: inversions of step and direction, reports and units, limits and homing, and
# steps, rates, accelerations and travel of all axes.
_MOTION_SETTINGS = frozenset({2, 3, 10, 13, *range(20, 28), *range(40, 50), *range(100, 140)})


class ErrorCode(Struct, frozen=True):
    """The controller has refused a command."""

    code: int


class Alarm(Struct, frozen=True):
    """The controller has stopped."""

    code: int


class Banner(Struct, frozen=True):
    """The controller has just started."""


class GrblSetting(Struct, frozen=True):
    """One `$` setting."""

    number: int
    value: str


class Feedback(Struct, frozen=True):
    """A message in brackets: its kind (`MSG`, `VER`, `OPT`, ...) and text."""

    kind: str
    text: str

    @property
    def is_door(self) -> bool:
        """Return whether the safety door was opened."""
        return (self.kind, self.text) == ("MSG", "Check Door")


class Report(Struct, frozen=True):
    """A real-time status report.

    `substate` is the number after the state; `Hold:0` means that the stage has come to rest. `position` (mm) is in
    machine coordinates if `is_machine`, otherwise in work coordinates. `offset` (mm), which only some reports carry, is
    to be added to the latter. `pins` are the letters of the active inputs; that of an axis stands for its limit switch.
    `outputs` are the letters of those that are on: S and C for the spindle, F for flood, M for mist; None if the report
    does not tell, as most do not. Of these, one that `is_brief` says that they have not changed since the last report.
    """

    state: str
    substate: int | None
    position: tuple[float, ...]
    is_machine: bool
    offset: tuple[float, ...] | None
    pins: str
    outputs: frozenset[str] | None = None
    is_brief: bool = False

    @property
    def emergency_stop(self) -> bool:
        """Return whether the emergency stop is pressed, which grblHAL reports among the inputs."""
        return "E" in self.pins

    @property
    def door_is_open(self) -> bool:
        """Return whether the safety door is open, by its input."""
        return "D" in self.pins

    @property
    def is_moving(self) -> bool:
        """Return whether the stage moves or slows down."""
        slowing = (self.state, self.substate) in (("Hold", 1), ("Door", 2), ("Door", 3))
        return self.state in ("Jog", "Run") or slowing


type Message = Ok | ErrorCode | Alarm | Banner | GrblSetting | Feedback | Report | Unknown


def parse(line: str) -> Message:
    """Return `line` as a message."""
    return next((make(match) for form, make in _FORMS if (match := re.fullmatch(form, line))), Unknown(line))


def _report(match: re.Match[str]) -> Report:
    state, substate, frame, position, fields = match.groups()
    offset = re.search(rf"\|WCO:({_VECTOR})(?=\||$)", fields)
    pins = re.search(r"\|Pn:([A-Z]+)(?=\||$)", fields)
    # GRBL: only together with the overrides, if any is on; grblHAL: at any change, without letters if all are off
    outputs = re.search(r"\|A:([SCFMET]*)(?=\||$)", fields)
    tells_outputs = outputs is not None or re.search(r"\|Ov:\d+,\d+,\d+(?=\||$)", fields)
    return Report(
        state=state,
        substate=None if substate is None else int(substate),
        position=tuple(map(float, position.split(","))),
        is_machine=frame == "M",
        offset=None if offset is None else tuple(map(float, offset[1].split(","))),
        pins="" if pins is None else pins[1],
        outputs=frozenset("" if outputs is None else outputs[1]) if tells_outputs else None,
        is_brief=re.fullmatch(r"(?:\|(?:Bf:\d+,\d+|Ln:\d+|FS?:[\d.]+(?:,[\d.]+)*|Pn:[A-Z]+))*", fields) is not None,
    )


# The forms of lines, each with the function that makes its message of a match.
_FORMS: tuple[tuple[str, Callable[[re.Match[str]], Message]], ...] = (
    ("ok", lambda _: Ok()),
    (
        r"<(Idle|Run|Hold|Jog|Alarm|Door|Check|Home|Sleep|Tool)(?::(\d{1,2}))?"
        rf"\|([MW])Pos:({_VECTOR})((?:\|[^|<>]*)*)>",
        _report,
    ),
    (r"error:(\d{1,3})", lambda match: ErrorCode(int(match[1]))),
    (r"ALARM:(\d{1,3})", lambda match: Alarm(int(match[1]))),
    (rf"\$(\d{{1,3}})=({_NUMBER})", lambda match: GrblSetting(int(match[1]), match[2])),
    (r"\[([A-Za-z0-9]+):(.*)\]", lambda match: Feedback(match[1], match[2])),
    (r"(?:Grbl|GrblHAL) \d{1,2}\.\d{1,2}[a-z]?(?: .*)?", lambda _: Banner()),
)


def motion_settings(values: dict[int, str]) -> dict[int, str]:
    """Return the settings on which motion depends."""
    return {number: value for number, value in values.items() if number in _MOTION_SETTINGS}


class GrblSettings(Struct, frozen=True):
    """The `$$` settings of one controller by number, and its `$I` build information by kind, as reported."""

    values: dict[int, str]
    build: dict[str, str]

    def identity(self, axes: tuple[int, ...]) -> Identity:
        """Return firmware, travel, rates and tolerances of the controller, for the two axes of these numbers.

        Raises `WrongFirmware` if the firmware is not GRBL 1.1, or a setting makes positions unsafe.
        """
        version = self.build.get("VER", "")
        if not re.match(r"v?1\.1", version):
            raise WrongFirmware(f"the controller is GRBL {version or 'of no version'!r}; flash 1.1 or grblHAL")
        if not int(self._number(22)) & 1:
            raise WrongFirmware("$22=0: the controller has no homing, so its position cannot be known; set $22=1")
        if self._number(13) != 0:
            raise WrongFirmware("$13=1: positions are reported in inches; set $13=0")
        warnings = []
        if self._number(20) == 0:
            warnings.append("$20=0: the controller itself does not keep to its travel; set $20=1")
        if self._number(1) != _KEEP_MOTORS_ON:
            warnings.append(f"$1={self.values[1]}: the motors let go between motions; set $1={_KEEP_MOTORS_ON}")
        x, y = axes
        return Identity(
            firmware=f"{'grblHAL' if self._is_hal() else 'Grbl'} {version.rstrip(':')}",
            travel_mm=Box(self._travel(x), self._travel(y)),
            motion=MotionLimits(
                rate_mm_per_s=(self._number(110 + x) / 60.0, self._number(110 + y) / 60.0),
                acceleration_mm_per_s2=(self._number(120 + x), self._number(120 + y)),
            ),
            # Half a motor step, and the rounding of reports
            tolerance_mm=(0.5 / self._number(100 + x) + _ROUNDING_MM, 0.5 / self._number(100 + y) + _ROUNDING_MM),
            homing_bound_s=self._homing_bound_s(axes),
            homes_together="H" not in self._options(),
            pull_off_mm=self._number(27),
            settings={f"${number}": value for number, value in sorted(self.values.items())},
            warnings=tuple(warnings),
        )

    def _travel(self, axis: int) -> tuple[float, float]:
        """Return the machine coordinates of the ends of `axis`.

        Homing sets the end with the switch to zero, and the travel extends to negative coordinates from there. It
        extends to positive ones if the firmware was built with the switch as origin (option Z) and homes to the lower
        end ($23). The soft limits of grblHAL keep the pull-off from the switches, if these stop motion ($21), and as
        much from the other end.
        """
        length_mm = self._number(130 + axis)
        margin_mm = self._number(27) if self._is_hal() and int(self._number(21)) & 1 else 0.0
        homes_low = bool(int(self._number(23)) >> axis & 1)
        if "Z" not in self._options():
            return margin_mm - length_mm, 0.0 - margin_mm  # not -0.0, which reads badly
        return (0.0, length_mm - margin_mm) if homes_low else (margin_mm - length_mm, 0.0)

    def _homing_bound_s(self, axes: tuple[int, ...]) -> float:
        """Return a bound for homing: the whole travel at the seek rate, and twice the slow search."""
        seek_s = 60.0 * max(self._number(130 + axis) for axis in axes) / self._number(25)
        locate_s = 4.0 * 60.0 * self._number(27) / self._number(24)
        return max(MIN_HOMING_BOUND_S, timeout_s(seek_s + locate_s))

    def _is_hal(self) -> bool:
        """Return whether the firmware is grblHAL: it says so, or has a setting that GRBL does not have."""
        return self.build.get("FIRMWARE") == "grblHAL" or _HAL_SETTING in self.values

    def _options(self) -> str:
        return self.build.get("OPT", "").partition(",")[0]

    def _number(self, setting: int) -> float:
        """Return a setting; raises `WrongFirmware` if it was not reported or has an impossible value."""
        value = float(self.values.get(setting, "nan"))
        if not (value > 0.0 or (value == 0.0 and setting < 100 and setting not in (24, 25))):
            state = self.values.get(setting, "not reported")
            raise WrongFirmware(f"${setting}={state}: the stage cannot be driven with it; set it in the controller")
        return value
