"""A simulated grblHAL controller: what it does otherwise than GRBL, as far as a driver notices.

With hard limits on, its soft limits keep away from the switches by the pull-off. A critical alarm does not silence it:
it answers status requests, and refuses commands with error:79. A safety door during a jog freezes it in the state
`Jog`: it ignores a cancel, and a resume runs the rest of the jog. An emergency stop is ALARM:10, and no reset is
accepted while it is pressed. After power-up it raises ALARM:11 until it is homed, if `$22` asks for that. A change of
outputs is in the next report, without the overrides, and without letters if all are off.
"""

from typing import ClassVar

from faintfield.rig.simulation.controller.grbl import DEFAULTS, SimulatedGrbl

_HOMING_REQUIRED = 11

# Commands that are allowed during a critical alarm.
_HARMLESS = ("", "$I", "$$")


class SimulatedGrblHal(SimulatedGrbl):
    """Firmware, settings and mechanics of a grblHAL stage; the parameters are those of `SimulatedGrbl`."""

    _critical_alarms: ClassVar[tuple[int, ...]] = (1, 2, 10, 17)
    _defaults = DEFAULTS | {22: "7", 40: "0"}

    def _reset_state(self) -> None:
        super()._reset_state()
        self._alarm, self._frozen = 0, False
        self._outputs_changed = False

    # Pressed by `press_emergency_stop`; a class attribute, since the first restart comes before any instance has it.
    emergency_stop = False

    def press_emergency_stop(self) -> None:
        """Press the emergency stop."""
        self.emergency_stop = True
        self.alarm(10)

    def release_emergency_stop(self) -> None:
        """Release the emergency stop; the alarm stays until a reset."""
        self.emergency_stop = False

    def alarm(self, code: int) -> None:
        """Stop with an alarm."""
        self._alarm, self._frozen = code, False
        super().alarm(code)

    def open_door(self) -> None:
        """Open the safety door, which freezes a jog."""
        if self.state == "Jog":
            self.say("[MSG:Check Door]")
            self._held = self.mechanics.brake() or self._held
            self._frozen = True
            self._set_outputs(frozenset())
        else:
            super().open_door()

    def _booted(self) -> None:
        self.state = "Idle"
        self._greet()
        if int(self._number(22)) & 4:
            self.alarm(_HOMING_REQUIRED)
        if self.emergency_stop:
            self.alarm(10)

    def _greet(self) -> None:
        self.say("GrblHAL 1.1f ['$' or '$HELP' for help]")

    def _deaf(self) -> bool:
        return False

    def _ready(self) -> bool:
        return not self._frozen and super()._ready()

    def _build_info(self) -> tuple[str, ...]:
        single = "H" if self._homes_singly() else ""
        return ("[VER:1.1f.20250225:]", f"[OPT:VNM{single}L,100,1024,3,0]", "[AXS:3:XYZ]", "[FIRMWARE:grblHAL]")

    def _homes_singly(self) -> bool:
        return bool(int(self._number(22)) & 2)

    def _margin_mm(self) -> float:
        return self._number(27) if int(self._number(21)) & 1 else 0.0

    def _set_outputs(self, outputs: frozenset[str]) -> None:
        self._outputs_changed = self._outputs_changed or outputs != self.outputs
        self.outputs = outputs

    def _output_fields(self, *, due: bool, busy: bool) -> list[str]:
        fields = super()._output_fields(due=due, busy=busy)
        changed, self._outputs_changed = self._outputs_changed, False
        return [*fields, self._output_field()] if changed and len(fields) < 2 else fields

    def _reported_state(self) -> str:
        return f"Alarm:{self._alarm}" if self.state == "Alarm" and self._alarm else self.state

    def _pins(self) -> str:
        return super()._pins() + ("E" if self.emergency_stop else "")

    def _reset(self) -> None:
        if self.emergency_stop or not self._accepts_reset:
            return
        if self._frozen and not self.mechanics.moving:
            self.alarm(3)
        self._frozen = False
        super()._reset()

    def _cancel_jog(self) -> None:
        if not self._frozen:
            super()._cancel_jog()

    def _motion_ended(self) -> None:
        if not self._frozen:
            super()._motion_ended()

    def _resume(self) -> None:
        if self._frozen:
            self._frozen, self.state = False, "Hold:0"
        super()._resume()

    def _run(self, line: str) -> int | None:
        if self.critical and line not in _HARMLESS:
            return 79 if line.startswith("$") else 9
        return super()._run(line)
