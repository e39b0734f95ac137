"""The capture's side of live planes: the messages to and from the process that computes them, and its pictures.

Nothing here waits for the process, and nothing that happens to it reaches the capture: one thread sends, another
receives, and the session is not touched. The process sends states and pictures, which are pairs of a name and a PNG.
"""

import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Literal

from msgspec import Struct

from faintfield.pipelines.console import inform

type PictureKind = Literal["view", "mean", "pmlem"]

# Most planes: each takes about 40 MB.
MAX_DEPTHS = 32

# One thread for everything, and no modules from the current folder, which may be a stranger's.
_ENVIRONMENT = {
    **dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
    "PYTHONSAFEPATH": "1",
}

# The least of all priorities: it runs when nothing else wants the processor.
_NICENESS = 19

# The end of the capture waits no longer for the process, which is killed, to be gone.
_MAX_FAREWELL_S = 5.0


class LiveOrder(Struct, frozen=True):
    """Request for live planes: the first message to their process.

    Without `noise` and `geometry`, results of `faintfield noise` and `faintfield geometry` are taken from the session
    or from beside its rig.toml; the focal length is for the case that no geometry.json is found.
    """

    session: Path
    rig: Path
    depths_mm: tuple[float, ...]
    noise: Path | None = None
    geometry: Path | None = None
    fx_px: float | None = None


class LiveFrame(Struct, frozen=True):
    """A valid frame of the dark scene; `intent` is the number of its exposure, which no other frame has."""

    intent: int
    file: str
    node: tuple[int, int]
    exposure_s: float


class LiveNews(Struct, frozen=True):
    """All valid frames of the dark scene now, and the index of the depth that the page shows: every further message."""

    frames: tuple[LiveFrame, ...]
    depth: int


class PictureStatus(Struct, frozen=True):
    """A picture that is there: from how many nodes, and the electrons per pixel that are black and white in it."""

    version: int
    nodes: int
    black: float
    white: float


class PlaneStatus(Struct, frozen=True):
    """One depth: its pictures, and the power of the detail that two halves of the views agree on, with its σ."""

    depth_mm: float
    pictures: dict[str, PictureStatus] = {}
    focus: float = 0.0
    focus_sigma: float = 0.0


class LiveStatus(Struct, frozen=True):
    """State of the live planes, as the page shows it.

    `frames` and `nodes` are those added up so far, `poses` and `noise` name kinds and sources, `pmlem` is the progress
    of PMLEM or why it is left out, `bins` are so many pixels wide, and the nodes `with_picture` have one of their
    latest frame. `planes` are in the order of `LiveOrder`.
    """

    doing: str
    frames: int = 0
    nodes: int = 0
    planned_nodes: int = 0
    poses: str = ""
    noise: str = ""
    pmlem: str = ""
    unit: str = "e⁻/px"
    bins: int = 1
    planes: tuple[PlaneStatus, ...] = ()
    with_picture: tuple[tuple[int, int], ...] = ()
    problems: tuple[str, ...] = ()


class PlanesClient:
    """Live planes, as the capture and its page see them; `frames`, called in another thread, returns the valid ones.

    `status` is the latest state of the process, of number `pid`; None before the first. Raises OSError if the process
    cannot be started.
    """

    def __init__(self, order: LiveOrder, frames: Callable[[], tuple[LiveFrame, ...]]) -> None:
        self.status: LiveStatus | None = None
        self._frames = frames
        self._pictures: dict[str, bytes] = {}
        self._heard_s = time.monotonic()
        self._changed = threading.Event()
        self._ending = False
        self._depth = 0
        line, end = Pipe()
        with end:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "faintfield.pipelines.live.planes_process", str(end.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=os.environ | _ENVIRONMENT,
                pass_fds=[end.fileno()],
                process_group=0,  # Ctrl-C is for the capture, which ends this process
            )
        self.pid = self._process.pid
        with suppress(OSError):  # at once: loading its modules is work, too
            os.setpriority(os.PRIO_PROCESS, self.pid, _NICENESS)
        threading.Thread(target=self._send, args=(line, order), daemon=True, name="frames to live planes").start()
        threading.Thread(target=self._receive, args=(line,), daemon=True, name="live planes").start()

    def note_change(self) -> None:
        """Note that frames may have come or gone; costs nothing, as a thread does the rest."""
        self._changed.set()

    def end(self) -> None:
        """End the process, whatever it does; say so if it had ended before."""
        if (failure := self.failure()) is not None:
            inform(f"warning: {failure}")
        self._ending = True
        self._changed.set()
        self._process.kill()  # a stopped process, too
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_MAX_FAREWELL_S)

    def failure(self) -> str | None:
        """Return that the process has ended, and how; None while it runs."""
        code = self._process.poll()
        if code is None or self._ending:
            return None
        how = f"by signal {-code}" if code < 0 else f"with code {code}"
        return f"live planes ended ({how}); the capture goes on without them"

    def silence_s(self) -> float:
        """Return the time since the last message of the process."""
        return time.monotonic() - self._heard_s

    def frame_count(self) -> int:
        """Return the number of valid frames of the dark scene."""
        return len(self._frames())

    def picture(self, name: str) -> bytes | None:
        """Return a picture as PNG, None if there is none of that name; its plane is computed first from now on."""
        match = re.match(r"plane_(\d{3})_", name)
        if match is not None and int(match[1]) != self._depth:
            self._depth = int(match[1])
            self._changed.set()
        return self._pictures.get(name)

    def _send(self, line: Connection, order: LiveOrder) -> None:
        """Send the order, and frames and depth whenever they change; blocks while the process does not read."""
        sent: LiveNews | None = None
        with suppress(OSError):  # the process has ended
            line.send(order)
            while not self._ending:
                news = LiveNews(self._frames(), self._depth)
                if news != sent:
                    line.send(news)
                    sent = news
                self._changed.wait()
                self._changed.clear()

    def _receive(self, line: Connection) -> None:
        with suppress(EOFError, OSError):  # the process has ended
            while True:
                message: LiveStatus | tuple[str, bytes] = line.recv()
                self._heard_s = time.monotonic()
                if isinstance(message, LiveStatus):
                    self.status = message
                else:
                    name, png = message
                    self._pictures[name] = png


@contextmanager
def live_planes(order: LiveOrder, frames: Callable[[], tuple[LiveFrame, ...]]) -> Iterator[PlanesClient | None]:
    """Compute live planes while the block runs; None if that fails to begin, which is said and harms nothing else."""
    try:
        client = PlanesClient(order, frames)
    except OSError as failure:
        inform(f"warning: there are no live planes ({failure}); the capture goes on without them")
        yield None
        return
    try:
        yield client
    finally:
        client.end()
