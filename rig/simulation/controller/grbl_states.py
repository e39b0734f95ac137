"""The states of the simulated GRBL: real-time characters, alarms, resets, holds and status reports."""

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

from faintfield.rig.simulation.controller.firmware import SimulatedFirmware
from faintfield.rig.simulation.controller.grbl_settings import StoredSettings, status_report
from faintfield.rig.simulation.controller.kinematics import Mechanics, Vector
from faintfield.rig.simulation.controller.wire import SimulatedClock, Wire

# The work offset is in every 30th report while moving, and in every 10th at rest.
_OFFSET_EVERY_BUSY, _OFFSET_EVERY_IDLE = 30, 10

_ALARM_DELAY_S = 0.05  # from a critical alarm until a reset is accepted

_RESUMED_MM_PER_MIN = 6000.0  # rate of motion that was held and goes on


class GrblStates(SimulatedFirmware):
    """The state machine of a simulated GRBL; `SimulatedGrbl` adds the lines that it runs.

    Parameters
    ----------
    clock, wire, mechanics, boot_s :
        See `SimulatedFirmware`.
    settings : StoredSettings
        Values by `$` number.

    Attributes
    ----------
    door_is_open : bool
        Whether the safety door stays open; `open_door` alone is a door that is closed again at once.
    """

    door_is_open = False

    protocol = "grbl"
    _line_end = b"\r\n"
    _critical_alarms: ClassVar[tuple[int, ...]] = (1, 2)

    def __init__(
        self, clock: SimulatedClock, wire: Wire, mechanics: Mechanics, boot_s: float, settings: StoredSettings
    ) -> None:
        self.settings = settings
        mechanics.on_switch = self._switch_hit
        self._realtime: dict[int, Callable[[], None]] = {
            ord("?"): self._report,
            ord("!"): self._hold,
            ord("~"): self._resume,
            0x18: self._reset,
            0x84: self.open_door,
            0x85: self._cancel_jog,
        }
        super().__init__(clock, wire, mechanics, boot_s)

    def _reset_state(self) -> None:
        self.work_offset, self._reports_to_offset = (0.0, 0.0, 0.0), 0
        self.state, self.critical, self._accepts_reset = "Boot", False, True
        self._held: list[Vector] = []

    def receive(self, data: bytes) -> None:
        """Take bytes from the host; real-time characters act at once, even inside a line."""
        for byte in data:
            if self.state == "Boot":
                return
            if act := self._realtime.get(byte):
                act()
            elif not self._deaf():
                self._take(byte)
        self._run_lines()

    @abstractmethod
    def _take(self, byte: int) -> None:
        """Take one byte that is no real-time character."""

    @abstractmethod
    def _run_lines(self) -> None:
        """Run the lines that are waiting, as far as the state allows."""

    @abstractmethod
    def _queue(self, target: Vector, feed_mm_per_min: float, state: str) -> None:
        """Plan a straight motion, which puts GRBL into `state`."""

    def _deaf(self) -> bool:
        """Return whether GRBL hears nothing but a reset."""
        return self.critical

    def alarm(self, code: int) -> None:
        """Stop with an alarm."""
        homing = self.state == "Home"
        if self.mechanics.moving or homing:
            self.mechanics.stop_dead()
            self._cancel_homing()
        self.state = "Alarm"
        self._waiting.clear()
        self.say(f"ALARM:{code}")
        if code in self._critical_alarms:
            self.critical, self._accepts_reset = True, False
            self.clock.after(_ALARM_DELAY_S, self._ask_for_reset)
        elif homing:
            self.say("ok")  # the answer to the homing command, sent although it failed
            self._greet()

    def _booted(self) -> None:
        self.state = "Alarm" if self.settings.number(22) else "Idle"
        self._greet()

    def _greet(self) -> None:
        self.say("Grbl 1.1h ['$' for help]")
        if self.state == "Alarm":
            self.say("[MSG:'$H'|'$X' to unlock]")

    def _ask_for_reset(self) -> None:
        self.say("[MSG:Reset to continue]")
        self._accepts_reset = True

    def _reset(self) -> None:
        if not self._accepts_reset:
            return
        self._held.clear()
        self._line.clear()
        self._waiting.clear()
        if self.state == "Home":
            self.alarm(6)
            return
        in_motion = self.mechanics.moving
        if in_motion:
            self.mechanics.stop_dead()
            self.say("ALARM:3")
        self.critical = False
        self.state = "Alarm" if in_motion or self.state in ("Alarm", "Sleep") else "Idle"
        self._greet()
        if self.door_is_open:
            self.open_door()

    def _hold(self) -> None:
        if self.state == "Jog":
            self._cancel_jog()
        elif self.state == "Run":
            self.pause()

    def _cancel_jog(self) -> None:
        if self.state == "Jog":
            self.mechanics.brake()

    def open_door(self) -> None:
        """Open the safety door, which cancels a jog and holds other motion."""
        jogging = self.state == "Jog"
        self.state = "Door:2" if self.mechanics.moving else "Door:1"
        ahead = self.mechanics.brake()
        self._held = [] if jogging else ahead or self._held

    def pause(self) -> None:
        """Press the feed-hold button of the machine, which holds a jog as well."""
        self.state = "Hold:1" if self.mechanics.moving else "Hold:0"
        self._held = self.mechanics.brake() or self._held

    def _motion_ended(self) -> None:
        self.state = {"Hold:1": "Hold:0", "Door:2": "Door:1"}.get(self.state, self.state)
        if self.state in ("Jog", "Run"):
            self.state = "Idle"
        self._run_lines()

    def _switch_hit(self) -> None:
        if self.settings.number(21):
            self.alarm(1)

    def _report(self) -> None:
        if self._deaf() or self.state == "Home":
            return
        tell_offset = self._reports_to_offset == 0
        if tell_offset:
            busy = self.state in ("Jog", "Run")
            self._reports_to_offset = _OFFSET_EVERY_BUSY if busy else _OFFSET_EVERY_IDLE
        self._reports_to_offset -= 1
        here = (*self.mechanics.commanded_mm(), 0.0)
        is_machine = int(self.settings.number(10)) & 1 == 1
        self.say(status_report(self._told_state(), here, self.work_offset, self._pins(), is_machine, tell_offset))

    def _told_state(self) -> str:
        return self.state

    def _pins(self) -> str:
        return "".join(axis for axis, closed in zip("XY", self.mechanics.switches(), strict=True) if closed)

    def _resume(self) -> None:
        if self.state not in ("Hold:0", "Door:0"):
            return
        self.state = "Idle"
        held, self._held = self._held, []
        for target in held:
            self._queue(target, _RESUMED_MM_PER_MIN, "Run")
