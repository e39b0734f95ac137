"""The capture in the terminal: the guide's words, keys, a line of progress, and the last frame as a picture."""

import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np
from rich.console import Group, RenderableType
from rich.live import Live
from rich.text import Text

from faintfield.pipelines.console import console, inform
from faintfield.pipelines.live.panel import CapturePanel, ShownFrame
from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.capture.guide import Prompt, Status, format_duration

KEYS = {"go": "g", "again": "a", "keep": "k", "retake": "r", "skip": "s", "stop": "q", "pause": "p"}
LABELS = {
    "go": "go on",
    "again": "try again",
    "keep": "keep as it is",
    "retake": "take again",
    "skip": "skip",
    "stop": "stop",
    "pause": "pause",
}
_PICTURE_COLUMNS = 48
_BARS = " ▁▂▃▄▅▆▇█"


class TerminalView:
    """Shows a panel in the terminal; on anything else than a terminal, a line for each step and warning.

    Parameters
    ----------
    panel : CapturePanel
        What to show.
    """

    def __init__(self, panel: CapturePanel) -> None:
        self._panel = panel
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._said: set[str] = set()
        self._asked = 0

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
        """Show what is new."""
        status, asked = self._panel.status, self._panel.asked
        if asked is not None and asked.number != self._asked:
            self._asked = asked.number
            for line in prompt_lines(asked.prompt):
                inform(line)
        if status is not None:
            title = [status.title] if self._panel.unattended else []
            for line in (*title, *(f"warning: {it}" for it in status.warnings)):
                if line not in self._said:
                    self._said.add(line)
                    inform(line)
        if console.is_terminal:
            self._live.update(self._picture(), refresh=True)

    def _picture(self) -> RenderableType:
        """Return the part of the screen that changes."""
        parts: list[RenderableType] = []
        if self._panel.shown is not None:
            parts += [frame_picture(self._panel.shown.pixels), Text(values_line(self._panel.shown), style="dim")]
        if self._panel.status is not None:
            parts.append(Text(status_line(self._panel.status)))
        wishes = "  ".join(f"[{KEYS[word]}] {LABELS[word]}" for word in ("pause", "retake", "skip", "stop"))
        if self._panel.asked is None:
            parts.append(Text(wishes, style="dim"))
        return Group(*parts)


def prompt_lines(prompt: Prompt) -> list[str]:
    """Return a prompt as lines of text."""
    answers = "   ".join(f"[{KEYS[answer]}] {LABELS[answer]}" for answer in prompt.answers)
    return [
        "",
        prompt.title,
        *(f"  {line}" for line in prompt.lines),
        f"  {answers}   (Enter: {LABELS[prompt.answers[0]]})",
    ]


def status_line(status: Status) -> str:
    """Return the status in a line."""
    node = "" if status.node is None else f" node {status.node[0]},{status.node[1]}"
    return f"{status.done} of {status.total} frames, {format_duration(status.to_go_s)} to go;{node}: {status.doing}"


def values_line(shown: ShownFrame) -> str:
    """Return the name of a frame and its histogram, and in a second line what was measured in it."""
    values = "  ".join(f"{name} {value:g}" for name, value in shown.values.items())
    return f"{shown.frame.name}  {histogram_bars(shown.pixels)}\n{values}"


def histogram_bars(pixels: Pixels, bins: int = 24) -> str:
    """Return the histogram from the darkest to the brightest pixel, heights on a logarithmic scale."""
    counts, _ = np.histogram(pixels, bins=bins)
    heights = np.log1p(counts) / max(float(np.log1p(counts).max()), 1.0)
    return "".join(_BARS[round(height * (len(_BARS) - 1))] for height in heights)


def display_levels(pixels: Pixels, width_px: int) -> Pixels:
    """Return a frame as 8-bit levels (row, column), reduced to a width, from its 1 % to its 99.8 % quantile."""
    grey = np.asarray(pixels if pixels.ndim == 2 else pixels.mean(axis=2), np.float32)
    scale = min(1.0, width_px / grey.shape[1])
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    low, high = np.quantile(small, (0.01, 0.998))
    return np.asarray(np.clip((small - low) * (255.0 / max(float(high - low), 1.0)), 0, 255), np.uint8)


def frame_picture(pixels: Pixels) -> Text:
    """Return a frame in half blocks, red on black: what does not spoil eyes that are used to the dark."""
    picture = display_levels(pixels, _PICTURE_COLUMNS)
    text = Text()
    for top, bottom in zip(picture[:-1:2], picture[1::2], strict=True):
        for upper, lower in zip(top, bottom, strict=True):
            text.append("▀", style=f"rgb({upper * 3 // 4},0,0) on rgb({lower * 3 // 4},0,0)")
        text.append("\n")
    return text


@contextmanager
def _keys(panel: CapturePanel) -> Iterator[None]:
    """Let single keys press the panel's buttons while the block runs."""
    if not sys.stdin.isatty():
        yield
        return
    before = termios.tcgetattr(sys.stdin)
    wake_read, wake_write = os.pipe()
    words = {key: word for word, key in KEYS.items()}

    def listen() -> None:
        while True:
            ready, _, _ = select.select([sys.stdin, wake_read], [], [])
            if wake_read in ready:
                return
            key = os.read(sys.stdin.fileno(), 1).decode(errors="ignore").lower()
            asked = panel.asked
            if key in "\r\n" and asked is not None:
                panel.press(asked.prompt.answers[0], asked.number)
            elif key in words:
                panel.press(words[key])

    tty.setcbreak(sys.stdin)
    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    try:
        yield
    finally:
        os.write(wake_write, b"x")
        listener.join()
        os.close(wake_read)
        os.close(wake_write)
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
