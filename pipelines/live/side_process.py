"""A process beside the capture: it gets an order and news of the session, and sends messages.

Nothing here waits for the process, and nothing that happens to it reaches the capture: one thread sends, another
receives, and the session is not touched.
"""

import os
import select
import subprocess
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, Protocol

from faintfield.pipelines.console import inform

# One thread for everything, and no modules from the current folder, which may be a stranger's.
_ENVIRONMENT = {
    **dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
    "PYTHONSAFEPATH": "1",
}

# The least of all priorities: it runs when nothing else wants the processor.
_NICENESS = 19

# The end of the capture waits no longer for the process, which is killed, to be gone.
_MAX_FAREWELL_S = 5.0


class SideProcess(ABC):
    """A process that runs `module` of this package at the lowest priority, as the capture sees it.

    It first gets `order`, then the result of `news()` whenever that has changed; `receive` is called with each of its
    messages, in another thread. It has the number `pid`; messages call it `name`, in the plural. Raises OSError if it
    cannot be started.
    """

    _process: subprocess.Popen[bytes]

    def __init__(self, module: str, name: str, order: object) -> None:
        self._name = name
        self._heard_s = time.monotonic()
        self._changed = threading.Event()
        self._ending = False
        if sys.platform == "win32":
            raise OSError("on Windows no process is started beside the capture")
        line, end = Pipe()
        with end:
            self._process = subprocess.Popen(
                [sys.executable, "-m", f"faintfield.pipelines.live.{module}", str(end.fileno())],
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
        threading.Thread(target=self._send, args=(line, order), daemon=True, name=f"news to {name}").start()
        threading.Thread(target=self._listen, args=(line,), daemon=True, name=name).start()

    @abstractmethod
    def news(self) -> object:
        """Return what the process is to know now."""

    @abstractmethod
    def receive(self, message: Any) -> None:
        """Take a message of the process."""

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
        return f"{self._name} ended ({how}); the capture goes on without them"

    def silence_s(self) -> float:
        """Return the time since the last message of the process."""
        return time.monotonic() - self._heard_s

    def _send(self, line: Connection, order: object) -> None:
        """Send the order, and news whenever they change; blocks while the process does not read."""
        sent: object = None
        with suppress(OSError):  # the process has ended
            line.send(order)
            while not self._ending:
                news = self.news()
                if news != sent:
                    line.send(news)
                    sent = news
                self._changed.wait()
                self._changed.clear()

    def _listen(self, line: Connection) -> None:
        with suppress(EOFError, OSError):  # the process has ended
            while True:
                message = line.recv()
                self._heard_s = time.monotonic()
                self.receive(message)


@contextmanager
def running[Process: SideProcess](start: Callable[[], Process], name: str) -> Iterator[Process | None]:
    """Run a process while the block runs; None if it cannot be started, which is said and harms nothing else."""
    try:
        process = start()
    except OSError as failure:
        inform(f"warning: there are no {name} ({failure}); the capture goes on without them")
        yield None
        return
    try:
        yield process
    finally:
        process.end()


class Line(Protocol):
    """The process's end of its connection with the capture."""

    def poll(self) -> bool:
        """Return whether a message waits."""

    def recv(self) -> Any:
        """Return the next message, waiting for it; raises EOFError when the capture has ended."""

    def send(self, message: Any, /) -> None:
        """Send a message."""


def newest_news(line: Line, *, wait: bool) -> Any:
    """Return the newest of the news that have come, waiting for one if asked to; None without any."""
    news = line.recv() if wait else None
    while line.poll():
        news = line.recv()
    return news


def serve(follow: Callable[[Any, Connection], None], ended: Callable[[str], object]) -> None:
    """Serve the connection whose number is the argument of this process, until the capture ends.

    `follow` gets the order and the connection; `ended` returns the message that tells of its failure.
    """
    line = Connection(int(sys.argv[1]))
    _end_with_capture(line)
    try:
        follow(line.recv(), line)
    except (EOFError, ConnectionError):  # the capture has ended
        return
    except Exception as failure:
        line.send(ended(f"{type(failure).__name__}: {failure}"))
        raise


def _end_with_capture(line: Connection) -> None:
    """End this process, in the middle of a step, when the capture has hung up, however it ended."""

    def watch() -> None:
        if sys.platform == "win32":
            return
        hang_up = select.poll()
        hang_up.register(line.fileno(), 0)  # a hang-up is always told
        hang_up.poll()
        os._exit(0)

    threading.Thread(target=watch, daemon=True, name="end with the capture").start()
