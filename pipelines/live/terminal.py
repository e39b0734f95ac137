"""Show a capture in the terminal: prompts, keys, a status line, and the last frame as a picture."""

import os
import re
import select
import sys
import textwrap
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.live import Live
from rich.text import Text

from faintfield.pipelines.console import console, inform, visible
from faintfield.pipelines.live.light_meter import LightMeter, LightReading
from faintfield.pipelines.live.panel import CapturePanel, SessionFrames, sampled
from faintfield.pipelines.live.view import KEYS, button_label, check_rows, describe_scale, step_rows
from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.capture.guide import Answer, OperatorRequest, Prompt, ShownFrame, Status, format_duration

with suppress(ModuleNotFoundError):  # on Windows
    import termios
    import tty

# Widths of the frame's picture and histogram in characters.
_PICTURE_COLUMNS, _MIN_PICTURE_COLUMNS, _HISTOGRAM_COLUMNS = 48, 8, 24
_BARS = " ▁▂▃▄▅▆▇█"
# Cursor and function keys, whose letters are no keys of ours.
_ESCAPES = re.compile(rb"\x1b(\[[0-9;]*[~A-Za-z]|O[A-Z]|.)?")

# Longest wait in s between two looks at the keyboard.
_LOOK_S = 0.1


class TerminalView:
    """View of a panel in the terminal, with the plan of a session and the light; lines only, if it is no terminal."""

    def __init__(
        self, panel: CapturePanel, frames: SessionFrames | None = None, meter: LightMeter | None = None
    ) -> None:
        self._panel, self._frames, self._meter = panel, frames, meter
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._printed: set[str] = set()
        self._prompt_number = 0

    @contextmanager
    def show(self) -> Iterator[None]:
        """Show the panel while the block runs."""
        self._panel.on_change.append(self._refresh)
        if not console.is_terminal:
            yield
            return
        with self._live, _keys(self._panel):
            yield

    def _refresh(self) -> None:
        """Update the picture, and print new prompts and warnings above it."""
        if console.is_terminal:
            self._live.update(self._picture(), refresh=True)
        status, asked = self._panel.status, self._panel.asked
        if asked is not None and asked.number != self._prompt_number:
            if not self._prompt_number and self._frames is not None:
                for line in describe_plan(self._frames, status):
                    inform(line)
            self._prompt_number = asked.number
            prompt = asked.prompt
            keys = f"{_key_line(prompt.answers, '   ', prompt)}   (Enter: {button_label(prompt.answers[0], prompt)})"
            for line in ("", prompt.title, *(f"  {line}" for line in (*prompt.lines, keys))):
                inform(line)
        if status is not None:
            title = [status.title] if self._panel.unattended else []
            for line in (*title, *(f"warning: {warning}" for warning in status.warnings)):
                if line not in self._printed:
                    self._printed.add(line)
                    inform(line)

    def _picture(self) -> RenderableType:
        """Return the part of the screen that is redrawn."""
        shown, asked, parts = self._panel.shown, self._panel.asked, list[Text]()
        if shown is not None:
            parts.append(Text(_describe_frame(shown, console.width), style="dim"))
            if self._meter is not None and (reading := self._meter.read(shown)) is not None:
                parts.append(Text(describe_light(reading)))
        if self._panel.status is not None:
            parts.append(Text(_describe_status(self._panel.status, waiting=asked is not None)))
        if asked is None:
            parts.append(Text(_key_line(("pause", "retake", "skip", "stop"), "  "), style="dim"))
        lines = sum(part.plain.count("\n") + 1 for part in parts)
        picture = [] if shown is None else [_frame_picture(shown, console.height - lines - 2)]
        return Group(*picture, *parts)


def describe_plan(frames: SessionFrames, status: Status | None) -> list[str]:
    """Return the plan of a session, a line per step."""
    lines = ["The plan:"]
    for row in step_rows(frames, status, homing=True):
        to_go = f", {row.to_go}" if row.to_go else ""
        state = f"   ({row.state})" if row.state != "to do" else ""
        lines.append(f"  {row.number:2}  {row.title}: {row.frames}{to_go}{state}")
    return lines


def describe_light(reading: LightReading) -> str:
    """Return a reading of the light meter in a line."""
    parts = [f"light: SNR {reading.snr:.2f} ± {reading.snr_sigma:.2f}"]
    if reading.planned_snr is not None:
        parts.append(f"planned {reading.planned_snr:.2f}")
    if reading.light_e is not None:
        parts.append(f"{reading.light_e:.2f} ± {reading.light_sigma_e:.2f} e⁻ per pixel and frame")
    return f"{', '.join(parts)}; {reading.advice}"


def _key_line(buttons: Iterable[Answer | OperatorRequest], gap: str, prompt: Prompt | None = None) -> str:
    return gap.join(f"[{KEYS[button]}] {button_label(button, prompt)}" for button in buttons)


def _describe_status(status: Status, *, waiting: bool) -> str:
    doing = "waiting for your answer" if waiting else status.doing
    node = "" if status.node is None else f" node {status.node[0]},{status.node[1]}"
    to_go = f", {format_duration(status.to_go_s)} to go" if status.done < status.total else ""
    rounds = f"\n{visible(status.rounds)}" if status.rounds else ""
    devices = "\n" + visible(f"stage: {status.stage}; camera: {status.camera}") if status.stage else ""
    return visible(f"{status.done} of {status.total} frames{to_go};{node}: {doing}") + rounds + devices


@lru_cache(maxsize=1)
def _describe_frame(shown: ShownFrame, columns: int) -> str:
    """Return a line with name and histogram of a frame, of logarithmic height, and lines with its values."""
    words = (visible(value).replace(" ", "\xa0") for value in describe_values(shown))  # a value stays in one line
    values = textwrap.fill("  ".join(words), columns).replace("\xa0", " ")
    heights = np.log1p(np.histogram(sampled(shown.pixels), bins=_HISTOGRAM_COLUMNS)[0])
    bars = "".join(_BARS[round(height / max(heights.max(), 1.0) * (len(_BARS) - 1))] for height in heights)
    name = visible(shown.frame.name) if shown.recorded else "test frame, not recorded"
    return f"{name}  {bars}\n{values}"


def describe_values(shown: ShownFrame) -> list[str]:
    """Return the checks of a frame in words, the temperature, and black and white of its picture if they are fixed."""
    values = []
    for row in check_rows(shown):
        verdict = row.verdict.upper() if row.verdict == "fail" else row.verdict
        values.append(f"{row.label} {row.value}" + (f" ({row.limit}: {verdict})" if verdict else ""))
    if shown.temperature_c is not None:
        values.append(f"sensor at {shown.temperature_c:.1f} °C")
    if shown.scale_dn is not None:
        values.append(describe_scale(shown))
    return values


def display_levels(pixels: Pixels, width_px: int, scale: tuple[float, float] | None = None) -> NDArray[np.uint8]:
    """Return a frame (row, column) reduced to a width, in 8-bit levels from black to white.

    Unless their values are given, these are its 1 % and its 99.8 % quantile.
    """
    grey = np.asarray(pixels if pixels.ndim == 2 else pixels.mean(axis=2), np.float32)
    factor = min(1.0, width_px / grey.shape[1])
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    low, high = np.quantile(small, (0.01, 0.998)) if scale is None else scale
    return np.asarray(np.clip((small - low) * (255.0 / max(float(high - low), 1.0)), 0, 255), np.uint8)


# Several states are shown with the same frame.
@lru_cache(maxsize=2)
def _frame_picture(shown: ShownFrame, lines: int) -> Text:
    """Return a frame in half blocks of so many lines at most, red on black, which preserves dark adaptation."""
    height, width = shown.pixels.shape[:2]
    columns = min(_PICTURE_COLUMNS, 2 * lines * width // height)
    if columns < _MIN_PICTURE_COLUMNS:
        return Text()
    red = display_levels(shown.pixels, columns, shown.scale_dn).astype(int) * 3 // 4
    text = Text()
    for top, bottom in zip(red[:-1:2], red[1::2], strict=True):
        for upper, lower in zip(top, bottom, strict=True):
            text.append("▀", style=f"rgb({upper},0,0) on rgb({lower},0,0)")
        text.append("\n")
    return text


@contextmanager
def _keys(panel: CapturePanel) -> Iterator[None]:
    """Let single keys press the panel's buttons while the block runs; on Windows the page alone has buttons."""
    if sys.platform == "win32" or not sys.stdin.isatty():
        yield
        return
    before = termios.tcgetattr(sys.stdin)
    ended = threading.Event()
    buttons = {key: button for button, key in KEYS.items()}

    def listen() -> None:
        while not ended.is_set():
            if not select.select([sys.stdin], [], [], _LOOK_S)[0]:
                continue
            data = os.read(sys.stdin.fileno(), 32)
            if not data:  # the terminal is gone
                return
            for key in _ESCAPES.sub(b"", data).decode(errors="ignore").lower():
                asked = panel.asked
                if key in "\r\n" and asked is not None:
                    panel.press(asked.prompt.answers[0], asked.number)
                elif key in buttons:
                    panel.press(buttons[key])

    tty.setcbreak(sys.stdin)
    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    try:
        yield
    finally:
        ended.set()
        listener.join()
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
