"""The page of a capture, in a real headless browser: what the terminal can do it can do, and the two agree."""

import base64
import errno
import http.client
import json
import multiprocessing
import re
import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

import cv2
import numpy as np
import pytest
import tifffile

from faintfield.pipelines import cli
from faintfield.pipelines.live import capture_page, guided
from faintfield.pipelines.live.capture_page import serve_page
from faintfield.pipelines.live.panel import CapturePanel, OpenPrompt, ShownFrame
from faintfield.pipelines.live.terminal import TerminalView
from faintfield.rig.capture.guide import Prompt, Status
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.errors import CameraError, CaptureStopped, RigError
from faintfield.rig.plan import planned_frames
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan
from faintfield.rig.session.verify import verify
from tests.end_to_end.browser import Tab
from tests.faults.besieging import besiege
from tests.faults.capturing import FRAMES, SMALL_RIG, in_process
from tests.patience import HANG_S


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
        plan = FrozenPlan(survey(open_rig(SMALL_RIG), SMALL_RIG).plan, SMALL_RIG)
        try:
            with open_session(self.folder, plan) as session, TerminalView(self.panel).show():
                Capture(session, open_rig(SMALL_RIG, session.journal), self.panel, lambda path: None).run()
        except RigError as failure:
            self.failure = failure


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    with Running(tmp_path / "session") as running:
        yield running


def test_a_whole_capture_by_clicks(running: Running, browser: Tab) -> None:
    browser.open(running.address)
    browser.wait_until("document.getElementById('title').textContent === 'Homing'")
    assert "The stage moves to its switches" in browser.text()
    browser.click("go")
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
    assert f"of {FRAMES} frames" in browser.text()
    assert browser.evaluate("document.querySelectorAll('#grid button').length") == 6
    assert browser.evaluate("document.querySelectorAll('#histogram path').length") == 1
    # Pages of other tests may complain that their capture has ended
    assert [it for it in browser.complaints if running.address in it] == []


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
    assert "[g] go on   [s] skip   [q] stop   (Enter: go on)" in words
    with Journal(running.folder / "journal.sqlite", read_only=True) as journal:
        assert [event.detail["answer"] for event in journal.events("prompt")] == ["go", "skip", "stop"]


def test_no_name_becomes_a_part_of_the_page(browser: Tab) -> None:
    hostile = "</li><script>document.title = 'mine'</script><img src=x onerror=\"document.title = 'mine'\">"
    panel = CapturePanel(unattended=False)
    panel.asked = OpenPrompt(1, Prompt(hostile, hostile, (hostile,), ("go",), "go"))
    panel.status = Status(hostile, 1, 1, hostile, 0, 1, 1.0, (0, 0), ((0.0,),), (hostile, hostile + "\udcff"))
    frame = planned_frames(survey(open_rig(SMALL_RIG), SMALL_RIG).plan)[0]
    panel.shown = ShownFrame(frame, np.zeros((2, 3), np.uint16), {hostile: 1.0})
    with serve_page(panel) as address:
        browser.open(address)
        browser.wait_until("document.getElementById('frame').naturalWidth > 0")
        assert browser.text().count("<script>") == 5
        assert browser.evaluate("document.title") == "faintfield capture"
        assert browser.evaluate("document.querySelectorAll('script').length") == 1


def test_the_page_is_dark_red(running: Running, browser: Tab) -> None:
    browser.call("Emulation.setDeviceMetricsOverride", width=1200, height=800, deviceScaleFactor=1, mobile=False)
    browser.open(running.address)
    browser.click("go")
    browser.wait_until("document.getElementById('title').textContent.includes('Bright set')")
    picture = base64.b64decode(browser.call("Page.captureScreenshot", format="png")["data"])
    blue, green, red = cv2.split(cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR))
    assert max(blue.max(), green.max()) <= 60
    assert red.max() <= 230
    assert red.mean() < 12


def status_of(address: str, data: bytes | None = None, **headers: str) -> int:
    """Return the HTTP status of a request."""
    try:
        with urllib.request.urlopen(urllib.request.Request(address, data, headers)) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as failure:
        failure.close()
        return failure.code


def test_nothing_is_found_without_the_token(running: Running) -> None:
    parts = urllib.parse.urlsplit(running.address)
    assert parts.hostname == "127.0.0.1"
    token = parts.path.strip("/")
    assert len(token) >= 32
    root = f"http://{parts.netloc}/"
    assert status_of(running.address) == 200
    assert status_of(running.address + "state") == 200
    for place in ("", "state", "press", "x" * len(token) + "/", token[:-1] + "/state", "docs"):
        assert status_of(root + place) == 404
        assert status_of(root + place, b"{}") in (404, 405)


def answer_to(address: str, method: str, **headers: str) -> http.client.HTTPResponse:
    """Return the answer to a request with these headers."""
    parts = urllib.parse.urlsplit(address)
    with closing(http.client.HTTPConnection(parts.netloc)) as connection:
        connection.request(method, parts.path, b'{"word": "stop"}' if method == "POST" else None, headers)
        return connection.getresponse()


def turned_away(address: str) -> list[http.client.HTTPResponse]:
    """Return the answers to requests without the token, or from a foreign page."""
    wrong_token = address[:-2] + ("a/" if address[-2] != "a" else "b/")
    return [
        answer_to(wrong_token + "state", "GET"),
        answer_to(wrong_token + "press", "POST"),
        answer_to(address + "state", "GET", Host="evil.example"),
        answer_to(address + "state", "GET", Host="localhost.evil.example:80"),
        answer_to(address + "state", "GET", Host=""),
        answer_to(address + "press", "POST", Origin="http://evil.example"),
        answer_to(address + "press", "POST", Origin="null"),
        answer_to(address + "press", "POST", Origin="http://127.0.0.1:1"),
        answer_to(address + "press", "POST", Origin="https://" + urllib.parse.urlsplit(address).netloc),
    ]


def test_who_is_turned_away_learns_nothing_and_presses_nothing() -> None:
    panel = CapturePanel(unattended=True)
    with serve_page(panel) as address:
        answers = turned_away(address)
    headers = {tuple((name, it) for name, it in answer.getheaders() if name != "date") for answer in answers}
    assert [answer.status for answer in answers] == [404] * len(answers)
    assert len(headers) == 1
    [names] = [{name for name, _ in one} for one in headers]
    assert "server" not in names
    assert {"referrer-policy", "cache-control", "connection"} <= names
    assert panel.take_request() is None


@pytest.mark.parametrize("through", ["no tunnel", "a tunnel"])
def test_the_page_itself_may_press(through: str) -> None:
    panel = CapturePanel(unattended=True)
    with serve_page(panel) as address:
        host = urllib.parse.urlsplit(address).netloc if through == "no tunnel" else "127.0.0.1:8000"
        assert answer_to(address + "press", "POST", Host=host, Origin=f"http://{host}").status == 200
    assert panel.take_request() == "stop"


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"[]",
        b"[" * 999,
        b'{"word": "explode"}',
        b'{"word": "go", "more": 1}',
        b'{"word": 5}',
        b'{"word": "\xff"}',
        b'{"word": "go"}' + b" " * 1000,
        b"x" * 100_000,
    ],
)
def test_nonsense_presses_no_button(running: Running, body: bytes) -> None:
    assert status_of(running.address + "press", body) == 400


def test_one_page_has_another_token_than_the_next() -> None:
    with serve_page(CapturePanel(unattended=True)) as one, serve_page(CapturePanel(unattended=True)) as other:
        assert urllib.parse.urlsplit(one).path != urllib.parse.urlsplit(other).path


_CAPTURE = """
import resource, sys
from pathlib import Path
from faintfield.pipelines.live.guided import capture_session
from tests.faults.capturing import SMALL_RIG
resource.setrlimit(resource.RLIMIT_NOFILE, (int(sys.argv[2]), int(sys.argv[2])))
capture_session(SMALL_RIG, Path(sys.argv[1]), unattended=False, page=True)
"""


class Besieged:
    """A capture with a page in a process of its own, which may open only so many files, and the page's user."""

    def __init__(self, folder: Path, max_files: int) -> None:
        command = [sys.executable, "-c", _CAPTURE, str(folder), str(max_files)]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2])

    def __enter__(self) -> "Besieged":
        assert self.process.stderr is not None
        said = next(line for line in self.process.stderr if line.startswith("page: "))
        self.address = said.removeprefix("page: ").strip()
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()

    def end(self) -> str:
        """Wait until the capture has ended well, and return what it has said since it began."""
        _, said = self.process.communicate(timeout=HANG_S)
        assert self.process.returncode == 0, said
        return said

    def state(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.ask("state"))
        return found

    def ask(self, place: str, data: bytes | None = None) -> bytes:
        """Ask the page as a browser does: until an answer comes."""
        for _ in range(10_000):
            assert self.process.poll() is None, "the capture has ended"
            with suppress(OSError, http.client.HTTPException), urllib.request.urlopen(self.address + place, data) as it:
                return bytes(it.read())
        raise AssertionError(f"{place}: no answer")

    def wait_for(self, title: str) -> int:
        """Wait for the prompt with this title, and return its number."""
        while (prompt := self.state()["prompt"]) is None or prompt["title"] != title:
            pass
        return int(prompt["number"])

    def answer(self, title: str) -> None:
        """Wait for the prompt with this title, and go on."""
        self.ask("press", json.dumps({"word": "go", "prompt": self.wait_for(title)}).encode())

    def memory_mb(self, which: str) -> float:
        """Return `VmRSS`, the memory in use, or `VmHWM`, its highest value since it was last forgotten."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(re.search(rf"{which}:\s+(\d+) kB", status)[1]) / 1000  # type: ignore[index]

    def forget_highest_memory(self) -> None:
        Path(f"/proc/{self.process.pid}/clear_refs").write_text("5")


@contextmanager
def besieged(address: str, idle: int, slow: int, body_bytes: int) -> Iterator[None]:
    """Besiege a page while the block runs, which begins when every connection is open and every request was made."""
    signal, other_end = multiprocessing.Pipe()
    besieger = in_process(besiege, address, idle, slow, body_bytes, other_end)
    assert signal.poll(HANG_S), "the page takes no more requests"
    yield
    signal.send("stop")
    besieger.join(HANG_S)
    assert besieger.exitcode == 0


@pytest.mark.deep
def test_besieged_page_leaves_capture_alone(tmp_path: Path) -> None:
    with Besieged(tmp_path / "session", max_files=1024) as capture:
        capture.answer("Homing")
        capture.answer("Step 1 of 3: Bright set")
        capture.wait_for("Step 2 of 3: Dark-scene set")
        assert capture.ask("frame.png").startswith(b"\x89PNG")
        # Whatever a capture and its page need has been in memory once
        capture.forget_highest_memory()
        before_mb = capture.memory_mb("VmRSS")
        with besieged(capture.address, idle=2000, slow=200, body_bytes=600_000_000):
            capture.answer("Step 2 of 3: Dark-scene set")
            capture.wait_for("Step 3 of 3: Dark frames")
            assert capture.memory_mb("VmHWM") - before_mb < 50.0
        assert status_of(capture.address) == status_of(capture.address + "frame.png") == 200
        capture.answer("Step 3 of 3: Dark frames")
        said = capture.end()
    assert "Traceback" not in said
    assert "the page" not in said
    verdict = verify(tmp_path / "session")
    assert (verdict.problems, verdict.present, verdict.sealed) == ((), FRAMES, True)


def test_a_silent_connection_is_closed(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capture_page, "_MAX_REQUEST_S", 0.05)
    parts = urllib.parse.urlsplit(running.address)
    beginnings = (b"", b"GET / HT", f"POST {parts.path}press HTTP/1.1\r\nHost: 127.0.0.1\r\n".encode())
    for beginning in beginnings:
        with socket.create_connection((parts.hostname, parts.port), HANG_S) as connection:
            connection.sendall(beginning)
            with suppress(ConnectionResetError):
                assert connection.recv(1) == b""


def test_who_does_not_read_the_answer_is_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capture_page, "_MAX_REQUEST_S", 0.05)
    monkeypatch.setattr(capture_page, "_state", lambda panel: "x" * 50_000_000)
    with serve_page(CapturePanel(unattended=True)) as address:
        parts = urllib.parse.urlsplit(address)
        with socket.create_connection((parts.hostname, parts.port), HANG_S) as connection:
            connection.sendall(f"GET {parts.path}state HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
            read = 0
            with suppress(ConnectionResetError):
                while data := connection.recv(256):  # takes far longer than the page allows
                    read += len(data)
            assert read < 50_000_000
        assert status_of(address) == 200


def test_what_fails_in_the_page_stays_there(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    def fail(panel: CapturePanel) -> NoReturn:
        raise ZeroDivisionError

    monkeypatch.setattr(capture_page, "_state", fail)
    with serve_page(CapturePanel(unattended=True)) as address:
        assert status_of(address + "state") == 500
        assert status_of(address) == 200
    assert capfd.readouterr() == ("", "")
    assert caplog.messages == []


def _rig(tmp_path: Path) -> Path:
    """Return a rig.toml of a small simulated rig."""
    path = tmp_path / "rig.toml"
    assert cli.run(["init", str(path)]) == 0
    text = path.read_text().replace("size_px = [640, 480]", "size_px = [64, 48]")
    path.write_text(text.replace("rows = 7\ncolumns = 7", "rows = 1\ncolumns = 2"))
    return path


def test_the_terminal_shows_the_address_and_no_log_holds_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig, session, log = _rig(tmp_path), tmp_path / "session", tmp_path / "day.log"
    assert cli.run(["capture", str(rig), str(session), "--yes", "--page", "--log", str(log)]) == 0
    [token] = re.findall(r"page: http://127\.0\.0\.1:\d+/(\S+)/\n", capsys.readouterr().err)
    assert re.search(r"INFO page: http://127\.0\.0\.1:\d+/\(concealed\)/\n", log.read_text())
    for path in (log, *session.rglob("*.*")):
        assert token.encode() not in path.read_bytes()


def test_a_capture_that_gets_no_page_goes_on_if_it_can(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object) -> NoReturn:
        raise OSError(errno.EMFILE, "Too many open files")

    rig, session = _rig(tmp_path), tmp_path / "session"
    monkeypatch.setattr("socket.create_server", refuse)
    assert cli.run(["capture", str(rig), str(session), "--page"]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith(
        "faintfield: CaptureStopped: there is no page ([Errno 24] Too many open files) and no terminal"
    )
    assert cli.run(["capture", str(rig), str(session), "--page", "--yes"]) == 0
    assert "warning: there is no page ([Errno 24] Too many open files); " in capsys.readouterr().err
    assert verify(session).sealed


def test_a_capture_whose_page_fails_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def fail(*_: object, **__: object) -> NoReturn:
        raise OSError(errno.EMFILE, "Too many open files")

    rig, session = _rig(tmp_path), tmp_path / "session"
    monkeypatch.setattr("uvicorn.Server.serve", fail)
    assert cli.run(["capture", str(rig), str(session), "--page", "--yes"]) == 0
    assert "warning: the page has ended (OSError: [Errno 24] Too many open files); " in capsys.readouterr().err
    assert verify(session).sealed


def test_pixels_that_are_no_numbers_are_no_frame(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "frame.tiff", np.array([[1.0, np.nan]], np.float32))
    with pytest.raises(CameraError, match=r"values that are no numbers; "):
        guided.read_pixels(tmp_path / "frame.tiff")
