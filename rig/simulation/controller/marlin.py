"""A simulated Marlin 2.1 controller, faithful where a driver could be caught out.

Among what it does like the real one: numbered lines with checksums, asked for again with an `ok` that acknowledges
nothing; targets outside the travel are silently clipped; M114 tells where the stage was sent, M114 R where it is; an
emergency stop drops motion without slowing down; motors let go after two idle minutes unless told otherwise; and a
controller that was killed says nothing more until it is restarted.
"""

import re
from collections import deque
from collections.abc import Callable
from functools import reduce
from operator import xor

from faintfield.rig.simulation.controller.clock import Event, SimulatedClock
from faintfield.rig.simulation.controller.kinematics import Axis, Mechanics, along
from faintfield.rig.simulation.controller.wire import Wire
from faintfield.rig.stages.settings import ProtocolName

_PLANNER_BLOCKS = 16
_BUSY_EVERY_S = 2.0
_WORD = re.compile(r"([A-Z])(-?\d+(?:\.\d+)?)")
_BUMP_MM = 5.0


class SimulatedMarlin:
    """The firmware, its settings memory and the mechanics it drives.

    Parameters
    ----------
    clock : SimulatedClock
        The world's time.
    wire : Wire
        Where it talks.
    travel_mm : (float, float)
        Lengths of the axes; coordinates run from zero, where the switches are, upwards.
    boot_s : float
        Time from a restart to the first word.
    play_mm : float
        Play in both drives.
    realtime_position : bool
        Whether M114 R tells the real position.
    """

    protocol: ProtocolName = "marlin"

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
        self.clock = clock
        self.wire = wire
        self.travel_mm = travel_mm
        self.boot_s = boot_s
        self.homing_slowdown = 1.0
        self.settings = {"M92": 80.0, "M203": 100.0, "M201": 500.0, "M204": 500.0}
        self.seek_mm_per_s = 25.0
        self._realtime_position = realtime_position
        axes = [Axis(-2.0, length + 5.0, 0.5 * length, play_mm) for length in travel_mm]
        self.mechanics = Mechanics(
            clock, (axes[0], axes[1]), 1.0 / self.settings["M92"], (0.0, 0.0), switch_at_high_end=False
        )
        self.mechanics.on_idle = self._motion_ended
        self._boot: Event | None = None
        self._pause: Event | None = None
        self._motors_off: Event | None = None
        self.restart()

    def restart(self) -> None:
        """Start anew, as after power-up: the count is lost, the settings stay."""
        self.mechanics.stop_dead()
        self.mechanics.set_count((0.0, 0.0))
        self.wire.clear()
        for event in (self._boot, self._pause, self._motors_off):
            if event is not None:
                event.cancel()
        self.alive, self.homed, self._idle_limit_s = False, [False, False], 120.0
        self._relative, self._last_line = False, 0
        self._line, self._waiting = bytearray(), deque[str]()
        self._awaited: Callable[[], bool] | None = None
        self._boot = self.clock.after(self.boot_s, self._booted)

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

    def say(self, text: str) -> None:
        """Send one line."""
        self.wire.to_host(text.encode("ascii", errors="replace") + b"\n")

    def kill(self, reason: str) -> None:
        """Stop for good, as after a failure of the hardware."""
        self.mechanics.stop_dead()
        self.say(f"Error:{reason}")
        self.say("Error:Printer halted. kill() called!")
        self.alive = False

    def _booted(self) -> None:
        """Finish starting."""
        self.alive = True
        for text in ("start", "echo:Marlin 2.1.2.4", "echo: Last Updated: 2024-06-01", "echo:EEPROM OK"):
            self.say(text)
        self._watch_idle()

    def _run_lines(self) -> None:
        """Run lines as long as there are some and nothing is waited for."""
        while self._waiting and self.alive and self._awaited is None:
            if self.mechanics.queued() >= _PLANNER_BLOCKS:
                return
            line = self._waiting.popleft()
            command = self._checked(line)
            if command is not None:
                self._run(command)

    def _checked(self, line: str) -> str | None:
        """Return the command in a line, None if it has to be sent again."""
        found = re.fullmatch(r"N(\d+) (.*)\*(\d+)", line)
        if not found:
            if not line.startswith("N"):
                return line
            self._ask_again("No Checksum with line number")
            return None
        if reduce(xor, line.rpartition("*")[0].encode("ascii", errors="replace")) != int(found[3]):
            self._ask_again("checksum mismatch")
            return None
        number, command = int(found[1]), found[2]
        if command.startswith("M110"):
            self._last_line = int(dict(_WORD.findall(command)).get("N", number))
            return command
        if number != self._last_line + 1:
            self._ask_again("Line Number is not Last Line Number+1")
            return None
        self._last_line = number
        return command

    def _ask_again(self, why: str) -> None:
        """Say that a line was not understood and which is wanted."""
        self._waiting.clear()
        self.say(f"Error:{why}, Last Line: {self._last_line}")
        self.say(f"Resend: {self._last_line + 1}")
        self.say("ok")

    def _run(self, command: str) -> None:
        """Run one command and answer it."""
        name = command.split(" ", 1)[0]
        words = {letter: float(value) for letter, value in _WORD.findall(command)[1:]}
        blocking: dict[str, Callable[[], None]] = {
            "G28": lambda: self._home([i for i in (0, 1) if "XY"[i] in command[3:]] or [0, 1]),
            "M400": lambda: self._await(lambda: not self.mechanics.moving),
        }
        if name in blocking:
            blocking[name]()
            return
        immediate: dict[str, Callable[[], None]] = {
            "G0": lambda: self._move(words),
            "G1": lambda: self._move(words),
            "G90": lambda: setattr(self, "_relative", False),
            "G91": lambda: setattr(self, "_relative", True),
            "M84": lambda: self._release_after(words.get("S")),
            "M114": lambda: self._tell_position(real="R" in command),
            "M115": self._tell_capabilities,
            "M118": lambda: self.say(command[5:]),
            "M119": self._tell_switches,
            "M211": self._tell_limits,
            "M503": self._tell_settings,
        }
        if name in immediate:
            immediate[name]()
        elif name not in ("G21", "M110", "M410"):
            self.say(f'echo:Unknown command: "{command}"')
        self.say("ok")

    def _move(self, words: dict[str, float]) -> None:
        """Plan a straight motion, clipped to the travel of homed axes."""
        start = self.mechanics.planned_mm()
        target = []
        for i, axis in enumerate("XY"):
            value = start[i] if axis not in words else words[axis] + (start[i] if self._relative else 0.0)
            target.append(min(max(value, 0.0), self.travel_mm[i]) if self.homed[i] else value)
        speed = min(words.get("F", 6000.0) / 60.0, along([self.settings["M203"]] * 2, start, target))
        acceleration = min(self.settings["M204"], along([self.settings["M201"]] * 2, start, target))
        self.mechanics.queue(target, speed, acceleration)
        self._watch_idle()

    def _home(self, axes: list[int]) -> None:
        """Begin homing, one axis after the other: seek, back off, seek slowly."""
        seconds = 0.0
        distances = self.mechanics.homing_distances_mm()
        lost = False
        for axis in axes:
            stuck = self.mechanics.axes[axis].stuck
            lost = lost or stuck
            distance = 1.5 * self.travel_mm[axis] if stuck else distances[axis]
            seconds += (distance + _BUMP_MM) / self.seek_mm_per_s + 2.0 * _BUMP_MM / self.seek_mm_per_s
        self._awaited = lambda: False
        finish = (lambda: self.kill("Homing Failed")) if lost else (lambda: self._homed(axes))
        self._pause = self.clock.after(self.homing_slowdown * seconds, finish)
        self._say_busy()

    def _homed(self, axes: list[int]) -> None:
        """End homing: the axes stand at their switches, counted as zero."""
        for axis in axes:
            self.mechanics.set_homed(axis, 0.0, 0.0)
            self.homed[axis] = True
        self._awaited = None
        self.say("ok")
        self._watch_idle()
        self._run_lines()

    def _await(self, done: Callable[[], bool]) -> None:
        """Answer when something is done, saying meanwhile that it is not."""
        if done():
            self.say("ok")
            return
        self._awaited = done
        self._say_busy()

    def _say_busy(self) -> None:
        """Say every two seconds that a command is at work."""

        def again() -> None:
            if self._awaited is not None and self.alive:
                self.say("echo:busy: processing")
                self._say_busy()

        self.clock.after(_BUSY_EVERY_S, again)

    def _motion_ended(self) -> None:
        """Note that nothing moves any more."""
        self._watch_idle()
        if self._awaited is not None and self._awaited():
            self._awaited = None
            self.say("ok")
        self._run_lines()

    def _release_after(self, seconds: float | None) -> None:
        """Set after how long motors let go; 0 is never, none is now."""
        if seconds is None:
            self.release_motors()
            return
        self._idle_limit_s = seconds
        self._watch_idle()

    def _watch_idle(self) -> None:
        """Let the motors go when nothing moves for the limit."""
        if self._motors_off is not None:
            self._motors_off.cancel()
            self._motors_off = None
        if self._idle_limit_s and not self.mechanics.moving:
            self._motors_off = self.clock.after(self._idle_limit_s, self.release_motors)

    def release_motors(self) -> None:
        """Let the motors go: the carriages sag by a millimetre, and nobody counts it."""
        self.homed = [False, False]
        for axis in self.mechanics.axes:
            axis.slip_mm += 1.0

    def _tell_position(self, *, real: bool) -> None:
        """Answer M114."""
        told = self.mechanics.commanded_mm() if real and self._realtime_position else self.mechanics.planned_mm()
        x, y = told
        counts = [round(value * self.settings["M92"]) for value in self.mechanics.commanded_mm()]
        self.say(f"X:{x:.2f} Y:{y:.2f} Z:0.00 E:0.00 Count X:{counts[0]} Y:{counts[1]} Z:0")

    def _tell_capabilities(self) -> None:
        """Answer M115."""
        self.say(
            "FIRMWARE_NAME:Marlin 2.1.2.4 (Jun  1 2024 12:00:00) SOURCE_CODE_URL:github.com/MarlinFirmware/Marlin "
            "PROTOCOL_VERSION:1.0 MACHINE_TYPE:Gantry EXTRUDER_COUNT:0"
        )
        for capability in ("EEPROM:1", "EMERGENCY_PARSER:1", "AUTOREPORT_POS:0"):
            self.say(f"Cap:{capability}")
        x, y = self.travel_mm
        bounds = f"{{min:{{x:0,y:0,z:0}},max:{{x:{x:g},y:{y:g},z:100}}}}"
        self.say(f"area:{{full:{bounds},work:{bounds}}}")

    def _tell_switches(self) -> None:
        """Answer M119."""
        self.say("Reporting endstop status")
        for axis, closed in zip("xy", self.mechanics.switches(), strict=True):
            self.say(f"{axis}_min: {'TRIGGERED' if closed else 'open'}")

    def _tell_limits(self) -> None:
        """Answer M211."""
        x, y = self.travel_mm
        self.say(f"echo:Soft endstops: On  Min:  X0.00 Y0.00 Z0.00   Max:  X{x:.2f} Y{y:.2f} Z100.00")

    def _tell_settings(self) -> None:
        """Answer M503."""
        s = self.settings
        self.say("echo:; Steps per unit:")
        self.say(f"echo: M92 X{s['M92']:.2f} Y{s['M92']:.2f} Z400.00")
        self.say(f"echo: M203 X{s['M203']:.2f} Y{s['M203']:.2f} Z5.00")
        self.say(f"echo: M201 X{s['M201']:.2f} Y{s['M201']:.2f} Z100.00")
        self.say(f"echo: M204 P{s['M204']:.2f} R{s['M204']:.2f} T{s['M204']:.2f}")
