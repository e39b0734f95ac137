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


def marlin_identity(messages: Iterable[Message], axes: tuple[str, str], travel_mm: Box | None) -> Identity:
    """Return firmware, travel, rates and tolerances of a controller.

    Parameters
    ----------
    messages : iterable of Message
        Answers about its capabilities (M115), settings (M503) and limits (M211).
    axes : (str, str)
        The controller's letters for the two axes.
    travel_mm : Box, optional
        The travel, for firmware that does not report it.

    Raises
    ------
    WrongFirmware
        The firmware is not Marlin, or does not report a setting that is needed.
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
    capabilities = {message.name: message.present for message in received if isinstance(message, Capability)}
    if not capabilities.get("EMERGENCY_PARSER"):
        warnings.append("no emergency parser: a motion cannot be stopped half way; enable EMERGENCY_PARSER")
    if limits and axes == ("X", "Y"):
        try:
            travel_mm = reduce(Box.intersection, (Box(message.x_mm, message.y_mm) for message in limits))
        except ValueError as failure:
            raise WrongFirmware(f"the travel reported (M115, M211) is none: {failure}; set it in Marlin") from failure
    if travel_mm is None:
        raise WrongFirmware("the controller does not report its travel (M115, M211); set stage.travel_mm")
    x, y = axes
    travel_acceleration = number("M204", "T")
    return Identity(
        firmware=firmware,
        travel_mm=travel_mm,
        motion=MotionLimits(
            rate_mm_per_s=(number("M203", x), number("M203", y)),
            acceleration_mm_per_s2=(
                min(travel_acceleration, number("M201", x)),
                min(travel_acceleration, number("M201", y)),
            ),
        ),
        # Half a motor step, and the rounding of reports
        tolerance_mm=(0.5 / number("M92", x) + _ROUNDING_MM, 0.5 / number("M92", y) + _ROUNDING_MM),
        homing_bound_s=_HOMING_BOUND_S,
        homes_together=False,
        pull_off_mm=0.0,
        settings={
            command: " ".join(f"{letter}{value:g}" for letter, value in letters.items())
            for command, letters in sorted(parameters.items())
        },
        warnings=tuple(warnings),
    )
