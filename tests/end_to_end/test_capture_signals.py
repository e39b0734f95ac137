"""A capture that is ended from outside, or whose terminal is closed, brings the stage to rest."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from unittest import mock

import pytest

from faintfield.rig.session.verify import verify
from faintfield.rig.simulation.controller.bench import Server
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from tests.patience import HANG_S

# Simulated seconds of the controller per real second.
SPEED = 20.0
CANCEL_JOG = b"\x85"

RIG = """
[stage]
protocol = "grbl"
port = "{port}"
[camera]
backend = "folder"
folder = "{folder}"
[grid]
rows = 1
columns = 2
pitch_mm = 50.0
origin_mm = [-350.0, -350.0]
[settle]
measure = false
[drift]
check = false
[[step]]
kind = "bright"
exposure_s = 0.1
"""


class Controller(Server):
    """A simulated controller that remembers the bytes that it was sent."""

    def __init__(self) -> None:
        super().__init__(SimulatedGrbl)
        self.received = b""
        self._begun_s = time.monotonic()
        receive = self._firmware.receive

        def note(data: bytes) -> None:
            self.received += data
            receive(data)

        mock.patch.object(self._firmware, "receive", note).start()

    def run_until(self, condition: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + HANG_S
        while not condition():
            assert time.monotonic() < deadline_s, self.received[-300:]
            self.turn(SPEED * (time.monotonic() - self._begun_s))
            time.sleep(0.002)

    def moves(self) -> bool:
        """Return whether the stage moves to a node."""
        return b"$J=" in self.received and self._firmware.mechanics.moving


@pytest.mark.parametrize(
    "end", [signal.SIGTERM, pytest.param(None, marks=pytest.mark.deep)], ids=["terminated", "terminal closed"]
)
def test_stage_rests_after_capture_is_ended(tmp_path: Path, end: signal.Signals | None) -> None:
    (tmp_path / "incoming").mkdir()
    with closing(Controller()) as controller:
        rig, session = tmp_path / "rig.toml", tmp_path / "session"
        rig.write_text(RIG.format(port=controller.port, folder=tmp_path / "incoming"))
        program = "from faintfield.pipelines.cli import main; main()"
        command = [sys.executable, "-c", program, "capture", str(rig), str(session), "--yes"]
        near, far = os.openpty()

        def begin() -> None:
            signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests themselves may run under nohup
            os.login_tty(far)

        process = subprocess.Popen(command, preexec_fn=begin)
        os.close(far)
        controller.run_until(controller.moves)
        sent = len(controller.received)
        if end is None:
            os.close(near)
        else:
            process.send_signal(end)
        controller.run_until(lambda: process.poll() is not None)
        assert CANCEL_JOG in controller.received[sent:]
        assert b"$J=" not in controller.received[sent:]
        assert process.returncode == 128 + (end or signal.SIGHUP)
        if end is not None:
            os.close(near)
    verdict = verify(session)
    assert (verdict.problems, verdict.sealed) == ((), False)
