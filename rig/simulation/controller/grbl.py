"""A simulated GRBL 1.1h controller, with the peculiarities that a driver must cope with.

As in the real one, an `ok` means parsed, not moved; `?` is ignored while homing and after a critical alarm; a reset
during motion loses the position (ALARM:3); after ALARM:1 and 2 everything but a reset is ignored, and so is a reset
before GRBL has asked for it; a failed homing still answers `ok`; and only some reports carry the work offset.
"""

import re
from collections.abc import Sequence

from faintfield.rig.simulation.controller.firmware import words
from faintfield.rig.simulation.controller.grbl_settings import StoredSettings, jog_error
from faintfield.rig.simulation.controller.grbl_states import GrblStates
from faintfield.rig.simulation.controller.kinematics import Axis, Mechanics, Vector
from faintfield.rig.simulation.controller.wire import SimulatedClock, Wire

# Sizes of GRBL's line (bytes), receive buffer (bytes) and planner (motions).
_LINE_BYTES, _BUFFER_BYTES, _PLANNER_BLOCKS = 80, 128, 15


class SimulatedGrbl(GrblStates):
    """Firmware, settings and mechanics of a GRBL stage.

    Parameters
    ----------
    clock : SimulatedClock
        The simulated time.
    wire : Wire
        The serial line to the host.
    settings : dict
        Values that differ from the defaults, by `$` number; settings survive restarts.
    boot_s : float
        Time from a restart to the banner.
    play_mm : float
        Play in both drives.
    """

    def __init__(
        self,
        clock: SimulatedClock,
        wire: Wire,
        settings: dict[int, str] | None = None,
        *,
        boot_s: float = 1.0,
        play_mm: float = 0.0,
    ) -> None:
        stored = self._stored(settings or {})
        x, y = (Axis(-length - 5.0, 2.0, -0.5 * length, play_mm) for length in stored.travel_mm())
        mechanics = Mechanics(clock, (x, y), 1.0 / stored.number(100), (0.0, 0.0), switch_at_high_end=True)
        super().__init__(clock, wire, mechanics, boot_s, stored)

    @staticmethod
    def _stored(changes: dict[int, str]) -> StoredSettings:
        return StoredSettings(changes)

    def _take(self, byte: int) -> None:
        if byte in b"\r\n":
            self._waiting.append(self._line.decode("ascii", errors="replace"))
            self._line.clear()
        elif len(self._line) + sum(map(len, self._waiting)) < _BUFFER_BYTES:
            self._line.append(byte)

    def _run_lines(self) -> None:
        while self._waiting and not self._deaf() and self._homing is None:
            if self.mechanics.queued() > _PLANNER_BLOCKS:
                return
            line = self._waiting.popleft()
            if len(line) >= _LINE_BYTES:
                self.say("error:11")
            elif (error := self._run(line.replace(" ", "").upper())) is not None:
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
        if found := re.fullmatch(r"\$H([XY]?)", line):
            if found[1] and not self.settings.homes_singly():
                return 3
            return self._home(["XY".index(found[1])] if found[1] else [0, 1])
        answer = self.settings.answer(line)
        if answer is None:
            return 3
        self.say(*answer)
        return 0

    def _jog(self, text: str) -> int:
        if self.state not in ("Idle", "Jog"):
            return 9
        if error := jog_error(text):
            return error
        parsed = words(text)
        target = self._target(parsed, relative="G91" in text, machine="G53" in text)
        if not self.settings.allows(target):
            return 15
        self._queue(target, parsed["F"], "Jog")
        return 0

    def _gcode(self, line: str) -> int:
        parsed = words(line)
        if re.search(r"G92(?!\d)", line):
            here = self.mechanics.planned_mm()
            self.work_offset = (here[0] - parsed.get("X", 0.0), here[1] - parsed.get("Y", 0.0), 0.0)
            self._reports_to_offset = 0
            return 0
        if not re.search(r"G[01](?!\d)", line):
            return 20
        if not parsed.keys() & {"X", "Y"}:
            return 26
        target = self._target(parsed, relative=False, machine="G53" in line)
        if not self.settings.allows(target):
            self.alarm(2)
        else:
            self._queue(target, parsed.get("F", 6000.0), "Run")
        return 0

    def _target(self, axis_words: dict[str, float], *, relative: bool, machine: bool) -> tuple[float, float]:
        values = []
        for axis, here, offset in zip("XY", self.mechanics.planned_mm(), self.work_offset, strict=False):
            base = here if relative else 0.0 if machine else offset
            values.append(base + axis_words[axis] if axis in axis_words else here)
        return values[0], values[1]

    def _queue(self, target: Vector, feed_mm_per_min: float, state: str) -> None:
        start = self.mechanics.planned_mm()
        self.mechanics.queue(target, *self.settings.speed_and_acceleration(start, target, feed_mm_per_min))
        self.state = state if self.mechanics.moving else "Idle"

    def _home(self, axes: Sequence[int]) -> int | None:
        """Start homing: the axes seek at once, back off, and find the switch again slowly."""
        if not self.settings.number(22):
            return 5
        distances_mm = self.mechanics.homing_distances_mm()
        farthest_mm = max(distances_mm[axis] for axis in axes)
        reach_mm = 1.5 * max(self.settings.travel_mm())
        lost = any(self.mechanics.axes[axis].stuck for axis in axes) or farthest_mm > reach_mm
        self.state = "Home"
        duration_s = self.settings.homing_s(reach_mm if lost else farthest_mm)
        self._start_homing(duration_s, (lambda: self.alarm(9)) if lost else (lambda: self._homed(axes)))
        return None

    def _homed(self, axes: Sequence[int]) -> None:
        for axis in axes:
            self.mechanics.set_homed(axis, -self.settings.number(27), -self.settings.number(27))
        self.state = "Idle"
        self.say("ok")
        self._run_lines()
