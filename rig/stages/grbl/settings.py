"""Derives travel, rates and tolerances from GRBL's settings, and refuses settings that make positions unsafe."""

import re

from msgspec import Struct

from faintfield.rig.errors import WrongFirmware
from faintfield.rig.stages.motion import timeout_s
from faintfield.rig.stages.protocol import Box, Identity, MotionLimits

# Reports and commands have three decimals, and each rounds by up to half a micrometre.
_ROUNDING_MM = 0.001

# Homing may take this long (s) even where the settings predict less: a slow stage must not fail half way.
_MIN_HOMING_BOUND_S = 240.0

# The soft limits of jogs, in the settings of grblHAL only.
_HAL_SETTING = 40

# The value of $1 that keeps the motors on between motions.
_KEEP_MOTORS_ON = 255


class GrblSettings(Struct, frozen=True):
    """The `$$` settings of one controller by number, and its `$I` build information by kind, as reported."""

    values: dict[int, str]
    build: dict[str, str]

    def identity(self, axes: tuple[int, ...]) -> Identity:
        """Return firmware, travel, rates and tolerances of the controller, for the two axes of these numbers.

        Raises
        ------
        WrongFirmware
            The firmware is not GRBL 1.1, or a setting makes positions unsafe; the message says what to set.
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
            tolerance_mm=(self._tolerance(x), self._tolerance(y)),
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

    def _tolerance(self, axis: int) -> float:
        """Return half a motor step plus the rounding of reports, in mm."""
        return 0.5 / self._number(100 + axis) + _ROUNDING_MM

    def _homing_bound_s(self, axes: tuple[int, ...]) -> float:
        """Return a bound for homing: the whole travel at the seek rate, and twice the slow search."""
        seek_s = 60.0 * max(self._number(130 + axis) for axis in axes) / self._number(25)
        locate_s = 4.0 * 60.0 * self._number(27) / self._number(24)
        return max(_MIN_HOMING_BOUND_S, timeout_s(seek_s + locate_s))

    def _is_hal(self) -> bool:
        """Return whether the firmware is grblHAL: it says so, or has a setting that GRBL does not have."""
        return self.build.get("FIRMWARE") == "grblHAL" or _HAL_SETTING in self.values

    def _options(self) -> str:
        return self.build.get("OPT", "").partition(",")[0]

    def _number(self, setting: int) -> float:
        """Return a setting; raises `WrongFirmware` if it was not reported or has an impossible value."""
        value = float(self.values.get(setting, "nan"))
        if not (value > 0.0 or (value == 0.0 and setting < 100 and setting not in (24, 25))):
            raise WrongFirmware(
                f"${setting}={self.values.get(setting, 'not reported')}: the stage cannot be driven; set it in the "
                "controller"
            )
        return value
