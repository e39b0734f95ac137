"""The page of a capture, in a real headless browser: what the terminal can do it can do, and the two agree."""

import errno
import re
import socket
import threading
import time
import urllib.parse
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest
import tifffile

from faintfield.pipelines import cli
from faintfield.pipelines.live import capture_page, guided
from faintfield.pipelines.live.board_progress import BoardProgress, BoardVerdict, FrameCorners, SweepProgress
from faintfield.pipelines.live.capture_page import serve_page
from faintfield.pipelines.live.panel import CapturePanel, OpenPrompt, SessionFrames
from faintfield.pipelines.live.terminal import TerminalView
from faintfield.pipelines.live.view import CaptureView
from faintfield.rig.capture.checks import Findings, Limit
from faintfield.rig.capture.guide import Prompt, ShownFrame, Status, step_prompt
from faintfield.rig.errors import CameraError, CaptureStopped, RigError
from faintfield.rig.plan import planned_frames
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.verify import verify
from tests.end_to_end.browser import Tab, answer_to
from tests.end_to_end.rigs import write_small_rig
from tests.faults.capturing import FRAMES, SMALL_RIG, capture, events, frozen_plan
from tests.patience import HANG_S

STOP = b'{"word": "stop"}'


def boards(words: str, frame: str = "") -> Any:
    """Return progress of board sweeps with the same words everywhere, and a corner in a frame."""
    progress = BoardProgress(
        words,
        frames=3,
        planned=9,
        sweeps=(SweepProgress(1, words, 9, 1, 540.0, 22.0, words),),
        cells=((1, 0), (0, 2)),
        covered=0.5,
        verdict=BoardVerdict(words),
        last=FrameCorners(frame, (16, 12), ((3.0, 4.0),)),
        refusal=words,
    )
    return SimpleNamespace(progress=progress, failure=lambda: None)


class Running:
    """A capture in a thread, with its page."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.panel = CapturePanel(unattended=False)
        self.failure: RigError | None = None
        self._stack = ExitStack()
        self._thread = threading.Thread(target=self._capture)

    def __enter__(self) -> "Running":
        self.address = self._stack.enter_context(serve_page(self.panel))
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        while self._thread.is_alive():
            self.panel.press("stop")
            self._thread.join(0.1)
        self._stack.close()

    def ended(self) -> RigError | None:
        self._thread.join(HANG_S)
        assert not self._thread.is_alive()
        return self.failure

    def _capture(self) -> None:
        with TerminalView(self.panel).show():
            self.failure = capture(self.folder, self.panel)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    with Running(tmp_path / "session") as running:
        yield running


def test_clicks_lead_through_capture(running: Running, browser: Tab) -> None:
    browser.open(running.address)
    browser.wait_until("document.getElementById('title').textContent === 'Homing'")
    assert "The stage moves to its switches" in browser.text()
    browser.click("go")
    browser.wait_until("document.getElementById('title').textContent.includes('Bright set')")
    browser.evaluate("document.body.style.minHeight = '3000px'")  # with a scroll bar
    blue, green, red = (channel for channel in np.moveaxis(browser.screen(), 2, 0))
    assert max(blue.max(), green.max()) <= 8  # eyes stay adapted to the dark
    assert red.mean() < 15
    for title in ("Step 1 of 3: Bright set", "Step 2 of 3: Dark-scene set", "Step 3 of 3: Dark frames"):
        browser.wait_until(f"document.getElementById('title').textContent === '{title}'")
        browser.wait_until(
            "document.querySelector('button[data-word=go]') && !document.querySelector('[data-word=pause]')"
        )
        browser.click("go")
    assert running.ended() is None
    verdict = verify(running.folder)
    assert (verdict.problems, verdict.present, verdict.sealed) == ((), FRAMES, True)
    browser.wait_until("document.getElementById('frame').naturalWidth > 0")
    browser.wait_until("document.body.innerText.includes('00015_dark_0_r1_c1')")
    browser.wait_until(f"document.body.innerText.includes('{FRAMES} of {FRAMES} frames')")
    assert browser.evaluate("document.querySelectorAll('#grid button').length") == 6
    assert browser.evaluate("document.querySelectorAll('#histogram path').length") == 1
    assert browser.complaints == []


def test_page_shows_end_before_server_closes(browser: Tab) -> None:
    panel = CapturePanel(unattended=True)
    panel.show_status(Status("exposing", 1, 1, "Bright set", 8, 9, 1.0, (0, 0), ((0.5,),), ()))
    with serve_page(panel) as address:
        browser.open(address)
        browser.wait_until("document.getElementById('title').textContent === 'Bright set'")
        panel.show_status(Status("complete", 1, 1, "Bright set", 9, 9, 0.0, (0, 0), ((1.0,),), ()))
        panel.end("Complete. Next: faintfield run session")
    assert browser.evaluate("document.getElementById('title').textContent") == panel.outcome
    assert browser.evaluate("document.getElementById('count').textContent") == "9 of 9 frames"
    assert browser.evaluate("document.getElementById('buttons').children.length") == 0


def test_terminal_and_page_agree(running: Running, browser: Tab, capsys: pytest.CaptureFixture[str]) -> None:
    browser.open(running.address)
    browser.click("go")
    browser.wait_until("document.getElementById('title').textContent.includes('Bright set')")
    # A key in the terminal answers what the page shows, and the page goes on
    asked = running.panel.asked
    assert asked is not None
    running.panel.press("skip", asked.number)
    browser.wait_until("document.getElementById('title').textContent.includes('Dark-scene set')")
    # An answer to a prompt that is gone counts for nothing
    running.panel.press("stop", asked.number)
    assert running.panel.asked is not None
    browser.click("stop")
    failure = running.ended()
    assert isinstance(failure, CaptureStopped)
    words = capsys.readouterr().err
    assert "Step 1 of 3: Bright set" in words
    assert "[g] go on   [t] test frame   [s] skip step   [q] stop   (Enter: go on)" in words
    assert [event.detail["answer"] for event in events(running.folder, "prompt")] == ["go", "skip", "stop"]


def test_no_name_becomes_part_of_page(browser: Tab) -> None:
    hostile = "</li><script>document.title = 'mine'</script><img src=x onerror=\"document.title = 'mine'\">"
    panel = CapturePanel(unattended=False)
    panel.asked = OpenPrompt(1, Prompt(hostile, hostile, (f"{hostile}, a line",), ("go",), "go"))
    warnings = (hostile, hostile + "\udcff")
    panel.status = Status(hostile, 1, 1, hostile, 0, 1, 1.0, (0, 0), ((0.0,),), warnings, hostile, hostile)
    frame = planned_frames(frozen_plan(SMALL_RIG).plan)[0]
    panel.shown = ShownFrame(frame, np.zeros((2, 3), np.uint16), Findings({hostile: 1.0}))
    with serve_page(panel, boards=boards(hostile)) as address:
        browser.open(address)
        browser.wait_until("document.getElementById('frame').naturalWidth > 0")
        assert browser.text().count("<script>") == 12
        assert browser.evaluate("document.title") == "faintfield capture"
        assert browser.evaluate("document.querySelectorAll('script').length") == 1


@pytest.fixture
def waiting(tmp_path: Path) -> Iterator[tuple[CapturePanel, str]]:
    """The page of a session before its first frame, and its panel."""
    panel = CapturePanel(unattended=False)
    with open_session(tmp_path / "session", frozen_plan(SMALL_RIG)) as session:
        first = session.frames[0]
        prompt = step_prompt(session.plan.steps, first, (6, 6), 60.0)
        grid = ((0.0, 0.0, 0.0),) * 2
        panel.status = Status(
            "waiting", 1, 3, prompt.title, 0, FRAMES, 99.0, (0, 0), grid, (), "homed", "ready", (60.0, 30.0, 9.0)
        )
        asking = threading.Thread(target=lambda: panel.end(panel.ask(prompt)))
        asking.start()
        with serve_page(panel, SessionFrames(session), boards=boards("tilt it more", first.name)) as address:
            yield panel, address
            panel.press("stop")
            asking.join(HANG_S)


def test_page_shows_plan_before_first_frame(waiting: tuple[CapturePanel, str], browser: Tab) -> None:
    panel, address = waiting
    browser.open(address)
    browser.wait_until("document.querySelectorAll('#plan > li').length === 3")
    states = "[...document.querySelectorAll('#plan summary')].map(it => it.lastChild.textContent)"
    assert browser.evaluate(states) == ["now", "next", "to do"]
    text = browser.text()
    for words in (
        *("Take the boards away", "2 Dark-scene set", "about 2 min to go"),
        *("stage\nhomed", "camera\nready", "No frame of this step yet"),
    ):
        assert words in text
    for words in ("6 nodes, 0.1 s, about 30 s", "Lights out. Cover every lamp"):
        assert words in browser.text()
    browser.evaluate("document.body.dispatchEvent(new KeyboardEvent('keydown', {key: 't', bubbles: true}))")
    browser.wait_until("document.getElementById('title').textContent === 'test'")  # the outcome is the answer
    assert panel.outcome == "test"
    assert browser.complaints == []


_CONTRASTS = """(() => {
    const light = (share) => share <= 0.04045 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4;
    const luminance = (colour) => colour.match(/[\\d.]+/g).slice(0, 3)
        .reduce((sum, value, index) => sum + [0.2126, 0.7152, 0.0722][index] * light(value / 255), 0);
    const texts = [...document.querySelectorAll('body *')].filter((it) => it.offsetParent && it.tagName !== 'OPTION' &&
        [...it.childNodes].some((child) => child.nodeType === 3 && child.textContent.trim()));
    return texts.map((it) => {
        let ground = it;
        while (ground && getComputedStyle(ground).backgroundColor === 'rgba(0, 0, 0, 0)') ground = ground.parentElement;
        const pair = [getComputedStyle(it).color, getComputedStyle(ground).backgroundColor].map(luminance);
        return (Math.max(...pair) + 0.05) / (Math.min(...pair) + 0.05);
    });
})()"""


def test_text_stands_out_at_every_width(waiting: tuple[CapturePanel, str], browser: Tab) -> None:
    panel, address = waiting
    frame = planned_frames(frozen_plan(SMALL_RIG).plan)[0]
    findings = Findings({"saturated_share": 0.2}, ("too bright",), {"saturated_share": Limit(0.01)}, 65535.0)
    panel.show_frame(ShownFrame(frame, np.full((12, 16), 9, np.uint16), findings, -20.0))
    browser.open(address)
    browser.wait_until("document.getElementById('frame').naturalWidth > 0")
    for words in (
        *("tilt it more", "540 mm", "corners cover 50 %", "20.00 %", "✗ fail", "at most 1.00 %", "-20.0 °C"),
        "saturation 65535 DN",
    ):
        assert words in browser.text()
    assert browser.evaluate("document.querySelectorAll('#corners circle').length") == 1
    for width in (1400, 1024, 390):
        browser.resize(width)
        contrasts = browser.evaluate(_CONTRASTS)
        assert len(contrasts) > 40
        assert min(contrasts) >= 4.5
        assert browser.evaluate("document.documentElement.scrollWidth") <= width


def test_brightness_is_kept(waiting: tuple[CapturePanel, str], browser: Tab) -> None:
    opacity = "Number(getComputedStyle(document.querySelector('main')).opacity)"
    browser.open(waiting[1])
    browser.wait_until(f"{opacity} === 1 && document.querySelector('#plan li')")
    browser.evaluate("document.body.dispatchEvent(new KeyboardEvent('keydown', {key: '-', bubbles: true}))")
    browser.reload()
    assert browser.evaluate(opacity) == pytest.approx(0.95)
    browser.evaluate("localStorage.clear()")


def test_strangers_learn_nothing_and_press_nothing() -> None:
    panel = CapturePanel(unattended=True)
    with serve_page(panel) as address, serve_page(CapturePanel(unattended=True)) as other:
        parts = urllib.parse.urlsplit(address)
        token = parts.path.strip("/")
        assert parts.hostname == "127.0.0.1"
        assert len(token) >= 32
        assert urllib.parse.urlsplit(other).path.strip("/") != token
        root, wrong_token = f"http://{parts.netloc}/", address[:-2] + ("a/" if address[-2] != "a" else "b/")
        places = [root, root + "state", root + "docs", root + token[:-1] + "/state", wrong_token + "state"]
        hosts = ["evil.example", "localhost.evil.example:80", ""]
        origins = ["http://evil.example", "null", "http://127.0.0.1:1", f"https://{parts.netloc}"]
        answers = [
            *(answer_to(place) for place in places),
            *(answer_to(place, "POST", STOP) for place in (root + "press", wrong_token + "press")),
            *(answer_to(address + "state", Host=host) for host in hosts),
            *(answer_to(address + "press", "POST", STOP, Origin=origin) for origin in origins),
        ]
        assert answer_to(address).status == answer_to(address + "state").status == 200
    assert [answer.status for answer in answers] == [404] * len(answers)
    (headers,) = {tuple((name, value) for name, value in answer.getheaders() if name != "date") for answer in answers}
    names = {name for name, _ in headers}
    assert "server" not in names
    assert {"referrer-policy", "cache-control", "connection"} <= names
    assert panel.take_request() is None


@pytest.mark.parametrize("host", ["", "127.0.0.1:8000"], ids=["directly", "through a tunnel"])
def test_page_itself_may_press(host: str) -> None:
    panel = CapturePanel(unattended=True)
    with serve_page(panel) as address:
        host = host or urllib.parse.urlsplit(address).netloc
        assert answer_to(address + "press", "POST", STOP, Host=host, Origin=f"http://{host}").status == 200
        assert panel.take_request() == "stop"
        for body in (
            *(b"", b"[]", b"[" * 999, b'{"word": "explode"}', b'{"word": "go", "more": 1}', b'{"word": 5}'),
            *(b'{"word": "\xff"}', b'{"word": "go"}' + b" " * 1000, b"x" * 100_000),
        ):
            assert answer_to(address + "press", "POST", body).status == 400, body
    assert panel.take_request() is None


def test_connection_that_stalls_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capture_page, "_MAX_REQUEST_S", 0.05)
    monkeypatch.setattr(CaptureView, "state", lambda view: {"text": "x" * 50_000_000})
    with serve_page(CapturePanel(unattended=True)) as address:
        parts = urllib.parse.urlsplit(address)
        place = (parts.hostname, parts.port or 0)
        for beginning in (b"", b"GET / HT", f"POST {parts.path}press HTTP/1.1\r\nHost: 127.0.0.1\r\n".encode()):
            with socket.create_connection(place, HANG_S) as connection:
                connection.sendall(beginning)
                with suppress(ConnectionResetError):
                    assert connection.recv(1) == b""
        with socket.create_connection(place, HANG_S) as connection, suppress(ConnectionError):
            for _ in range(1000):  # a request that comes byte by byte is never idle
                connection.sendall(b"G")
                time.sleep(0.01)
            pytest.fail("a slow request is never closed")
        with socket.create_connection(place, HANG_S) as connection:
            connection.sendall(f"GET {parts.path}state HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
            count = 0
            with suppress(ConnectionResetError):
                while data := connection.recv(256):  # takes far longer than the page allows
                    count += len(data)
            assert 1000 < count < 50_000_000
        assert answer_to(address).status == 200


def test_failure_in_page_stays_there(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(CaptureView, "state", mock.Mock(side_effect=ZeroDivisionError))
    with serve_page(CapturePanel(unattended=True)) as address:
        assert answer_to(address + "state").status == 500
        assert answer_to(address).status == 200
    assert capfd.readouterr() == ("", "")
    assert caplog.messages == []


def _capture(tmp_path: Path, *options: str) -> int:
    """Capture a small session, and return the exit code."""
    rig = tmp_path / "rig.toml"
    if not rig.exists():
        write_small_rig(rig)
    return cli.run(["capture", str(rig), str(tmp_path / "session"), "--page", *options])


def test_terminal_shows_address_and_no_log_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "day.log"
    assert _capture(tmp_path, "--yes", "--live-sweep-mm", "400:600:3", "--log", str(log)) == 0
    complaint = capsys.readouterr().err
    assert "live planes" not in complaint
    [token] = re.findall(r"page: http://127\.0\.0\.1:\d+/(\S+)/\n", complaint)
    assert re.search(r"INFO page: http://127\.0\.0\.1:\d+/\(concealed\)/\n", log.read_text())
    for path in (log, *(tmp_path / "session").rglob("*.*")):
        assert token.encode() not in path.read_bytes()
    assert verify(tmp_path / "session").sealed


@pytest.mark.parametrize(
    ("broken", "words"),
    [("socket.create_server", "there is no page ("), ("uvicorn.Server.serve", "the page has ended (OSError: ")],
)
def test_capture_goes_on_without_page(
    broken: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(broken, mock.Mock(side_effect=OSError(errno.EMFILE, "Too many open files")))
    if broken == "socket.create_server":
        assert _capture(tmp_path) == 1
        complaint = capsys.readouterr().err.splitlines()[-1]
        assert complaint.startswith(f"faintfield: CaptureStopped: {words}[Errno 24] Too many open files) and no")
    assert _capture(tmp_path, "--yes") == 0
    assert f"warning: {words}[Errno 24] Too many open files); " in capsys.readouterr().err
    assert verify(tmp_path / "session").sealed


def test_pixels_without_numbers_are_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "frame.tiff", np.array([[1.0, np.nan]], np.float32))
    with pytest.raises(CameraError, match=r"values that are no numbers; "):
        guided.read_pixels(tmp_path / "frame.tiff")
