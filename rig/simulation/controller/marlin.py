"""A simulated Marlin 2.1 controller, with the peculiarities that a driver must cope with.

As in the real one, a damaged numbered line is asked for again with an `ok` that acknowledges nothing; targets outside
the travel are silently clipped; M114 reports the last target and M114 R the real position; an emergency stop ends
motion without slowing down; the motors are released after two idle minutes unless set otherwise; and a killed
controller is silent until it is restarted.
"""

import math
import re
from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from operator import xor

from faintfield.rig.simulation.controller.firmware import SimulatedFirmware, Wire, parse_parameters
from faintfield.rig.simulation.controller.kinematics import Axis, Mechanics, ScheduledEvent, SimulatedClock, along

# Interval in s of the busy messages while a command is executed.
_BUSY_EVERY_S = 2.0

# Idle time in s after which the motors are released.
_RELEASE_AFTER_S = 120.0

# Speed of homing in mm/s, and how far in mm it backs off a switch before it approaches again.
_SEEK_MM_PER_S, _BUMP_MM = 25.0, 5.0


class SimulatedMarlin(SimulatedFirmware):
    """Firmware, settings and mechanics of a Marlin stage.

    Coordinates run upwards from zero, where the switches are. Both drives have play. With `realtime_position`, M114 R
    reports the real position.
    """

    protocol = "marlin"
    _line_end = b"\n"

    def __init__(
        self,
        clock: SimulatedClock,
        wire: Wire,
        travel_mm: tuple[float, float] = (400.0, 400.0),
        *,
        boot_s: float = 1.0,
        play_mm: float = 0.0,
        realtime_position: bool = True,
    ) -> None:
        self.travel_mm = travel_mm
        self.settings = {"M92": 80.0, "M203": 100.0, "M201": 500.0, "M204": 500.0}
        self._realtime_position = realtime_position
        self._motors_off: ScheduledEvent | None = None
        x, y = (Axis(-2.0, length + 5.0, 0.5 * length, play_mm) for length in travel_mm)
        mechanics = Mechanics(clock, (x, y), 1.0 / self.settings["M92"], -1.0)
        super().__init__(clock, wire, mechanics, boot_s)

    def _reset_state(self) -> None:
        if self._motors_off is not None:
            self._motors_off.cancel()
        self.alive, self.homed, self._idle_limit_s = False, [False, False], _RELEASE_AFTER_S
        self._relative, self._last_line = False, 0
        self._awaited: Callable[[], bool] | None = None
        self._waits_for_button = False

    def receive(self, data: bytes) -> None:
        """Take bytes from the host."""
        for byte in data:
            if not self.alive:
                continue
            if byte not in b"\r\n":
                self._line.append(byte)
                continue
            line = self._line.decode("ascii", errors="replace").strip()
            self._line.clear()
            if re.fullmatch(r"(?:N\d+ )?M410(?:\*\d+)?", line):
                self.mechanics.stop_dead()
            if line:
                self._waiting.append(line)
        self._run_lines()

    def wait_for_button(self) -> None:
        """Finish the motions, and then wait until somebody presses the button."""
        self._waits_for_button = True

    def press_button(self) -> None:
        """Press the button that is waited for."""
        self._waits_for_button = False
        self._motion_ended()

    def kill(self, reason: str) -> None:
        """Halt until a restart, as after a failure of the hardware."""
        self.mechanics.stop_dead()
        self.say(f"Error:{reason}", "Error:Printer halted. kill() called!")
        self.alive = False

    def _booted(self) -> None:
        self.alive = True
        self.say("start", "echo:Marlin 2.1.2.4", "echo: Last Updated: 2024-06-01", "echo:EEPROM OK")
        self._watch_idle()

    def _ready(self) -> bool:
        return self.alive and self._awaited is None

    def _run_line(self, line: str) -> None:
        if (command := self._checked(line)) is not None:
            self._run(command)

    def _checked(self, line: str) -> str | None:
        """Return the command in a line, or None after asking for the line again."""
        match = re.fullmatch(r"N(\d+) (.*)\*(\d+)", line)
        if not line.startswith("N"):
            return line
        if not match:
            self._ask_again("No Checksum with line number")
            return None
        if reduce(xor, line.rpartition("*")[0].encode("ascii", errors="replace")) != int(match[3]):
            self._ask_again("checksum mismatch")
            return None
        number, command = int(match[1]), match[2]
        if command.startswith("M110"):
            self._last_line = int(parse_parameters(command).get("N", number))
            return command
        if number != self._last_line + 1:
            self._ask_again("Line Number is not Last Line Number+1")
            return None
        self._last_line = number
        return command

    def _ask_again(self, why: str) -> None:
        self._waiting.clear()
        self.say(f"Error:{why}, Last Line: {self._last_line}", f"Resend: {self._last_line + 1}", "ok")

    def _run(self, command: str) -> None:
        name = command.split(" ", 1)[0]
        parameters = parse_parameters(command[len(name) :])
        actions: dict[str, Callable[[], None]] = {
            "G28": lambda: self._home([i for i in (0, 1) if "XY"[i] in command[3:]] or [0, 1]),
            "M400": lambda: self._await(lambda: not self.mechanics.moving and not self._waits_for_button),
            "G0": lambda: self._move(parameters),
            "G1": lambda: self._move(parameters),
            "G90": lambda: setattr(self, "_relative", False),
            "G91": lambda: setattr(self, "_relative", True),
            "M42": lambda: self._switch("pin", parameters, parameters.get("S", 255.0)),
            "M106": lambda: self._switch("fan", parameters, parameters.get("S", 255.0)),
            "M107": lambda: self._switch("fan", parameters, 0.0),
            "M84": lambda: self._release_after(parameters.get("S")),
            "M114": lambda: self._tell_position(real="R" in command),
            "M115": self._tell_capabilities,
            "M118": lambda: self.say(command[5:]),
            "M119": self._tell_switches,
            "M211": self._tell_limits,
            "M503": self._tell_settings,
        }
        if name in actions:
            actions[name]()
        elif name not in ("G21", "M110", "M410"):
            self.say(f'echo:Unknown command: "{command}"')
        if name not in ("G28", "M400"):
            self.say("ok")

    def _move(self, parameters: dict[str, float]) -> None:
        start = self.mechanics.planned_mm()
        target = []
        for i, axis in enumerate("XY"):
            value = parameters[axis] + (start[i] if self._relative else 0.0) if axis in parameters else start[i]
            target.append(min(max(value, 0.0), self.travel_mm[i]) if self.homed[i] else value)
        speed = min(parameters.get("F", 6000.0) / 60.0, along([self.settings["M203"]] * 2, start, target))
        acceleration = min(self.settings["M204"], along([self.settings["M201"]] * 2, start, target))
        self.mechanics.queue(target, speed, acceleration)
        self._watch_idle()

    def _switch(self, kind: str, parameters: dict[str, float], level: float) -> None:
        name = f"{kind} {parameters.get('P', 0.0):.0f}"
        self.outputs = self.outputs | {name} if level else self.outputs - {name}

    def _home(self, axes: Sequence[int]) -> None:
        reach_mm = 1.5 * max(self.travel_mm)
        distances_mm = self._distances_to_switches(axes, reach_mm)
        seconds = 0.0
        for distance_mm in distances_mm:
            seconds += (min(distance_mm, reach_mm) + _BUMP_MM) / _SEEK_MM_PER_S + 2.0 * _BUMP_MM / _SEEK_MM_PER_S
        self._awaited = lambda: False
        fail = (lambda: self.kill("Homing Failed")) if math.inf in distances_mm else None
        self._start_homing(axes, 0.0, seconds, fail)
        self._say_busy()

    def _homed(self, axes: Iterable[int]) -> None:
        for axis in axes:
            self.homed[axis] = True
        self._awaited = None
        self._watch_idle()

    def _await(self, done: Callable[[], bool]) -> None:
        if done():
            self.say("ok")
        else:
            self._awaited = done
            self._say_busy()

    def _say_busy(self) -> None:
        def again() -> None:
            if self._awaited is not None and self.alive:
                self.say(f"echo:busy: {'paused for user' if self._waits_for_button else 'processing'}")
                self._say_busy()

        self.clock.after(_BUSY_EVERY_S, again)

    def _motion_ended(self) -> None:
        self._watch_idle()
        if self._awaited is not None and self._awaited():
            self._awaited = None
            self.say("ok")
        self._run_lines()

    def _release_after(self, seconds: float | None) -> None:
        """Set the idle time until the motors are released: 0 means never, None at once."""
        if seconds is None:
            self.release_motors()
        else:
            self._idle_limit_s = seconds
            self._watch_idle()

    def _watch_idle(self) -> None:
        if self._motors_off is not None:
            self._motors_off.cancel()
            self._motors_off = None
        if self._idle_limit_s and not self.mechanics.moving:
            self._motors_off = self.clock.after(self._idle_limit_s, self.release_motors)

    def release_motors(self) -> None:
        """Release the motors: the carriages sag by a millimetre, which is not counted."""
        self.homed = [False, False]
        for axis in self.mechanics.axes:
            axis.slip_mm += 1.0

    def _tell_position(self, *, real: bool) -> None:
        x, y = self.mechanics.commanded_mm() if real and self._realtime_position else self.mechanics.planned_mm()
        counts = [round(value * self.settings["M92"]) for value in self.mechanics.commanded_mm()]
        self.say(f"X:{x:.2f} Y:{y:.2f} Z:0.00 E:0.00 Count X:{counts[0]} Y:{counts[1]} Z:0")

    def _tell_capabilities(self) -> None:
        x, y = self.travel_mm
        bounds = f"{{min:{{x:0,y:0,z:0}},max:{{x:{x:g},y:{y:g},z:100}}}}"
        self.say(
            "FIRMWARE_NAME:Marlin 2.1.2.4 (Jun  1 2024 12:00:00) SOURCE_CODE_URL:github.com/MarlinFirmware/Marlin "
            "PROTOCOL_VERSION:1.0 MACHINE_TYPE:Gantry EXTRUDER_COUNT:0",
            *("Cap:EEPROM:1", "Cap:EMERGENCY_PARSER:1", "Cap:AUTOREPORT_POS:0"),
            f"area:{{full:{bounds},work:{bounds}}}",
        )

    def _tell_switches(self) -> None:
        self.say("Reporting endstop status")
        for axis, closed in zip("xy", self.mechanics.switches(), strict=True):
            self.say(f"{axis}_min: {'TRIGGERED' if closed else 'open'}")

    def _tell_limits(self) -> None:
        x, y = self.travel_mm
        self.say(f"echo:Soft endstops: On  Min:  X0.00 Y0.00 Z0.00   Max:  X{x:.2f} Y{y:.2f} Z100.00")

    def _tell_settings(self) -> None:
        s = self.settings
        self.say("echo:; Steps per unit:")
        self.say(f"echo: M92 X{s['M92']:.2f} Y{s['M92']:.2f} Z400.00")
        self.say(f"echo: M203 X{s['M203']:.2f} Y{s['M203']:.2f} Z5.00")
        self.say(f"echo: M201 X{s['M201']:.2f} Y{s['M201']:.2f} Z100.00")
        self.say(f"echo: M204 P{s['M204']:.2f} R{s['M204']:.2f} T{s['M204']:.2f}")
