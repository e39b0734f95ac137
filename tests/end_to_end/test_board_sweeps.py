"""Board sweeps followed beside a capture: said in the terminal, drawn on the page, and harmless when they die."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from faintfield.pipelines import cli
from faintfield.pipelines.live import guided
from faintfield.pipelines.live.board_progress import (
    BoardNews,
    BoardOrder,
    BoardProgress,
    BoardVerdict,
    FrameCorners,
    SweepProgress,
)
from faintfield.pipelines.live.boards_client import BoardsClient, followed_boards
from faintfield.pipelines.live.capture_page import serve_page
from faintfield.pipelines.live.panel import CapturePanel
from faintfield.rig.capture.checks import Findings
from faintfield.rig.capture.guide import ShownFrame, Status
from faintfield.rig.plan import PlannedFrame, Stop
from faintfield.rig.session.homings import read_homing_groups
from faintfield.rig.session.verify import verify
from faintfield.rig.stages.protocol import Point
from tests.end_to_end.browser import Tab
from tests.patience import HANG_S
from tests.pipelines.sessions import rig_toml

_POLL_S = 0.02


def capture_with_boards(
    folder: Path, monkeypatch: pytest.MonkeyPatch, *, die_after_frames: int | None = None
) -> BoardsClient:
    """Capture three sweeps with a page, and wait at the end for the geometry, or for the death of the process."""
    clients: list[BoardsClient] = []

    @contextmanager
    def followed(order: BoardOrder, frames: Callable[[], BoardNews]) -> Iterator[BoardsClient | None]:
        with followed_boards(order, frames) as client:
            assert client is not None
            clients.append(client)
            yield client

    def wait(self: CapturePanel, outcome: str) -> None:
        (client,) = clients
        begun_s, killed = time.monotonic(), False
        while not ((client.progress and client.progress.geometry) or client.failure()):
            if die_after_frames is not None and not killed and client.progress:
                killed = client.progress.frames >= die_after_frames
                if killed:
                    os.kill(client.pid, signal.SIGKILL)
            assert time.monotonic() - begun_s < HANG_S
            time.sleep(_POLL_S)
        self.outcome = outcome

    monkeypatch.setattr(guided, "followed_boards", followed)
    monkeypatch.setattr(CapturePanel, "end", wait)
    text = rig_toml(["charuco"] * 3, rows=2, columns=2)
    (folder / "rig.toml").write_text(text.replace("check = false", "check = true"))  # homes after each sweep
    assert cli.run(["capture", str(folder / "rig.toml"), str(folder / "session"), "--yes", "--page"]) == 0
    return clients[0]


def test_terminal_says_verdict_and_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    client = capture_with_boards(tmp_path, monkeypatch)
    said = capsys.readouterr().err
    assert "board sweep 3: predicted transfer error " in said
    assert "poses: measured, of the boards of this session" in said
    assert client.progress is not None
    assert not Path(client.progress.geometry).exists()  # it is for this capture only
    news, groups = client.news(), read_homing_groups(tmp_path / "session").groups
    assert {frame.intent: frame.homing for frame in news.frames} == groups
    assert len(set(groups.values())) > 1
    assert verify(tmp_path / "session").problems == ()
    assert {path.name for path in (tmp_path / "session").iterdir()} == {
        *("SHA256SUMS", "frames", "journal.sqlite", "lock", "plan.json")
    }


@pytest.mark.deep  # test_live_planes.py kills a process of the same class
def test_capture_survives_death_of_boards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    client = capture_with_boards(tmp_path, monkeypatch, die_after_frames=1)
    said = "warning: verdicts on board sweeps ended (by signal 9); the capture goes on without them"
    assert said in capsys.readouterr().err
    verdict = verify(tmp_path / "session")
    assert (verdict.problems, verdict.present, verdict.sealed) == ((), 12, True)
    assert not Path(f"/proc/{client.pid}").exists()


def test_page_draws_corners_over_frame(browser: Tab) -> None:
    panel = CapturePanel(unattended=True)
    panel.show_status(Status("exposing", 1, 1, "Board sweep 1", 1, 9, 1.0, (0, 0), ((0.5,),), ()))
    frame = PlannedFrame(0, 0, "charuco", 0, Stop((0, 0), Point(0.0, 0.0)), 0.1, 0)
    panel.show_frame(ShownFrame(frame, np.full((120, 160), 100, np.uint16), Findings({})))
    cells = ((0,) * 8,) * 5 + ((0,) * 7 + (9,),)
    progress = BoardProgress(
        "up to date",
        frames=1,
        planned=9,
        wanted_px=0.03,
        sweeps=(SweepProgress(1, "large", 9, 1, 540.0, 22.0, "down"), SweepProgress(2, "large", 3, 1)),
        cells=cells,
        covered=1 / 48,
        verdict=BoardVerdict("predicted transfer error 0.04 px", 0.04, 500.0),
        last=FrameCorners(frame.name, (160, 120), ((40.0, 30.0), (150.0, 110.0))),
    )
    boards = mock.create_autospec(BoardsClient, instance=True)
    boards.progress, boards.failure.return_value = progress, None
    with serve_page(panel, boards=boards) as address:
        browser.open(address)
        browser.wait_until("document.querySelectorAll('#corners circle').length === 2")
        browser.wait_until("document.getElementById('frame').naturalWidth > 0")
        browser.draw()
        left, top, width, height = browser.box("#frame")
        for circle, (x, y) in zip(("first", "last"), progress.last.points if progress.last else (), strict=True):
            box = browser.box(f"#corners circle:{circle}-child")
            scale = width / 160
            assert box[0] + box[2] / 2 == pytest.approx(left + (x + 0.5) * scale, abs=1.0)
            assert box[1] + box[3] / 2 == pytest.approx(top + (y + 0.5) * height / 120, abs=1.0)
        text = browser.text()
        for words in ("predicted transfer error 0.04 px", "540 mm", "22° down", "corners cover 2 % of the picture"):
            assert words in text
        filled = "[...document.querySelectorAll('#cells rect')].map(it => it.getAttribute('fill-opacity') !== '0')"
        assert browser.evaluate(f"{filled}.indexOf(true)") == 47
        # Corners of another frame than the one that is shown are not drawn over it
        second = PlannedFrame(1, 0, "charuco", 0, frame.stop, 0.1, 0)
        panel.show_frame(ShownFrame(second, np.zeros((120, 160), np.uint16), Findings({})))
        browser.wait_until("document.getElementById('corners').hasAttribute('hidden')")
    assert browser.complaints == []
