"""Time per node of a capture in real time: `python -m benchmarks.speed.pace [FOLDER] [--size-px 1024] [--nodes 7]`.

A simulated GRBL controller answers over a pseudo-terminal at 115200 baud in a process of its own, and the camera takes
as long as its exposures. The table splits the time of a node: what follows from the plan, and what is added to it. With
`--page` captures without and with the page in Chromium, and with live planes, are compared by turns.
"""

import argparse
import multiprocessing
import statistics
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial, wraps
from io import BytesIO
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import tifffile

from faintfield.pipelines.live.capture_page import serve_page
from faintfield.pipelines.live.guided import read_pixels
from faintfield.pipelines.live.panel import CapturePanel, SessionFrames
from faintfield.pipelines.live.planes_client import LiveOrder, live_planes
from faintfield.rig.cameras.protocol import CameraReport, Exposure
from faintfield.rig.cameras.settings import FolderSettings
from faintfield.rig.capture import take
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import survey
from faintfield.rig.clock import WallClock
from faintfield.rig.devices import Rig
from faintfield.rig.plan import Grid
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan, Session
from faintfield.rig.settings import DriftSettings, RigSettings, SettleSettings, StepSettings
from faintfield.rig.simulation.controller.bench import Server
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.stages.gantry import Gantry, serial_stage
from faintfield.rig.stages.grbl import GrblController
from faintfield.rig.stages.protocol import Point, StageSettings
from faintfield.rig.stages.transport import SerialPort, TrafficLog
from tests.end_to_end.browser import open_browser

EXPOSURE_S, REST_S, PITCH_MM = 0.2, 0.1, 20.0

# Depths of the live planes beside a capture.
_DEPTHS_MM = (400.0, 500.0, 600.0, 700.0)

# Share of the stated acceleration that the firmware reaches: motions take a little longer than predicted.
_ACCELERATION = 0.9

# Times that follow from the plan.
_PLANNED = ("motion as predicted", "rest", "exposure")


class TimedCamera:
    """A camera that takes as long as its exposures, and whose frames are a file of noise."""

    def __init__(self, size_px: int) -> None:
        pixels = np.random.default_rng(1).integers(90, 300, (size_px, size_px), dtype=np.uint16)
        buffer = BytesIO()
        tifffile.imwrite(buffer, pixels)
        self._content = buffer.getvalue()

    def open(self) -> None:
        """Do nothing."""

    def report(self) -> CameraReport:
        """Return the size of a frame."""
        return CameraReport("timed", len(self._content), readout_s=0.0)

    def expose(self, exposure_s: float, number: int) -> Exposure:
        """Wait for the exposure."""
        time.sleep(exposure_s)
        return Exposure(".tiff", content=self._content)

    def close(self) -> None:
        """Do nothing."""


class LateGrbl(SimulatedGrbl):
    """A controller whose motions end some hundredths of a second later than its settings say."""

    def _number(self, setting: int) -> float:
        return super()._number(setting) * (_ACCELERATION if setting in (120, 121) else 1.0)


class Times:
    """Seconds by name; those of another thread than the capture's are marked."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._capture = threading.get_ident()

    def add(self, name: str, seconds: float) -> None:
        """Add a time of this thread."""
        meanwhile = "" if threading.get_ident() == self._capture else " (meanwhile)"
        self.seconds[name + meanwhile] += seconds

    @contextmanager
    def of(self, owner: Any, method: str, name: str) -> Iterator[None]:
        """Time a method or function of `owner`."""
        original = getattr(owner, method)

        @wraps(original)
        def timed(*arguments: Any, **named: Any) -> Any:
            begun_s = time.perf_counter()
            try:
                return original(*arguments, **named)
            finally:
                self.add(name, time.perf_counter() - begun_s)

        with mock.patch.object(owner, method, timed):
            yield


def serve(line: Connection) -> None:
    """Serve a simulated controller; send its port first."""
    server = Server(LateGrbl)
    line.send(server.port)
    server.run()


def rig(settings: RigSettings, size_px: int, traffic: TrafficLog | None = None) -> Rig:
    """Return the rig, in real time."""
    clock, port = WallClock(), settings.stage.port
    stage = serial_stage(settings.stage, clock, traffic, partial(SerialPort, port, 115200))
    return Rig(stage, TimedCamera(size_px), clock, lambda kind, sweep: None, camera_sees_stage=False)


@contextmanager
def shown(panel: CapturePanel, session: Session, scratch: Path) -> Iterator[None]:
    """Show the capture in a browser, with live planes at four depths, while the block runs."""
    frames = SessionFrames(session)
    order = LiveOrder(session.folder, scratch / "rig.toml", _DEPTHS_MM, fx_px=1000.0)
    with ExitStack() as stack:
        planes = stack.enter_context(live_planes(order, frames.of_dark_scene))
        assert planes is not None
        panel.on_change.append(planes.note_change)
        address = stack.enter_context(serve_page(panel, frames, planes))
        tab = stack.enter_context(open_browser(scratch / "browser"))
        tab.open(address)
        yield


def measure(port: str, folder: Path, nodes: int, size_px: int, *, page: bool = False) -> tuple[Times, float]:
    """Capture a dark scene; return the times of all nodes but the first, and their sum."""
    settings = RigSettings(
        stage=StageSettings("grbl", port),
        camera=FolderSettings("frames"),
        grid=Grid(nodes, nodes, PITCH_MM, Point(-350.0, -350.0)),
        step=(StepSettings("dark_scene", EXPOSURE_S),),
        settle=SettleSettings(measure=False, wait_s=REST_S),
        drift=DriftSettings(check=False),
    )
    frozen = FrozenPlan(survey(rig(settings, size_px), settings).plan, settings)
    times, ends_s = Times(), list[float]()
    follow, take_frame = GrblController.follow, take.FrameTaker.take

    def timed_follow(controller: GrblController, path: Any, feed_mm_per_s: float, predicted_s: float) -> Point:
        begun_s = time.perf_counter()
        point = follow(controller, path, feed_mm_per_s, predicted_s)
        times.add("motion as predicted", predicted_s)
        times.add("arrival", time.perf_counter() - begun_s - predicted_s)
        return point

    def timed_take(taker: take.FrameTaker, *arguments: Any) -> None:
        take_frame(taker, *arguments)
        if not ends_s:
            times.seconds.clear()
        ends_s.append(time.perf_counter())

    with ExitStack() as stack, open_session(folder, frozen) as session:
        for owner, method, name in (
            (WallClock, "sleep_s", "rest"),
            (Gantry, "verify_at", "verification"),
            (TimedCamera, "expose", "exposure"),
            (Session, "write", "write, hash, flush"),
            (take.FrameTaker, "_decode_frame", "decode"),
            (take.FrameTaker, "_check", "check"),
            (Session, "intend", "journal"),
            (Session, "commit", "journal"),
        ):
            stack.enter_context(times.of(owner, method, name))
        stack.enter_context(mock.patch.object(GrblController, "follow", timed_follow))
        stack.enter_context(mock.patch.object(take.FrameTaker, "take", timed_take))
        operator = CapturePanel(unattended=True)
        if page:
            stack.enter_context(shown(operator, session, folder.parent))
        Capture(session, rig(settings, size_px, session.journal), operator, read_pixels).run()
    return times, ends_s[-1] - ends_s[0]


def table(times: Times, total_s: float, nodes: int) -> str:
    """Return the times per node as a table in Markdown."""
    seconds = dict(times.seconds)
    in_turn_s = sum(value for name, value in seconds.items() if not name.endswith("(meanwhile)"))
    seconds["other"] = total_s - in_turn_s
    added_s = total_s - sum(seconds[name] for name in _PLANNED)
    seconds |= {"**all**": total_s, "**added to the plan**": added_s}
    lines = [f"| {name} | {1e3 * value / nodes:.0f} |" for name, value in seconds.items()]
    return "\n".join(["| part of a node | ms |", "|---|---|", *lines])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed.pace", description=__doc__)
    parser.add_argument("folder", nargs="?")
    parser.add_argument("--size-px", type=int, default=1024, help="width and height of a frame")
    parser.add_argument("--nodes", type=int, default=7, help="nodes along one side of the grid")
    parser.add_argument("--page", type=int, default=0, metavar="PAIRS", help="captures without and with the page")
    arguments = parser.parse_args()
    if arguments.page:
        ratios = []
        for _ in range(arguments.page):
            without_s, with_s = (_captured(arguments, page=page)[1] for page in (False, True))
            ratios.append(with_s / without_s)
            print(f"{without_s:.1f} s without the page, {with_s:.1f} s with it: {ratios[-1]:.3f}", flush=True)
        print(f"median of the ratios: {statistics.median(ratios):.3f}")
        return
    times, total_s = _captured(arguments)
    print(table(times, total_s, arguments.nodes**2 - 1))


def _captured(arguments: argparse.Namespace, *, page: bool = False) -> tuple[Times, float]:
    near, far = multiprocessing.Pipe()
    server = multiprocessing.get_context("spawn").Process(target=serve, args=(far,), daemon=True)
    server.start()
    try:
        with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
            session = Path(folder) / "session"
            return measure(near.recv(), session, arguments.nodes, arguments.size_px, page=page)
    finally:
        server.kill()


if __name__ == "__main__":
    main()
