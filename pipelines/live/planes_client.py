"""The capture's side of live planes: start their process, tell it which frames are there, and read what it shows.

Nothing here waits for the process, and nothing that happens to it reaches the capture: a thread writes to its pipe, the
page reads its files, and the session is not touched.
"""

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from shutil import rmtree
from signal import Signals
from typing import IO

import msgspec

from faintfield.pipelines.console import inform
from faintfield.pipelines.live.planes_messages import (
    STATUS_FILE,
    LiveFrame,
    LiveNews,
    LiveOrder,
    LiveStatus,
    is_picture_name,
    plane_of,
)
from faintfield.rig.files import read_regular

_MODULE = "faintfield.pipelines.live.planes_process"

# One thread for everything, and no modules from the current folder, which may be a stranger's.
_ENVIRONMENT = {
    **dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
    "PYTHONSAFEPATH": "1",
}

# The least of all priorities: it runs when nothing else wants the processor.
_NICENESS = 19

# Limits of the files that the process writes, in bytes; a picture has about a million pixels.
_MAX_STATUS_BYTES, _MAX_PICTURE_BYTES = 10_000_000, 20_000_000

# The end of the capture waits no longer for the process, which is killed, to be gone.
_MAX_FAREWELL_S = 5.0


class PlanesClient:
    """Live planes, as the capture and its page see them.

    Parameters
    ----------
    order : LiveOrder
        What to compute; its folder `out` exists.
    frames : callable
        Returns all valid frames of the dark scene; called in another thread.

    Raises
    ------
    OSError
        The process cannot be started.
    """

    def __init__(self, order: LiveOrder, frames: Callable[[], tuple[LiveFrame, ...]]) -> None:
        self._order, self._frames = order, frames
        self._out = Path(order.out)
        self._changed = threading.Event()
        self._ending = False
        self._depth = 0
        self._process = subprocess.Popen(
            [sys.executable, "-m", _MODULE],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | _ENVIRONMENT,
            process_group=0,  # Ctrl-C is for the capture, which ends this process
        )
        with suppress(OSError):  # at once: loading its modules is work, too
            os.setpriority(os.PRIO_PROCESS, self._process.pid, _NICENESS)
        assert self._process.stdin is not None
        threading.Thread(target=self._tell, args=(self._process.stdin,), daemon=True, name="live planes").start()

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def note_change(self) -> None:
        """Note that frames may have come or gone; costs nothing, as a thread does the rest."""
        self._changed.set()

    def end(self) -> None:
        """End the process, whatever it does; say so if it had ended before."""
        ended = self.ended()
        if ended is not None:
            inform(f"warning: {ended}")
        self._ending = True
        self._changed.set()
        with suppress(OSError):
            self._process.kill()  # a stopped process, too
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_MAX_FAREWELL_S)

    def ended(self) -> str | None:
        """Return that the process has ended, and how; None while it runs."""
        code = self._process.poll()
        if code is None or self._ending:
            return None
        how = f"by signal {_signal_name(-code)}" if code < 0 else f"with code {code}"
        return f"live planes ended ({how}); the capture goes on without them"

    def status(self) -> LiveStatus | None:
        """Return what the process says of itself, None if it has not said anything yet."""
        try:
            return msgspec.json.decode(read_regular(self._out / STATUS_FILE, _MAX_STATUS_BYTES), type=LiveStatus)
        except (OSError, msgspec.DecodeError, UnicodeDecodeError):
            return None

    def silence_s(self) -> float:
        """Return how long ago the process said something; 0 if it never did."""
        try:
            return max(time.time() - (self._out / STATUS_FILE).stat().st_mtime, 0.0)
        except OSError:
            return 0.0

    def offered(self) -> int:
        """Return the number of frames of the dark scene that are there."""
        return len(self._frames())

    def picture(self, name: str) -> bytes | None:
        """Return the content of a picture, None if there is none of that name; the plane shown is computed first."""
        if not is_picture_name(name):
            return None
        shown = plane_of(name)
        if shown is not None and shown != self._depth and shown < len(self._order.depths_mm):
            self._depth = shown
            self._changed.set()
        try:
            return read_regular(self._out / name, _MAX_PICTURE_BYTES)
        except OSError:
            return None

    def _tell(self, pipe: IO[bytes]) -> None:
        """Write the order, and the news whenever there are any; blocks when the process does not read, alone."""
        told: LiveNews | None = None
        with suppress(OSError, ValueError):  # the process has ended
            pipe.write(msgspec.json.encode(self._order) + b"\n")
            while not self._ending:
                news = LiveNews(self._frames(), self._depth)
                if news != told:
                    pipe.write(msgspec.json.encode(news) + b"\n")
                    pipe.flush()
                    told = news
                self._changed.wait()
                self._changed.clear()
        with suppress(OSError):
            pipe.close()


def _signal_name(number: int) -> str:
    """Return the name of a signal, or its number."""
    try:
        return Signals(number).name
    except ValueError:
        return str(number)


@contextmanager
def live_planes(order: LiveOrder, frames: Callable[[], tuple[LiveFrame, ...]]) -> Iterator[PlanesClient | None]:
    """Compute live planes while the block runs; None if that fails to begin, which is said and harms nothing else.

    The folder `out` of `order` is replaced by a temporary one, which is removed at the end.
    """
    try:
        folder = tempfile.mkdtemp(prefix="faintfield-live-")
    except OSError as failure:
        inform(f"warning: there are no live planes ({failure}); the capture goes on without them")
        yield None
        return
    try:
        try:
            client = PlanesClient(msgspec.structs.replace(order, out=folder), frames)
        except OSError as failure:
            inform(f"warning: there are no live planes ({failure}); the capture goes on without them")
            yield None
            return
        try:
            yield client
        finally:
            client.end()
    finally:
        rmtree(folder, ignore_errors=True)
