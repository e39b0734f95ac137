"""A simulated GRBL 1.1h controller, with the peculiarities that a driver must cope with.

As in the real one, an `ok` means parsed, not moved; `?` is ignored while homing and after a critical alarm; a reset
during motion loses the position (ALARM:3); after ALARM:1 and 2 everything but a reset is ignored, and so is a reset
before GRBL has asked for it; a failed homing still answers `ok`; and only some reports carry the work offset. Outputs
are reported with the overrides, in every tenth or twentieth report and after a change, but not together with the work
offset. Alarm, reset and door switch them off; the parser does not notice a door, and ignores a command to switch on
what it believes to be on.
"""

import math
import re
from collections.abc import Callable, Iterable, Sequence
from operator import sub
from typing import ClassVar

from faintfield.rig.simulation.controller.firmware import WORD, SimulatedFirmware, Wire, parse_parameters
from faintfield.rig.simulation.controller.kinematics import Axis, Mechanics, SimulatedClock, Vector, along

# Sizes in bytes of GRBL's line and receive buffer.
_LINE_BYTES, _BUFFER_BYTES = 80, 128

# The work offset is in every 30th report while moving, and in every 10th at rest.
_OFFSET_EVERY_BUSY, _OFFSET_EVERY_IDLE = 30, 10
# So are the overrides in every 20th, and in every 10th.
_OVERRIDES_EVERY_BUSY, _OVERRIDES_EVERY_IDLE = 20, 10
# Outputs and their letters in reports.
_OUTPUT_LETTERS = {"spindle": "S", "flood": "F", "mist": "M"}

_ALARM_DELAY_S = 0.05  # from a critical alarm until a reset is accepted

_RAPID_MM_PER_MIN = 6000.0  # of motion without a rate, and of motion that was held and goes on

DEFAULTS = {
    0: "10", 1: "255", 2: "0", 3: "0", 4: "0", 5: "0", 6: "0", 10: "1", 11: "0.010", 12: "0.002", 13: "0",
    20: "1", 21: "1", 22: "1", 23: "0", 24: "100.000", 25: "1500.000", 26: "250", 27: "1.000", 30: "1000",
    31: "0", 32: "0", 100: "80.000", 101: "80.000", 102: "80.000", 110: "6000.000", 111: "6000.000",
    112: "500.000", 120: "500.000", 121: "500.000", 122: "10.000", 130: "400.000", 131: "400.000", 132: "100.000",
}  # fmt: skip


class SimulatedGrbl(SimulatedFirmware):
    """Firmware, settings and mechanics of a GRBL stage.

    `settings` are the values that differ from the defaults, by `$` number; they survive restarts. Both drives have
    play. With `door_is_open` the safety door stays open; `open_door` alone is a door that is closed again at once.
    """

    door_is_open = False
    protocol = "grbl"
    _line_end = b"\r\n"
    _critical_alarms: ClassVar[tuple[int, ...]] = (1, 2)
    _defaults: ClassVar[dict[int, str]] = DEFAULTS

    def __init__(
        self,
        clock: SimulatedClock,
        wire: Wire,
        settings: dict[int, str] | None = None,
        *,
        boot_s: float = 1.0,
        play_mm: float = 0.0,
    ) -> None:
        self.settings = self._defaults | (settings or {})
        self._realtime: dict[int, Callable[[], None]] = {
            ord("?"): self._report,
            ord("!"): self._hold,
            ord("~"): self._resume,
            0x18: self._reset,
            0x84: self.open_door,
            0x85: self._cancel_jog,
            0xA0: lambda: self._toggle("flood"),
            0xA1: lambda: self._toggle("mist"),
        }
        x, y = (Axis(-length - 5.0, 2.0, -0.5 * length, play_mm) for length in self._travel_mm())
        mechanics = Mechanics(clock, (x, y), 1.0 / self._number(100), 1.0, on_switch=self._switch_hit)
        super().__init__(clock, wire, mechanics, boot_s)

    def _number(self, setting: int) -> float:
        return float(self.settings[setting])

    def _travel_mm(self) -> tuple[float, float]:
        return self._number(130), self._number(131)

    def _reset_state(self) -> None:
        self.work_offset, self._reports_to_offset = (0.0, 0.0, 0.0), 0
        self.state, self.critical, self._accepts_reset = "Boot", False, True
        self._held: list[Vector] = []
        self._parsed_outputs: frozenset[str] = frozenset()
        self._reports_to_overrides = 0

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

    def _deaf(self) -> bool:
        """Return whether GRBL hears nothing but a reset."""
        return self.critical

    def _ready(self) -> bool:
        return not self._deaf() and self._homing is None

    def alarm(self, code: int) -> None:
        """Stop with an alarm."""
        homing = self.state == "Home"
        if self.mechanics.moving or homing:
            self.mechanics.stop_dead()
            self._cancel_homing()
        self.state = "Alarm"
        self._reset_outputs()
        self._waiting.clear()
        self.say(f"ALARM:{code}")
        if code in self._critical_alarms:
            self.critical, self._accepts_reset = True, False
            self.clock.after(_ALARM_DELAY_S, self._ask_for_reset)
        elif homing:
            self.say("ok")  # the answer to the homing command, sent although it failed
            self._greet()

    def _booted(self) -> None:
        self.state = "Alarm" if self._number(22) else "Idle"
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
        self._reset_outputs()
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
        self._set_outputs(frozenset())
        self.say("[MSG:Check Door]")
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
        if self._number(21):
            self.alarm(1)

    def _report(self) -> None:
        if self._deaf() or self.state == "Home":
            return
        tell_offset = self._reports_to_offset == 0
        busy = self.state in ("Jog", "Run")
        if tell_offset:
            self._reports_to_offset = _OFFSET_EVERY_BUSY if busy else _OFFSET_EVERY_IDLE
        self._reports_to_offset -= 1
        here = (*self.mechanics.commanded_mm(), 0.0)
        is_machine = int(self._number(10)) & 1 == 1
        values = here if is_machine else tuple(map(sub, here, self.work_offset))
        fields = [self._reported_state(), f"{'MPos' if is_machine else 'WPos'}:{_vector(values)}", "FS:0,0"]
        if pins := self._pins():
            fields.append(f"Pn:{pins}")
        if tell_offset:
            fields.append(f"WCO:{_vector(self.work_offset)}")
        fields += self._output_fields(due=not tell_offset, busy=busy)
        self.say(f"<{'|'.join(fields)}>")

    def _output_fields(self, *, due: bool, busy: bool) -> list[str]:
        """Return the fields of overrides and outputs, if it is their turn and they are `due`."""
        if not due or self._reports_to_overrides > 0:
            self._reports_to_overrides = max(0, self._reports_to_overrides - 1)
            return []
        self._reports_to_overrides = (_OVERRIDES_EVERY_BUSY if busy else _OVERRIDES_EVERY_IDLE) - 1
        return ["Ov:100,100,100", *([self._output_field()] if self.outputs else [])]

    def _output_field(self) -> str:
        return "A:" + "".join(letter for output, letter in _OUTPUT_LETTERS.items() if output in self.outputs)

    def _set_outputs(self, outputs: frozenset[str]) -> None:
        """Set the outputs, which the next report tells."""
        self.outputs = outputs
        self._reports_to_overrides = 0

    def _reset_outputs(self) -> None:
        self._parsed_outputs = frozenset()
        self._set_outputs(self._parsed_outputs)

    def _toggle(self, output: str) -> None:
        """Switch a coolant as its override does, which a button of the machine may send."""
        if self.state in ("Idle", "Run"):
            self._parsed_outputs ^= {output}
            self._set_outputs(self._parsed_outputs)

    def _reported_state(self) -> str:
        return self.state

    def _pins(self) -> str:
        pins = "".join(axis for axis, closed in zip("XY", self.mechanics.switches(), strict=True) if closed)
        return pins + "D" * self.door_is_open

    def _resume(self) -> None:
        if self.state in ("Hold:0", "Door:0"):
            self.state = "Idle"
            self._set_outputs(self._parsed_outputs)
            held, self._held = self._held, []
            for target in held:
                self._queue(target, _RAPID_MM_PER_MIN, "Run")

    def _take(self, byte: int) -> None:
        if byte in b"\r\n":
            self._waiting.append(self._line.decode("ascii", errors="replace"))
            self._line.clear()
        elif len(self._line) + sum(map(len, self._waiting)) < _BUFFER_BYTES:
            self._line.append(byte)

    def _run_line(self, line: str) -> None:
        error = 11 if len(line) >= _LINE_BYTES else self._run(line.replace(" ", "").upper())
        if error is not None:
            self.say(f"error:{error}" if error else "ok")

    def _run(self, line: str) -> int | None:
        """Run one line; return its error, 0 for ok, or None if the answer comes later."""
        if line == "":
            return 0
        if line.startswith("$"):
            return self._jog(line[3:]) if line.startswith("$J=") else self._system(line)
        if self.state not in ("Idle", "Run"):
            return 9
        return self._gcode(line)

    def _system(self, line: str) -> int | None:
        if line == "$X":
            if self.state == "Alarm":
                self.say("[MSG:Caution: Unlocked]")
                self.state = "Idle"
            return 0
        if self.state not in ("Idle", "Alarm"):
            return 8
        if match := re.fullmatch(r"\$H([XY]?)", line):
            if match[1] and not self._homes_singly():
                return 3
            return self._home(["XY".index(match[1])] if match[1] else [0, 1])
        if line == "$I":
            self.say(*self._build_info())
        elif line == "$$":
            self.say(*(f"${number}={value}" for number, value in self.settings.items()))
        elif match := re.fullmatch(r"\$(\d+)=(\d+(?:\.\d+)?)", line):
            self.settings[int(match[1])] = match[2]
        else:
            return 3
        return 0

    def _build_info(self) -> tuple[str, ...]:
        return ("[VER:1.1h.20190830:]", "[OPT:V,15,128]")

    def _homes_singly(self) -> bool:
        return False

    def _margin_mm(self) -> float:
        """Return how far from the ends of the travel the soft limits lie."""
        return 0.0

    def _allows(self, target: Sequence[float]) -> bool:
        """Return whether the soft limits, if enabled, allow a machine position."""
        margin_mm = self._margin_mm()
        ways = zip(self._travel_mm(), target, strict=True)
        return all(margin_mm - length <= value <= -margin_mm for length, value in ways) or not self._number(20)

    def _jog(self, text: str) -> int:
        if self.state not in ("Idle", "Jog"):
            return 9
        parsed, modes = parse_parameters(text), set(re.findall(r"G\d+", text))
        if not parsed.keys() <= set("GXYZF") or not modes <= {"G20", "G21", "G90", "G91", "G53"} or WORD.sub("", text):
            return 16
        if "F" not in parsed:
            return 22
        if not parsed.keys() & {"X", "Y"}:
            return 16
        target = self._target(parsed, relative="G91" in text, machine="G53" in text)
        if not self._allows(target):
            return 15
        self._queue(target, parsed["F"], "Jog")
        return 0

    def _gcode(self, line: str) -> int:
        parsed = parse_parameters(line)
        if re.search(r"G92(?!\d)", line):
            here = self.mechanics.planned_mm()
            self.work_offset = (here[0] - parsed.get("X", 0.0), here[1] - parsed.get("Y", 0.0), 0.0)
            self._reports_to_offset = 0
            return 0
        if match := re.fullmatch(r"M(3S\d+(?:\.\d+)?|[5789])", line):
            self._switch(match[1])
            return 0
        if not re.search(r"G[01](?!\d)", line):
            return 20
        if not parsed.keys() & {"X", "Y"}:
            return 26
        target = self._target(parsed, relative=False, machine="G53" in line)
        if not self._allows(target):
            self.alarm(2)
        else:
            self._queue(target, parsed.get("F", _RAPID_MM_PER_MIN), "Run")
        return 0

    def _switch(self, code: str) -> None:
        ended = {"5": {"spindle"}, "9": {"flood", "mist"}}
        begun = {"7": {"mist"}, "8": {"flood"}}.get(code, {"spindle"} if code[0] == "3" else set())
        parsed = (self._parsed_outputs | begun) - ended.get(code, set())
        if parsed != self._parsed_outputs:
            self._parsed_outputs = parsed
            self._set_outputs(parsed)

    def _target(self, axis_words: dict[str, float], *, relative: bool, machine: bool) -> tuple[float, float]:
        here = self.mechanics.planned_mm()
        base = here if relative else (0.0, 0.0) if machine else self.work_offset
        x, y = (base[i] + axis_words[axis] if axis in axis_words else here[i] for i, axis in enumerate("XY"))
        return x, y

    def _queue(self, target: Vector, feed_mm_per_min: float, state: str) -> None:
        start = self.mechanics.planned_mm()
        speed = min(feed_mm_per_min, along((self._number(110), self._number(111)), start, target)) / 60.0
        self.mechanics.queue(target, speed, along((self._number(120), self._number(121)), start, target))
        self.state = state if self.mechanics.moving else "Idle"

    def _home(self, axes: Sequence[int]) -> int | None:
        """Start homing: the axes seek at once, back off, and find the switch again slowly."""
        if not self._number(22):
            return 5
        reach_mm = 1.5 * max(self._travel_mm())
        farthest_mm = max(self._distances_to_switches(axes, reach_mm))
        seek, locate, pull_off = self._number(25) / 60.0, self._number(24) / 60.0, self._number(27)
        seek_s = min(farthest_mm, reach_mm) / seek + 2.0 * pull_off / seek
        duration_s = seek_s + pull_off / locate + 4.0 * self._number(26) / 1000.0
        self.state = "Home"
        fail = (lambda: self.alarm(9)) if farthest_mm == math.inf else None
        self._start_homing(axes, -pull_off, duration_s, fail)
        return None

    def _homed(self, axes: Iterable[int]) -> None:
        self.state = "Idle"


def _vector(values: Sequence[float]) -> str:
    return ",".join(f"{value:.3f}" for value in values)
