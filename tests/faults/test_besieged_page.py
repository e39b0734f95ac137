"""A page under siege: silent connections and bad requests leave the capture alone."""

import http.client
import json
import re
import resource
import socket
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from faintfield.rig.session.verify import verify
from tests.faults.capturing import FRAMES
from tests.patience import HANG_S

_PATIENCE_S = 60.0
_CHUNK = b"x" * (1 << 16)
_CAPTURE = """
import resource, sys
from pathlib import Path
from faintfield.pipelines.live.guided import capture_session
from tests.faults.capturing import SMALL_RIG
resource.setrlimit(resource.RLIMIT_NOFILE, (1024, 1024))
capture_session(SMALL_RIG, Path(sys.argv[1]), unattended=False, page=True)
"""


def besiege(address: str, idle: int, body_bytes: int, made: threading.Event, stop: threading.Event) -> None:
    """Open silent connections, and go round all bad requests until told to stop; `made` is set after one round."""
    place = (urlsplit(address).hostname or "", urlsplit(address).port or 0)
    with ExitStack() as stack:
        for _ in range(idle):
            silent = stack.enter_context(socket.socket())
            silent.setblocking(False)
            silent.connect_ex(place)
        while not stop.is_set():
            for beginning, more in _bad_requests(address, body_bytes):
                with suppress(OSError), socket.create_connection(place, _PATIENCE_S) as connection:
                    connection.sendall(beginning)
                    for _ in range(more // len(_CHUNK)):
                        connection.sendall(_CHUNK)
            made.set()


def _bad_requests(address: str, body_bytes: int) -> Iterator[tuple[bytes, int]]:
    """Yield the beginning of each bad request, and how many bytes follow it."""
    parts = urlsplit(address)
    host, token = f"Host: {parts.netloc}\r\n".encode(), parts.path.encode()
    length = f"Content-Length: {body_bytes}\r\n\r\n".encode()
    yield b"POST " + token + b"press HTTP/1.1\r\n" + host + length, body_bytes
    yield b"POST " + token + b"press HTTP/1.1\r\n" + host + b"Transfer-Encoding: chunked\r\n\r\nfffffff\r\n", body_bytes
    yield b"POST /press HTTP/1.1\r\n" + host + length, body_bytes
    yield b"GET " + token + b"state HTTP/1.1\r\n" + host + length, body_bytes
    yield b"GET " + token + b"state HTTP/1.1\r\n" + host + b"X: ", body_bytes
    yield b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\n" + host + b"\r\n", 0
    yield b"GET / HTTP/1.1\r\n" + host + b"".join(b"X-%d: y\r\n" % number for number in range(10_000)) + b"\r\n", 0
    yield b"GET /" + token[:-2] + b"/state HTTP/1.1\r\n" + host + b"\r\n", 0
    yield b"OPTIONS * HTTP/1.1\r\n" + host + b"\r\n", 0
    yield b"GET / HTTP/1.1\r\n" + host + b"Connection: Upgrade\r\nUpgrade: websocket\r\n\r\n", 0
    yield b"POST " + token + b"press HTTP/1.1\r\n" + host + b"Content-Length: -1\r\n\r\n", 0
    yield b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(range(256)), 0
    yield b"\r\n\r\n\r\n\x00\x00", 0
    yield (b"GET " + token + b"frame.png HTTP/1.1\r\n" + host + b"\r\n") * 1000, 0
    yield b"", 0


class Capture:
    """A capture with a page in a process of its own, and the page's user."""

    def __init__(self, process: subprocess.Popen[str], address: str) -> None:
        self._process, self._address = process, address

    def ask(self, place: str, data: bytes | None = None) -> bytes:
        """Ask the page as a browser does: until an answer comes."""
        for _ in range(10_000):
            assert self._process.poll() is None, "the capture has ended"
            request = self._address + place
            with suppress(OSError, http.client.HTTPException), urllib.request.urlopen(request, data) as answer:
                return bytes(answer.read())
        raise AssertionError(f"{place}: no answer")

    def wait_for(self, title: str) -> int:
        """Wait for the prompt with this title, and return its number."""
        while (state := json.loads(self.ask("state")))["prompt"] is None or state["title"] != title:
            pass
        return int(state["prompt"])

    def go_on(self, title: str) -> None:
        """Wait for the prompt with this title, and go on."""
        self.ask("press", json.dumps({"word": "go", "prompt": self.wait_for(title)}).encode())

    def memory_mb(self, which: str) -> float:
        """Return `VmRSS`, the memory in use, or `VmHWM`, its highest value since it was last forgotten."""
        status = Path(f"/proc/{self._process.pid}/status").read_text()
        return int(re.search(rf"{which}:\s+(\d+) kB", status)[1]) / 1000  # type: ignore[index]


@contextmanager
def besieged(address: str, idle: int, body_bytes: int) -> Iterator[None]:
    """Besiege a page while the block runs, which begins when every connection is open and every request was made."""
    _, most_files = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(idle + 1000, most_files), most_files))
    made, stop = threading.Event(), threading.Event()
    with ThreadPoolExecutor() as threads:
        siege = threads.submit(besiege, address, idle, body_bytes, made, stop)
        try:
            assert made.wait(HANG_S), "the page takes no more requests"
            yield
        finally:
            stop.set()
        siege.result()


@pytest.mark.deep
def test_besieged_page_leaves_capture_alone(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _CAPTURE, str(tmp_path / "session")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2]) as process:
        try:
            assert process.stderr is not None
            line = next(line for line in process.stderr if line.startswith("page: "))
            address = line.removeprefix("page: ").strip()
            capture = Capture(process, address)
            capture.go_on("Homing")
            capture.go_on("Step 1 of 3: Bright set")
            capture.wait_for("Step 2 of 3: Dark-scene set")
            assert capture.ask("frame.png").startswith(b"\x89PNG")
            # Whatever a capture and its page need has been in memory once: forget its highest value
            Path(f"/proc/{process.pid}/clear_refs").write_text("5")
            before_mb = capture.memory_mb("VmRSS")
            with besieged(address, idle=2000, body_bytes=600_000_000):
                capture.go_on("Step 2 of 3: Dark-scene set")
                capture.wait_for("Step 3 of 3: Dark frames")
                assert capture.memory_mb("VmHWM") - before_mb < 50.0
            capture.ask("frame.png")
            capture.go_on("Step 3 of 3: Dark frames")
            _, complaint = process.communicate(timeout=HANG_S)
        finally:
            process.kill()
    assert process.returncode == 0, complaint
    assert "Traceback" not in complaint
    assert "the page" not in complaint
    verdict = verify(tmp_path / "session")
    assert (verdict.problems, verdict.present, verdict.sealed) == ((), FRAMES, True)
