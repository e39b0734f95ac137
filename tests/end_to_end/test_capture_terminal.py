"""A capture in a real terminal, with keys."""

import os
import re
import select
import subprocess
import sys
from pathlib import Path

from faintfield.rig.session.verify import verify
from tests.end_to_end.rigs import write_small_rig
from tests.patience import HANG_S


class Terminal:
    """A pseudo-terminal with a command in it."""

    def __init__(self, *command: str) -> None:
        self._near, far = os.openpty()
        environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "110", "LINES": "50"}
        self._process = subprocess.Popen(command, stdin=far, stdout=far, stderr=far, env=environment)
        os.close(far)
        self.seen = ""
        self._read = 0

    def wait_for(self, words: str) -> None:
        """Wait until these words appear after those waited for before."""
        while words not in self.seen[self._read :]:
            assert self._more(), f"{words!r} did not come; seen: {self.seen[-2000:]}"
        self._read = self.seen.index(words, self._read) + len(words)

    def press(self, key: str) -> None:
        """Press a key."""
        os.write(self._near, key.encode())

    def end(self) -> int:
        """Wait until the command has ended, and return its exit code."""
        while self._more():
            pass
        os.close(self._near)
        return self._process.wait(HANG_S)

    def _more(self) -> bool:
        """Read new output; return False at its end."""
        ready, _, _ = select.select([self._near], [], [], HANG_S)
        try:
            data = os.read(self._near, 1 << 16) if ready else b""
        except OSError:  # the other end is closed
            data = b""
        self.seen += re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", data.decode(errors="replace"))
        return bool(data)


def test_keys_lead_through_capture(tmp_path: Path) -> None:
    rig, session = write_small_rig(tmp_path / "rig.toml", 2, 2), tmp_path / "session"
    program = "from faintfield.pipelines.cli import main; main()"
    terminal = Terminal(sys.executable, "-c", program, "capture", str(rig), str(session))
    terminal.wait_for("8  Dark-scene set: 4 nodes, 0.1 s, about ")
    terminal.wait_for("Homing")
    terminal.press("g")
    terminal.wait_for("Step 1 of 11: Board sweep 1")
    terminal.wait_for("[t] test frame")
    terminal.press("t")
    terminal.wait_for("test frame, not recorded")
    terminal.wait_for("saturated pixels 0.00 % (at most 1.00 %: pass)")
    terminal.wait_for("stage: at rest at ")
    terminal.wait_for("Step 1 of 11: Board sweep 1")
    terminal.wait_for("(Enter: go on)")
    for key in ("\x1bOS", "\x1b[A", "ä", "x"):  # F4, an arrow and letters: no keys of ours
        terminal.press(key)
    terminal.press("\n")
    terminal.wait_for("▀▀▀▀")
    terminal.wait_for("board corners")
    for sweep in range(2, 7):
        terminal.wait_for(f"Step {sweep} of 11: Board sweep {sweep}")
        terminal.press("s")
    terminal.wait_for("Step 7 of 11: Bright set")
    terminal.press("q")
    assert terminal.end() == 1
    assert not re.search(r"waiting for your answer\s+stage: [^\r\n]*\s+\[p\] pause", terminal.seen)
    assert "CaptureStopped: stopped with 4 of 44 frames taken" in terminal.seen.replace("\r\n", " ")
    assert verify(session).present == 4
