"""Show a capture in the terminal: prompts, keys, a status line, and the last frame as a picture."""

import os
import re
import select
import sys
import termios
import threading
import tty
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.live import Live
from rich.text import Text

from faintfield.pipelines.console import console, inform, visible
from faintfield.pipelines.live.panel import CapturePanel, ShownFrame
from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.capture.guide import Status, format_duration

LABELS = {
    "go": "go on",
    "again": "try again",
    "keep": "keep as it is",
    "retake": "take again",
    "skip": "skip",
    "stop": "stop",
    "pause": "pause",
}
_KEYS = {"go": "g", "again": "a", "keep": "k", "retake": "r", "skip": "s", "stop": "q", "pause": "p"}
# Widths of the frame's picture and histogram in characters.
_PICTURE_COLUMNS, _HISTOGRAM_COLUMNS = 48, 24
_BARS = " ▁▂▃▄▅▆▇█"
# The measured values of a frame in words.
_VALUES = {
    "median_dn": "median {:.5g} DN",
    "mean_dn": "mean {:.5g} DN",
    "contrast_dn": "contrast {:.5g} DN",
    "saturated_share": "saturated {:.2%}",
    "sharpness": "sharpness {:.3g}",
    "board_corners": "{:g} board corners",
    "leak_dn": "parts differ by {:.1f} DN",
    "snr": "SNR {:.2f}",
    "darkest_dn": "darkest parts {:.1f} DN",
    "stray_dn": "stray light {:+.1f} DN",
}
# Cursor and function keys, whose letters are no keys of ours.
_ESCAPES = re.compile(rb"\x1b(\[[0-9;]*[~A-Za-z]|O[A-Z]|.)?")

# Longest wait in s between two looks at the keyboard.
_LOOK_S = 0.1


class TerminalView:
    """View of a panel in the terminal; without a terminal, a line for each step and warning."""

    def __init__(self, panel: CapturePanel) -> None:
        self._panel = panel
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
        """Print new prompts and warnings, and update the picture."""
        status, asked = self._panel.status, self._panel.asked
        if asked is not None and asked.number != self._prompt_number:
            self._prompt_number = asked.number
            prompt = asked.prompt
            keys = f"{_key_line(prompt.answers, '   ')}   (Enter: {LABELS[prompt.answers[0]]})"
            for line in ("", prompt.title, *(f"  {line}" for line in (*prompt.lines, keys))):
                inform(line)
        if status is not None:
            title = [status.title] if self._panel.unattended else []
            for line in (*title, *(f"warning: {warning}" for warning in status.warnings)):
                if line not in self._printed:
                    self._printed.add(line)
                    inform(line)
        if console.is_terminal:
            self._live.update(self._picture(), refresh=True)

    def _picture(self) -> RenderableType:
        """Return the part of the screen that is redrawn."""
        parts: list[RenderableType] = []
        if self._panel.shown is not None:
            parts += [_frame_picture(self._panel.shown), Text(_describe_frame(self._panel.shown), style="dim")]
        if self._panel.status is not None:
            parts.append(Text(_describe_status(self._panel.status)))
        if self._panel.asked is None:
            parts.append(Text(_key_line(("pause", "retake", "skip", "stop"), "  "), style="dim"))
        return Group(*parts)


def _key_line(buttons: Iterable[str], gap: str) -> str:
    return gap.join(f"[{_KEYS[button]}] {LABELS[button]}" for button in buttons)


def _describe_status(status: Status) -> str:
    node = "" if status.node is None else f" node {status.node[0]},{status.node[1]}"
    to_go = f", {format_duration(status.to_go_s)} to go" if status.done < status.total else ""
    return visible(f"{status.done} of {status.total} frames{to_go};{node}: {status.doing}")


def _describe_frame(shown: ShownFrame) -> str:
    """Return a line with name and histogram of a frame, of logarithmic height, and a second one with its values."""
    values = visible("  ".join(describe_values(shown)))
    heights = np.log1p(np.histogram(shown.pixels, bins=_HISTOGRAM_COLUMNS)[0])
    bars = "".join(_BARS[round(height / max(heights.max(), 1.0) * (len(_BARS) - 1))] for height in heights)
    return f"{visible(shown.frame.name)}  {bars}\n{values}"


def describe_values(shown: ShownFrame) -> list[str]:
    """Return the measured values of a frame in words, and black and white of its picture if they are fixed."""
    values = [_VALUES.get(name, f"{visible(name)} {{:g}}").format(value) for name, value in shown.values.items()]
    if shown.scale_dn is not None:
        values.append("black {:.0f} DN, white {:.0f} DN in this step".format(*shown.scale_dn))
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


def _frame_picture(shown: ShownFrame) -> Text:
    """Return a frame in half blocks, red on black, which preserves dark adaptation."""
    red = display_levels(shown.pixels, _PICTURE_COLUMNS, shown.scale_dn).astype(int) * 3 // 4
    text = Text()
    for top, bottom in zip(red[:-1:2], red[1::2], strict=True):
        for upper, lower in zip(top, bottom, strict=True):
            text.append("▀", style=f"rgb({upper},0,0) on rgb({lower},0,0)")
        text.append("\n")
    return text


@contextmanager
def _keys(panel: CapturePanel) -> Iterator[None]:
    """Let single keys press the panel's buttons while the block runs."""
    if not sys.stdin.isatty():
        yield
        return
    before = termios.tcgetattr(sys.stdin)
    ended = threading.Event()
    buttons = {key: button for button, key in _KEYS.items()}

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
