"""The `$` settings of the simulated GRBL, and what they mean for its motions and its jogs."""

import re
from collections.abc import Sequence

from faintfield.rig.simulation.controller.firmware import WORD, parse_parameters
from faintfield.rig.simulation.controller.kinematics import along

_DEFAULTS = {
    0: "10", 1: "255", 2: "0", 3: "0", 4: "0", 5: "0", 6: "0", 10: "1", 11: "0.010", 12: "0.002", 13: "0",
    20: "1", 21: "1", 22: "1", 23: "0", 24: "100.000", 25: "1500.000", 26: "250", 27: "1.000", 30: "1000",
    31: "0", 32: "0", 100: "80.000", 101: "80.000", 102: "80.000", 110: "6000.000", 111: "6000.000",
    112: "500.000", 120: "500.000", 121: "500.000", 122: "10.000", 130: "400.000", 131: "400.000", 132: "100.000",
}  # fmt: skip


class StoredSettings(dict[int, str]):
    """Values by `$` number, as text, which survive restarts: the defaults, except for `changes`."""

    def __init__(self, changes: dict[int, str]) -> None:
        super().__init__({**_DEFAULTS, **changes})

    def number(self, setting: int) -> float:
        """Return a setting as a number."""
        return float(self[setting])

    def travel_mm(self) -> tuple[float, float]:
        """Return the lengths of both axes."""
        return self.number(130), self.number(131)

    def allows(self, target: Sequence[float]) -> bool:
        """Return whether the soft limits, if enabled, allow a machine position."""
        margin = self.margin_mm()
        ways = zip(self.travel_mm(), target, strict=True)
        return all(margin - length <= value <= -margin for length, value in ways) or not self.number(20)

    def margin_mm(self) -> float:
        """Return how far from the ends of the travel the soft limits lie."""
        return 0.0

    def homes_singly(self) -> bool:
        """Return whether an axis can be homed by itself."""
        return False

    def speed_and_acceleration(
        self, start: Sequence[float], target: Sequence[float], feed_mm_per_min: float
    ) -> tuple[float, float]:
        """Return the requested speed, limited by the axes' rates, and their highest acceleration (mm, s)."""
        speed = min(feed_mm_per_min, along((self.number(110), self.number(111)), start, target)) / 60.0
        return speed, along((self.number(120), self.number(121)), start, target)

    def homing_s(self, distance_mm: float) -> float:
        """Return the time to seek a switch `distance_mm` away, back off, and find it again slowly."""
        seek, locate, pull_off = self.number(25) / 60.0, self.number(24) / 60.0, self.number(27)
        return distance_mm / seek + 2.0 * pull_off / seek + pull_off / locate + 4.0 * self.number(26) / 1000.0

    def answer(self, command: str) -> list[str] | None:
        """Return the lines that answer `$I`, `$$` or `$N=value`, which is stored; None for other commands."""
        if command == "$I":
            return ["[VER:1.1h.20190830:]", "[OPT:V,15,128]"]
        if command == "$$":
            return [f"${number}={value}" for number, value in self.items()]
        if match := re.fullmatch(r"\$(\d+)=(\d+(?:\.\d+)?)", command):
            self[int(match[1])] = match[2]
            return []
        return None


def jog_error(text: str) -> int:
    """Return the number of GRBL's error for what follows `$J=`, 0 if it is a jog."""
    parsed, modes = parse_parameters(text), set(re.findall(r"G\d+", text))
    if not parsed.keys() <= set("GXYZF") or not modes <= {"G20", "G21", "G90", "G91", "G53"} or WORD.sub("", text):
        return 16
    if "F" not in parsed:
        return 22
    return 0 if parsed.keys() & {"X", "Y"} else 16
