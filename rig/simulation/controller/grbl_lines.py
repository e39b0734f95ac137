"""The lines of the simulated GRBL: the jogs that it accepts and the reports that it sends."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from faintfield.rig.simulation.controller.gcode import WORD, words

_JOG_LETTERS = set("GXYZF")
_JOG_MODES = {"G20", "G21", "G90", "G91", "G53"}
_BAD_JOG, _NO_FEED = 16, 22


@dataclass(frozen=True)
class JogCommand:
    """A jog: its words, and how they give the target."""

    words: dict[str, float]
    relative: bool
    machine: bool


def parse_jog(text: str) -> JogCommand | int:
    """Return what follows `$J=` as a jog, or the number of GRBL's error."""
    parsed = words(text)
    modes = set(re.findall(r"G\d+", text))
    if not parsed.keys() <= _JOG_LETTERS or not modes <= _JOG_MODES or WORD.sub("", text):
        return _BAD_JOG
    if "F" not in parsed:
        return _NO_FEED
    return (
        JogCommand(parsed, relative="G91" in modes, machine="G53" in modes) if parsed.keys() & {"X", "Y"} else _BAD_JOG
    )


def status_report(
    state: str,
    machine_mm: Sequence[float],
    offset_mm: Sequence[float],
    switches: Sequence[bool],
    is_machine: bool,
    with_offset: bool,
) -> str:
    """Return a status report with machine or work position, and the work offset if asked for."""
    values = machine_mm if is_machine else [m - o for m, o in zip(machine_mm, offset_mm, strict=True)]
    fields = [state, f"{'MPos' if is_machine else 'WPos'}:{_vector(values)}", "FS:0,0"]
    if pins := "".join(letter for letter, closed in zip("XY", switches, strict=True) if closed):
        fields.append(f"Pn:{pins}")
    if with_offset:
        fields.append(f"WCO:{_vector(offset_mm)}")
    return f"<{'|'.join(fields)}>"


def _vector(values: Sequence[float]) -> str:
    """Return numbers as GRBL prints them."""
    return ",".join(f"{value:.3f}" for value in values)
