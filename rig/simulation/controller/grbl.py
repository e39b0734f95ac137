"""A simulated GRBL 1.1h controller, faithful where a driver could be caught out.

Among what it does like the real one: an `ok` means parsed, not moved; `?` is ignored while homing and after a critical
alarm; a reset during motion loses the position (ALARM:3); after ALARM:1 and 2 everything but a reset is ignored, and a
reset that comes before the message asking for it is lost; a homing that fails still answers `ok` after its alarm; and
work positions come with their offset only now and then.
"""

import re
from collections import deque
from collections.abc import Callable

from faintfield.rig.simulation.controller.clock import Event, SimulatedClock
from faintfield.rig.simulation.controller.kinematics import Axis, Mechanics, along
from faintfield.rig.simulation.controller.wire import Wire
from faintfield.rig.stages.settings import ProtocolName

DEFAULT_SETTINGS = {
    0: "10", 1: "255", 2: "0", 3: "0", 4: "0", 5: "0", 6: "0", 10: "1", 11: "0.010", 12: "0.002", 13: "0",
    20: "1", 21: "1", 22: "1", 23: "0", 24: "100.000", 25: "1500.000", 26: "250", 27: "1.000", 30: "1000",
    31: "0", 32: "0", 100: "80.000", 101: "80.000", 102: "80.000", 110: "6000.000", 111: "6000.000",
    112: "500.000", 120: "500.000", 121: "500.000", 122: "10.000", 130: "400.000", 131: "400.000", 132: "100.000",
}  # fmt: skip

_JOG_WORD = re.compile(r"([A-Z])(-?\d+(?:\.\d+)?)")
_LINE_BYTES, _BUFFER_BYTES, _PLANNER_BLOCKS = 80, 128, 15
_OFFSET_EVERY_BUSY, _OFFSET_EVERY_IDLE = 30, 10


class SimulatedGrbl:
    """The firmware, its settings memory and the mechanics it drives.

    Parameters
    ----------
    clock : SimulatedClock
        The world's time.
    wire : Wire
        Where it talks.
    settings : dict
        `$` number to value, over the defaults; what is set stays through restarts.
    boot_s : float
        Time from a restart to the banner.
    play_mm : float
        Play in both drives.
    """

    protocol: ProtocolName = "grbl"

    def __init__(
        self,
        clock: SimulatedClock,
        wire: Wire,
        settings: dict[int, str] | None = None,
        *,
        boot_s: float = 1.0,
        play_mm: float = 0.0,
    ) -> None:
        self.clock = clock
        self.wire = wire
        self.settings = {**DEFAULT_SETTINGS, **(settings or {})}
        self.boot_s = boot_s
        self.homing_slowdown = 1.0
        self.work_offset = (0.0, 0.0, 0.0)
        travel = (self.number(130), self.number(131))
        axes = [Axis(-length - 5.0, 2.0, -0.5 * length, play_mm) for length in travel]
        self.mechanics = Mechanics(
            clock, (axes[0], axes[1]), 1.0 / self.number(100), (0.0, 0.0), switch_at_high_end=True
        )
        self.mechanics.set_count((0.0, 0.0))
        self.mechanics.on_idle = self._motion_ended
        self.mechanics.on_switch = self._switch_hit
        self._homing: Event | None = None
        self._boot: Event | None = None
        self._realtime: dict[int, Callable[[], None]] = {
            ord("?"): self._report,
            ord("!"): self._hold,
            ord("~"): self._resume,
            0x18: self._reset,
            0x84: self.open_door,
            0x85: self._cancel_jog,
        }
        self.restart()

    def restart(self) -> None:
        """Start anew, as after power-up: the count is lost, the settings stay."""
        self.mechanics.stop_dead()
        self.mechanics.set_count((0.0, 0.0))
        self.work_offset = (0.0, 0.0, 0.0)
        self.wire.clear()
        self._cancel_homing()
        self.state, self.critical, self._accepts_reset = "Boot", False, True
        self._line, self._waiting = bytearray(), deque[str]()
        self._reports_to_offset = 0
        if self._boot is not None:
            self._boot.cancel()
        self._boot = self.clock.after(self.boot_s, self._booted)

    def number(self, setting: int) -> float:
        """Return a setting's value."""
        return float(self.settings[setting])

    def receive(self, data: bytes) -> None:
        """Take bytes from the host; real-time characters act at once, wherever they stand."""
        for byte in data:
            if self.state == "Boot":
                continue
            if act := self._realtime.get(byte):
                act()
            elif not self.critical:
                self._take(byte)
        self._run_lines()

    def say(self, text: str) -> None:
        """Send one line."""
        self.wire.to_host(text.encode("ascii", errors="replace") + b"\r\n")

    def alarm(self, code: int) -> None:
        """Stop with an alarm, as its cause would make it."""
        homing = self.state == "Home"
        if self.mechanics.moving or homing:
            self.mechanics.stop_dead()
            self._cancel_homing()
        self.state = "Alarm"
        self._waiting.clear()
        self.say(f"ALARM:{code}")
        if code in (1, 2):
            self.critical, self._accepts_reset = True, False
            self.clock.after(0.05, self._ask_for_reset)
        elif homing:
            self.say("ok")  # the homing command's own, sent whatever came of it
            self._greet()

    def _booted(self) -> None:
        """Finish starting: locked, since homing is enabled."""
        self.state = "Alarm" if self.number(22) else "Idle"
        self._greet()

    def _greet(self) -> None:
        """Say hello, and that it is locked if it is."""
        self.say("Grbl 1.1h ['$' for help]")
        if self.state == "Alarm":
            self.say("[MSG:'$H'|'$X' to unlock]")

    def _ask_for_reset(self) -> None:
        """Begin to accept the reset that a critical alarm needs."""
        self.say("[MSG:Reset to continue]")
        self._accepts_reset = True

    def _reset(self) -> None:
        """Obey the reset character."""
        if not self._accepts_reset:
            return
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
        if in_motion or self.state in ("Alarm", "Sleep"):
            self.state = "Alarm"
        else:
            self.state = "Idle"
        self._greet()

    def _hold(self) -> None:
        """Obey the feed hold character: a jog is cancelled, other motion pauses."""
        if self.state == "Jog":
            self._cancel_jog()
        elif self.state == "Run":
            self.state = "Hold:1"
            self.mechanics.brake()

    def _cancel_jog(self) -> None:
        """Obey the jog-cancel character."""
        if self.state == "Jog":
            self.mechanics.brake()

    def open_door(self) -> None:
        """Open the safety door: motion slows down and everything waits."""
        self.state = "Door:2" if self.mechanics.moving else "Door:1"
        self.mechanics.brake()

    def pause(self) -> None:
        """Press the feed-hold button of the machine, which holds a jog as well."""
        self.state = "Hold:1" if self.mechanics.moving else "Hold:0"
        self.mechanics.brake()

    def _motion_ended(self) -> None:
        """Note that nothing moves any more."""
        self.state = {"Hold:1": "Hold:0", "Door:2": "Door:1"}.get(self.state, self.state)
        if self.state in ("Jog", "Run"):
            self.state = "Idle"
        self._run_lines()

    def _switch_hit(self) -> None:
        """Obey a limit switch in motion."""
        if self.number(21):
            self.alarm(1)

    def _take(self, byte: int) -> None:
        """Take one ordinary byte; what does not fit the receive buffer is lost."""
        if byte in b"\r\n":
            self._waiting.append(self._line.decode("ascii", errors="replace"))
            self._line.clear()
        elif len(self._line) + sum(map(len, self._waiting)) < _BUFFER_BYTES:
            self._line.append(byte)

    def _run_lines(self) -> None:
        """Run lines as long as there are some and there is room for their motions."""
        while self._waiting and not self.critical and self._homing is None:
            if self.mechanics.queued() > _PLANNER_BLOCKS:
                return
            line = self._waiting.popleft()
            if len(line) >= _LINE_BYTES:
                self.say("error:11")
            elif (error := self._run(line.replace(" ", "").upper())) is not None:
                self.say(f"error:{error}" if error else "ok")

    def _run(self, line: str) -> int | None:
        """Run one line and return its error, 0 for ok, None when the answer comes later."""
        if line == "":
            return 0
        if line.startswith("$J="):
            return self._jog(line[3:])
        if line.startswith("$"):
            return self._system(line)
        if self.state != "Idle" and self.state != "Run":
            return 9
        return self._gcode(line)

    def _system(self, line: str) -> int | None:
        """Run a `$` command."""
        if line == "$X":
            if self.state == "Alarm":
                self.say("[MSG:Caution: Unlocked]")
                self.state = "Idle"
            return 0
        if self.state not in ("Idle", "Alarm"):
            return 8
        if line == "$H":
            return self._home()
        if line == "$I":
            self.say("[VER:1.1h.20190830:]")
            self.say("[OPT:V,15,128]")
            return 0
        if line == "$$":
            for number, value in self.settings.items():
                self.say(f"${number}={value}")
            return 0
        if found := re.fullmatch(r"\$(\d+)=(\d+(?:\.\d+)?)", line):
            self.settings[int(found[1])] = found[2]
            return 0
        return 3

    def _jog(self, words: str) -> int:
        """Run a jog."""
        if self.state not in ("Idle", "Jog"):
            return 9
        parsed = dict(_axis_words(words))
        modes = re.findall(r"G\d+", words)
        allowed = parsed.keys() <= set("GXYZF") and set(modes) <= {"G20", "G21", "G90", "G91", "G53"}
        if not allowed or _JOG_WORD.sub("", words):
            return 16
        if "F" not in parsed:
            return 22
        target = self._target(parsed, relative="G91" in modes, machine="G53" in modes)
        if target is None:
            return 16
        if self.number(20) and not self._within_travel(target):
            return 15
        self._queue(target, parsed["F"])
        self.state = "Jog" if self.mechanics.moving else "Idle"
        return 0

    def _gcode(self, line: str) -> int:
        """Run the few lines of G-code that a stage may meet: G0, G1 and G92."""
        parsed = dict(_axis_words(line))
        if re.search(r"G92(?!\d)", line):
            here = self.mechanics.planned_mm()
            self.work_offset = (here[0] - parsed.get("X", 0.0), here[1] - parsed.get("Y", 0.0), 0.0)
            self._reports_to_offset = 0
            return 0
        if re.search(r"G[01](?!\d)", line):
            target = self._target(parsed, relative=False, machine="G53" in line)
            if target is None:
                return 26
            if self.number(20) and not self._within_travel(target):
                self.alarm(2)
                return 0
            self._queue(target, parsed.get("F", 6000.0))
            self.state = "Run" if self.mechanics.moving else "Idle"
            return 0
        return 20

    def _target(self, words: dict[str, float], *, relative: bool, machine: bool) -> tuple[float, float] | None:
        """Return the machine position that axis words ask for, None without any."""
        if not words.keys() & {"X", "Y"}:
            return None
        values = []
        for axis, here, offset in zip("XY", self.mechanics.planned_mm(), self.work_offset, strict=False):
            base = here if relative else 0.0 if machine else offset
            values.append(base + words[axis] if axis in words else here)
        return values[0], values[1]

    def _within_travel(self, target: tuple[float, float]) -> bool:
        """Return whether the soft limits allow `target`."""
        return all(-self.number(130 + i) <= value <= 0.0 for i, value in enumerate(target))

    def _queue(self, target: tuple[float, float], feed_mm_per_min: float) -> None:
        """Plan a straight motion at the feed asked for or what the axes allow."""
        start = self.mechanics.planned_mm()
        speed = min(feed_mm_per_min, along((self.number(110), self.number(111)), start, target)) / 60.0
        self.mechanics.queue(target, speed, along((self.number(120), self.number(121)), start, target))

    def _home(self) -> int | None:
        """Begin homing: both axes seek at once, back off, and find the switch again slowly."""
        if not self.number(22):
            return 5
        seek, locate = self.number(25) / 60.0, self.number(24) / 60.0
        distances = self.mechanics.homing_distances_mm()
        reach_mm = 1.5 * max(self.number(130), self.number(131))
        lost = any(axis.stuck for axis in self.mechanics.axes) or max(distances) > reach_mm
        pull_off = self.number(27)
        seconds = (reach_mm if lost else max(distances)) / seek + 2.0 * pull_off / seek + pull_off / locate
        self.state = "Home"
        finish = (lambda: self.alarm(9)) if lost else self._homed
        self._homing = self.clock.after(self.homing_slowdown * (seconds + 4.0 * self.number(26) / 1000.0), finish)
        return None

    def _homed(self) -> None:
        """End homing: pulled off the switches, and counted from them."""
        self._homing = None
        for axis in (0, 1):
            self.mechanics.set_homed(axis, -self.number(27), -self.number(27))
        self.state = "Idle"
        self.say("ok")
        self._run_lines()

    def _cancel_homing(self) -> None:
        """Break off homing."""
        if self._homing is not None:
            self._homing.cancel()
            self._homing = None

    def _report(self) -> None:
        """Answer a status request, unless now is a time when GRBL does not."""
        if self.critical or self.state == "Home":
            return
        machine = (*self.mechanics.commanded_mm(), 0.0)
        kind, values = "MPos", machine
        if not int(self.number(10)) & 1:
            kind, values = "WPos", tuple(m - o for m, o in zip(machine, self.work_offset, strict=True))
        fields = [self.state, f"{kind}:{_vector(values)}", "FS:0,0"]
        if pins := "".join(letter for letter, closed in zip("XY", self.mechanics.switches(), strict=True) if closed):
            fields.append(f"Pn:{pins}")
        if self._reports_to_offset == 0:
            fields.append(f"WCO:{_vector(self.work_offset)}")
            busy = self.state in ("Jog", "Run")
            self._reports_to_offset = _OFFSET_EVERY_BUSY if busy else _OFFSET_EVERY_IDLE
        self._reports_to_offset -= 1
        self.say(f"<{'|'.join(fields)}>")

    def _resume(self) -> None:
        """Obey the resume character: a held jog is not taken up again, a closed door is left."""
        if self.state in ("Hold:0", "Door:0"):
            self.state = "Idle"


def _axis_words(text: str) -> list[tuple[str, float]]:
    """Return the letters and numbers of a line."""
    return [(letter, float(value)) for letter, value in _JOG_WORD.findall(text)]


def _vector(values: tuple[float, ...]) -> str:
    """Return values as GRBL writes them."""
    return ",".join(f"{value:.3f}" for value in values)
