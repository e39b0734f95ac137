"""Derives travel, rates and tolerances from what Marlin reports."""

from collections.abc import Iterable
from functools import reduce

from faintfield.rig.errors import WrongFirmware
from faintfield.rig.stages.marlin.messages import Capability, Firmware, Limits, MarlinSetting, Message
from faintfield.rig.stages.protocol import Box, Identity, MotionLimits

# Reports have two decimals and commands three; each rounds by up to half of its last digit.
_ROUNDING_MM = 0.0055

# Homing may take this long (s); the settings that are read contain no homing speed to compute it from.
_HOMING_BOUND_S = 240.0


class MarlinSettings:
    """Settings that one controller has reported.

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
