"""Control a real Chromium by its DevTools protocol over a pipe, and make requests without it."""

import base64
import http.client
import json
import os
import shutil
import subprocess
import sys
import urllib.parse
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.patience import HANG_S

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
# Chromium expects the pipes at descriptors 3 and 4; the detour by 103 and 104 helps if they are 3 or 4 already.
_LAUNCH = (
    "import os, sys; os.dup2(int(sys.argv[1]), 103); os.dup2(int(sys.argv[2]), 104); os.dup2(103, 3); "
    "os.dup2(104, 4); os.execv(sys.argv[3], sys.argv[3:])"
)


class Tab:
    """One page of the browser."""

    def __init__(self, send: int, receive: int) -> None:
        self._send = send
        self._receive = receive
        self._buffer = b""
        self._number = 0
        self.complaints: list[str] = []
        target = self._call("Target.createTarget", {"url": "about:blank"}, None)["targetId"]
        self._session = self._call("Target.attachToTarget", {"targetId": target, "flatten": True}, None)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol on this page."""
        return self._call(method, parameters, self._session)

    def open(self, url: str) -> None:
        """Go to an address."""
        self.call("Page.navigate", url=url)

    def set_slider(self, name: str, value: float) -> None:
        """Move a slider as a hand does: by its value and its event."""
        self._set(name, str(value), "input")

    def choose(self, name: str, option: str) -> None:
        """Choose an option of a list by its value or its text."""
        words = json.dumps(option)
        same = f"[...box.options].find(it => it.text === {words} || it.value === {words}).value"
        self._set(name, same, "input", "change")
        self.draw()

    def _set(self, name: str, value: str, *events: str) -> None:
        fire = "; ".join(f"box.dispatchEvent(new Event('{event}', {{bubbles: true}}))" for event in events)
        self.evaluate(f"(box => {{ box.value = {value}; {fire}; }})(document.getElementById('{name}'))")

    def box(self, selector: str) -> tuple[float, float, float, float]:
        """Return left, top, width and height of an element on the screen, in pixels."""
        box = f"document.querySelector('{selector}').getBoundingClientRect()"
        left, top, width, height = self.evaluate(f"(box => [box.left, box.top, box.width, box.height])({box})")
        return left, top, width, height

    def screen(self) -> NDArray[np.uint8]:
        """Return what the screen shows (row, column, BGR)."""
        return decoded(self.call("Page.captureScreenshot", format="png")["data"])

    def reload(self) -> None:
        """Load the page again and wait for it: a call to the old page would never be answered."""
        self.call("Page.reload")
        while self._next().get("method") != "Page.loadEventFired":
            pass

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression, waiting for it if it is a promise."""
        answer = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            raise AssertionError(answer["exceptionDetails"])
        return answer["result"].get("value")

    def wait_until(self, condition: str) -> None:
        """Wait in the page until a JavaScript condition holds."""
        done = self.evaluate(
            f"""new Promise((resolve) => {{
                const begun = Date.now();
                const look = () => {{
                    let holds = false;
                    try {{ holds = Boolean({condition}); }} catch {{}}
                    if (holds || Date.now() - begun > {1000 * HANG_S}) resolve(holds);
                    else setTimeout(look, 20);
                }};
                look();
            }})"""
        )
        assert done, f"did not come true: {condition}; the page says: {self.text()}"

    def text(self) -> str:
        """Return the visible text of the page."""
        return str(self.evaluate("document.body.innerText"))

    def click(self, word: str) -> None:
        """Wait for a button and click it."""
        button = f"document.querySelector('button[data-word={word}]:not(:disabled)')"
        self.wait_until(button)
        self.evaluate(f"{button}.click()")

    def resize(self, width: int, height: int = 1000) -> None:
        """Give the page a screen of this size, of a phone if narrow."""
        mobile = width < 500
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=mobile)

    def draw(self) -> None:
        """Wait until everything requested is drawn."""
        self.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def _call(self, method: str, parameters: dict[str, Any], session: str | None) -> dict[str, Any]:
        """Send a request and return its result."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        os.write(self._send, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return dict(answer["result"])

    def _next(self) -> dict[str, Any]:
        """Return the next message, and keep it if it reports an error."""
        while b"\0" not in self._buffer:
            data = os.read(self._receive, 1 << 16)
            assert data, "the browser has ended"
            self._buffer += data
        message, _, self._buffer = self._buffer.partition(b"\0")
        event = json.loads(message)
        if event.get("method") == "Runtime.exceptionThrown" or (
            event.get("method") == "Log.entryAdded" and event["params"]["entry"]["level"] == "error"
        ):
            self.complaints.append(json.dumps(event["params"]))
        return dict(event)


def decoded(picture: str) -> NDArray[np.uint8]:
    """Return the pixels (row, column, BGR) of a picture in base64."""
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(picture), np.uint8), cv2.IMREAD_COLOR)
    return np.asarray(pixels, np.uint8)


@contextmanager
def open_browser(folder: Path) -> Iterator[Tab]:
    """Run a headless browser that keeps its files in `folder`; yield its tab."""
    assert CHROMIUM is not None
    to_browser, send = os.pipe()
    receive, from_browser = os.pipe()
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe"]
    launch = [sys.executable, "-c", _LAUNCH, str(to_browser), str(from_browser)]
    command = [*launch, CHROMIUM, *options, f"--user-data-dir={folder}"]
    browser = subprocess.Popen(command, pass_fds=(to_browser, from_browser), stderr=subprocess.DEVNULL)
    os.close(to_browser)
    os.close(from_browser)
    try:
        yield Tab(send, receive)
    finally:
        browser.kill()
        browser.wait()
        os.close(send)
        os.close(receive)


def answer_to(address: str, method: str = "GET", body: bytes | None = None, **headers: str) -> http.client.HTTPResponse:
    """Return the answer to a request with these headers, for an address that is sent as it is written."""
    host = urllib.parse.urlsplit(address).netloc
    with closing(http.client.HTTPConnection(host)) as connection:
        connection.request(method, address.removeprefix(f"http://{host}"), body, headers)
        return connection.getresponse()
