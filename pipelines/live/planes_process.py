"""The process of live planes: reads which frames there are, line by line, and writes pictures and its state.

It is started by `pipelines.live.planes_client`, reads frames and calibrations, and writes into the folder that it is
given alone. It ends with the capture. Several frames that wait are taken newest first; PMLEM runs when none does.
"""

import os
import signal
import sys
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from shutil import rmtree
from typing import BinaryIO

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.errors import InputError
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import encoded, grey_levels
from faintfield.pipelines.live.planes_messages import (
    PICTURE_KINDS,
    STATUS_FILE,
    LiveFrame,
    LiveNews,
    LiveOrder,
    LiveStatus,
    PictureKind,
    PictureStatus,
    PlaneStatus,
    node_picture_name,
    picture_name,
)
from faintfield.pipelines.live.planes_scene import LiveScene, dark_frames, live_scene
from faintfield.pipelines.live.planes_so_far import MAX_STACK_BYTES, PlanesSoFar
from faintfield.pipelines.live.terminal import display_levels
from faintfield.recon.compiling import on_compiling
from faintfield.recon.errors import ReconstructionError
from faintfield.rig.errors import RigError
from faintfield.rig.session.session import FRAMES, read_plan

# Black and white of a picture are these quantiles of its covered samples, from about so many of them.
_QUANTILES = (0.005, 0.998)
_QUANTILE_SAMPLES = 100_000

# Width of the pictures of frames, in pixels.
_FRAME_WIDTH_PX = 640

# Times that the folder is removed, in case that something is written into it meanwhile.
_REMOVALS = 10

# What may go wrong with one frame or one calibration, and is said on the page.
_FAILURES = (InputError, RigError, ReconstructionError)


class Inbox:
    """The lines of the capture, of which only the newest counts; a thread reads them.

    Parameters
    ----------
    lines : iterable of bytes
        What the capture writes; its end is the end of the capture.
    ended : threading.Event
        Set at the end.
    """

    def __init__(self, lines: Iterable[bytes], ended: threading.Event) -> None:
        self._lines, self._ended = lines, ended
        self._arrived = threading.Condition()
        self._news: LiveNews | None = None
        threading.Thread(target=self._read, daemon=True, name="inbox").start()

    def has_news(self) -> bool:
        """Return whether there are news that were not taken, or the capture has ended."""
        return self._news is not None or self._ended.is_set()

    def take(self, *, wait: bool) -> LiveNews | None:
        """Return the newest news since the last call; None if there are none, or the capture has ended."""
        with self._arrived:
            if wait:
                self._arrived.wait_for(self.has_news)
            news, self._news = self._news, None
            return news

    def _read(self) -> None:
        """Keep the newest of the lines."""
        try:
            for line in self._lines:
                news = msgspec.json.decode(line, type=LiveNews)
                with self._arrived:
                    self._news = news
                    self._arrived.notify()
        finally:
            with self._arrived:
                self._ended.set()
                self._arrived.notify()


class LivePlanes:
    """Planes of a session that is being captured, with their pictures.

    Parameters
    ----------
    order : LiveOrder
        What is asked for.
    inbox : Inbox
        Brings the news.
    """

    def __init__(self, order: LiveOrder, inbox: Inbox) -> None:
        self._order, self._inbox = order, inbox
        self._out, self._frames_folder = Path(order.out), Path(order.session) / FRAMES
        self._planes: PlanesSoFar | None = None
        self._wanted: dict[int, LiveFrame] = {}
        self._unusable: dict[int, str] = {}
        self._shown = 0
        self._stale: set[tuple[int, PictureKind]] = set()
        self._stale_focus: set[int] = set()
        self._with_picture: dict[tuple[int, int], None] = {}
        self._status = LiveStatus(
            "waiting for frames of the dark scene", planes=tuple(PlaneStatus(depth) for depth in order.depths_mm)
        )
        self._adding_s, self._added = 0.0, 0

    def run(self, ended: threading.Event) -> None:
        """Do what there is to do, one thing at a time, until the capture ends."""
        on_compiling.append(lambda: self._say("compiling; once, for some ten seconds"))
        busy = False
        self._say(self._status.doing)
        while not ended.is_set():
            news = self._inbox.take(wait=not busy)
            if news is not None:
                self._wanted = {frame.intent: frame for frame in news.frames}
                self._shown = min(max(news.depth, 0), len(self._order.depths_mm) - 1)
            busy = self._do_next()
            if not busy and self._wanted and self._planes is not None:
                self._say("up to date")

    def _do_next(self) -> bool:
        """Do what matters most; return whether anything was to be done."""
        if self._planes is None:
            return self._begin()
        planes = self._planes
        gone = [frame for intent, frame in planes.frames.items() if intent not in self._wanted]
        new = self._wanted.keys() - planes.frames.keys() - self._unusable.keys()
        if gone:
            self._remove(planes, gone[0])
        elif new:
            self._add(planes, self._wanted[max(new)])
        elif self._stale:
            self._draw(planes, min(self._stale, key=self._urgency))
        elif self._stale_focus:
            self._focus(planes, min(self._stale_focus, key=self._distance))
        elif (waiting := self._unrefined(planes)) is not None:
            self._refine(planes, waiting)
        else:
            return False
        return True

    def _begin(self) -> bool:
        """Find out what is known of the scene, once its first frame is there; return whether planes can begin."""
        if not self._wanted:
            return False
        first = self._wanted[max(self._wanted)]
        try:
            frozen = read_plan(Path(self._order.session))
            scene = live_scene(self._order, frozen, read_frame(self._frames_folder / first.file))
            self._say("computing where each pixel looks")
            self._planes = PlanesSoFar(scene, self._frames_folder, self._order.depths_mm)
        except _FAILURES as failure:
            self._say("waiting", problems=(str(failure),))
            return False
        self._say(
            "reading frames",
            poses=scene.poses,
            noise=scene.noise,
            unit=scene.unit,
            bins=scene.bins,
            planned_nodes=len({frame.stop.node for frame in dark_frames(frozen.plan)}),
            pmlem=self._why_no_pmlem(scene, self._planes),
            problems=(),
        )
        return True

    def _why_no_pmlem(self, scene: LiveScene, planes: PlanesSoFar) -> str:
        """Return why PMLEM is left out, or that no node is complete yet."""
        if not scene.knows_noise:
            return "PMLEM needs noise.json; run `faintfield noise`, or give --noise"
        if planes.stack_bytes > MAX_STACK_BYTES:
            return (
                f"PMLEM is left out: the images of all nodes take {planes.stack_bytes / 1e9:.1f} GB, at most "
                f"{MAX_STACK_BYTES / 1e9:.0f} GB are kept"
            )
        return "PMLEM begins when a node has all of its frames"

    def _add(self, planes: PlanesSoFar, frame: LiveFrame) -> None:
        """Add a frame, and show it on the plane that is looked at."""
        order = sorted(range(len(self._order.depths_mm)), key=self._distance)
        begun_s = time.perf_counter()
        try:
            electrons = planes.add(frame, order)
        except _FAILURES as failure:
            self._unusable[frame.intent] = str(failure)
            self._say(self._status.doing, problems=(*self._status.problems[-2:], str(failure)))
            return
        self._adding_s += time.perf_counter() - begun_s
        self._added += len(order)
        self._write(node_picture_name(frame.node), display_levels(electrons, _FRAME_WIDTH_PX))
        self._with_picture[frame.node] = None
        self._changed(planes, ("view", "mean"))
        for kind in ("view", "mean"):
            self._draw(planes, (self._shown, kind))

    def _remove(self, planes: PlanesSoFar, frame: LiveFrame) -> None:
        """Take a frame away that was declared void."""
        try:
            planes.remove(frame)
        except _FAILURES as failure:
            self._say(self._status.doing, problems=(*self._status.problems[-2:], str(failure)))
        self._changed(planes, ("mean",))

    def _changed(self, planes: PlanesSoFar, kinds: tuple[PictureKind, ...]) -> None:
        """Note which pictures have to be drawn again."""
        count = len(self._order.depths_mm)
        self._stale |= {(index, kind) for index in range(count) for kind in kinds}
        self._stale_focus |= set(range(count))
        self._say(
            "adding frames",
            frames=len(planes.frames),
            nodes=len(planes.nodes),
            with_picture=tuple(self._with_picture),
            seconds_per_plane=self._adding_s / max(self._added, 1),
        )

    def _draw(self, planes: PlanesSoFar, which: tuple[int, PictureKind]) -> None:
        """Write a picture, and its scale into the status."""
        index, kind = which
        self._stale.discard(which)
        found = planes.picture(index, kind)
        if found is None:
            return
        plane, covered, nodes = found
        black, white = stretch(plane, covered)
        self._write(picture_name(index, kind), grey_levels(np.where(covered, plane, black), white, black))
        before = self._status.planes[index]
        version = before.pictures[kind].version + 1 if kind in before.pictures else 1
        pictures = before.pictures | {kind: PictureStatus(version, nodes, black, white)}
        self._say_of(index, msgspec.structs.replace(before, pictures=pictures))

    def _focus(self, planes: PlanesSoFar, index: int) -> None:
        """Compute how sharp a plane is."""
        self._stale_focus.discard(index)
        found = planes.focus(index)
        plane = msgspec.structs.replace(self._status.planes[index], focus=found.detail_e2, focus_sigma=found.sigma_e2)
        self._say_of(index, plane)

    def _refine(self, planes: PlanesSoFar, index: int) -> None:
        """Run PMLEM on a plane until it is done, or there are news."""
        self._say(f"PMLEM of the plane at {self._order.depths_mm[index]:g} mm")
        planes.refine(index, self._inbox.has_news)
        count = planes.complete
        self._draw(planes, (index, "pmlem"))
        done = sum(planes.is_refined(other) for other in range(len(self._order.depths_mm)))
        self._say(
            self._status.doing, pmlem=f"PMLEM of {count} nodes: {done} of {len(self._order.depths_mm)} planes done"
        )

    def _unrefined(self, planes: PlanesSoFar) -> int | None:
        """Return the plane that PMLEM should take next, None if it is done with all."""
        left = [index for index in range(len(self._order.depths_mm)) if not planes.is_refined(index)]
        return min(left, key=self._distance, default=None)

    def _distance(self, index: int) -> tuple[int, int]:
        """Return how far a plane is from that which is looked at."""
        return abs(index - self._shown), index

    def _urgency(self, which: tuple[int, PictureKind]) -> tuple[tuple[int, int], int]:
        """Return the order in which pictures are drawn."""
        return self._distance(which[0]), PICTURE_KINDS.index(which[1])

    def _say_of(self, index: int, plane: PlaneStatus) -> None:
        """Change the state of one plane."""
        planes = list(self._status.planes)
        planes[index] = plane
        self._say(self._status.doing, planes=tuple(planes))

    def _say(self, doing: str, **changes: object) -> None:
        """Change the state, and write it."""
        self._status = msgspec.structs.replace(self._status, doing=doing, **changes)
        self._replace(STATUS_FILE, msgspec.json.encode(self._status))

    def _write(self, name: str, picture: NDArray[np.uint8]) -> None:
        """Write a picture."""
        self._replace(name, encoded(picture, ".png"))

    def _replace(self, name: str, content: bytes) -> None:
        """Write a file whole or not at all; it need not survive a power cut."""
        unfinished = self._out / f".{name}"
        unfinished.write_bytes(content)
        unfinished.replace(self._out / name)


def stretch(plane: NDArray[np.floating], covered: NDArray[np.bool_]) -> tuple[float, float]:
    """Return black and white of a picture: quantiles of its covered samples, a little apart from one another."""
    values = plane[covered]
    if not values.size:
        return 0.0, 1.0
    black, white = np.quantile(values[:: 1 + values.size // _QUANTILE_SAMPLES], _QUANTILES).tolist()
    return black, max(white, black + 1e-6)


def serve(lines: BinaryIO) -> None:
    """Do as the first line says, until the lines end."""
    order = msgspec.json.decode(lines.readline(), type=LiveOrder)
    ended = threading.Event()
    inbox = Inbox(lines, ended)
    ending = threading.Thread(target=_end_with_capture, args=(ended, Path(order.out)), daemon=True)
    ending.start()
    try:
        LivePlanes(order, inbox).run(ended)
    except Exception as failure:
        if not ended.is_set():
            status = LiveStatus("ended", problems=(f"{type(failure).__name__}: {failure}",))
            (Path(order.out) / STATUS_FILE).write_bytes(msgspec.json.encode(status))
            raise
    ending.join()  # which ends the process


def _end_with_capture(ended: threading.Event, out: Path) -> None:
    """Wait for the end of the capture, however it ended, remove what was written, and end."""
    ended.wait()
    for _ in range(_REMOVALS):
        rmtree(out, ignore_errors=True)
        if not out.exists():  # else a file was just being written
            break
    os._exit(0)


def main() -> None:
    """Serve the lines of standard input."""
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    serve(sys.stdin.buffer)


if __name__ == "__main__":
    main()
