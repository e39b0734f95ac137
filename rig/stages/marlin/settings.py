"""What Marlin's settings mean for the stage: travel, rates, tolerance."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce
from typing import Self

from faintfield.rig.errors import WrongFirmware
from faintfield.rig.stages.marlin import messages as marlin
from faintfield.rig.stages.protocol import Box, Identity, MotionLimits

# Reports carry two decimals, commands three: each rounds by half of its last.
_ROUNDING_MM = 0.0055
_HOMING_BOUND_S = 240.0


@dataclass(frozen=True)
class MarlinSettings:
    """What one controller said of itself.

    Parameters
    ----------
    firmware : str
        Name and version.
    capabilities : dict
        What it was built with (M115).
    parameters : dict
        Command to parameters, from the settings report (M503).
    limits : tuple of Limits
        Reachable positions (M115, M211).
    """

    firmware: str
    capabilities: dict[str, bool]
    parameters: dict[str, dict[str, float]]
    limits: tuple[marlin.Limits, ...]

    @classmethod
    def from_messages(cls, messages: Iterable[marlin.Message]) -> Self:
        """Collect what concerns the stage from all that was said."""
        said = tuple(messages)
        names = [m.name for m in said if isinstance(m, marlin.Firmware)]
        return cls(
            firmware=names[0] if names else "",
            capabilities={m.name: m.present for m in said if isinstance(m, marlin.Capability)},
            parameters={m.command: m.parameters for m in said if isinstance(m, marlin.Setting)},
            limits=tuple(m for m in said if isinstance(m, marlin.Limits)),
        )

    def identity(self, axes: tuple[str, str], travel_mm: Box | None) -> Identity:
        """Return what the stage needs to know of the controller.

        Parameters
        ----------
        axes : (str, str)
            The controller's letters for the two axes.
        travel_mm : Box, optional
            The travel, for firmware that does not tell it.

        Raises
        ------
        WrongFirmware
            It is not Marlin, or does not tell what is needed.
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
        """Return the positions that every source of limits allows."""
        boxes = [Box(limits.x_mm, limits.y_mm) for limits in self.limits] if axes == ("X", "Y") else []
        if boxes:
            return reduce(Box.intersection, boxes)
        if configured is None:
            raise WrongFirmware("the controller does not tell its travel (M115, M211); set stage.travel_mm")
        return configured

    def _warnings(self) -> list[str]:
        """Return what should be changed, each with what to do."""
        warnings = []
        if not self.limits:
            warnings.append("the controller tells no limits: those in stage.travel_mm are all there is; check them")
        if not self.capabilities.get("EMERGENCY_PARSER", False):
            warnings.append("no emergency parser: a motion cannot be stopped half way; enable EMERGENCY_PARSER")
        return warnings

    def _tolerance(self, axis: str) -> float:
        """Return half a motor step plus the rounding of reports."""
        return 0.5 / self._number("M92", axis) + _ROUNDING_MM

    def _as_text(self) -> dict[str, str]:
        """Return the settings as they would be typed, by command."""
        return {
            command: " ".join(f"{letter}{value:g}" for letter, value in parameters.items())
            for command, parameters in sorted(self.parameters.items())
        }

    def _number(self, command: str, letter: str) -> float:
        """Return one parameter; raises `WrongFirmware` when it was not reported or cannot be."""
        value = self.parameters.get(command, {}).get(letter)
        if value is None or value <= 0.0:
            raise WrongFirmware(
                f"{command} {letter}={'not reported' if value is None else f'{value:g}'}: "
                "the stage cannot be driven with it; set it in the controller"
            )
        return value
