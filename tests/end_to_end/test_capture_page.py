"""The page of a capture, in a real headless browser: what the terminal can do it can do, and the two agree."""

import base64
import http.client
import threading
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np
import pytest

from faintfield.pipelines.live.capture_page import serve_page
from faintfield.pipelines.live.panel import CapturePanel
from faintfield.pipelines.live.terminal import TerminalView
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.errors import CaptureStopped, RigError
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan
from faintfield.rig.session.verify import verify
from tests.end_to_end.browser import CHROMIUM, Tab, open_browser
from tests.faults.capturing import FRAMES, SMALL_RIG
from tests.patience import HANG_S

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here: the page is not tried in one")


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


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with open_browser(tmp_path_factory.mktemp("browser")) as tab:
        yield tab


@needs_browser
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
    assert browser.evaluate("document.querySelectorAll('#grid span').length") == 6
    assert browser.evaluate("document.querySelectorAll('#histogram path').length") == 1
    # Pages of other tests may complain that their capture has ended
    assert [it for it in browser.complaints if running.address in it] == []


@needs_browser
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


@needs_browser
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


def test_another_host_name_is_refused(running: Running) -> None:
    parts = urllib.parse.urlsplit(running.address)
    connection = http.client.HTTPConnection(parts.netloc)
    connection.request("GET", parts.path + "state", headers={"Host": "evil.example"})
    assert connection.getresponse().status == 400
    connection.close()


@pytest.mark.parametrize(
    "body", [b"", b"[]", b'{"word": "explode"}', b'{"word": "go", "more": 1}', b'{"word": 5}', b"x" * 100_000]
)
def test_nonsense_presses_no_button(running: Running, body: bytes) -> None:
    assert status_of(running.address + "press", body) == 400


def test_one_page_has_another_token_than_the_next() -> None:
    with serve_page(CapturePanel(unattended=True)) as one, serve_page(CapturePanel(unattended=True)) as other:
        assert urllib.parse.urlsplit(one).path != urllib.parse.urlsplit(other).path
