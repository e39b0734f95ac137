"""Live planes beside a simulated capture: in a real browser, and when their process dies or hangs."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.parse
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing import Pipe
from pathlib import Path

import numpy as np
import pytest
import tifffile
from msgspec.structs import replace
from numpy.typing import NDArray

from faintfield.pipelines import cli
from faintfield.pipelines.formats.results.geometry import LensRecord
from faintfield.pipelines.live.capture_page import serve_page
from faintfield.pipelines.live.guided import read_pixels
from faintfield.pipelines.live.panel import CapturePanel, SessionFrames
from faintfield.pipelines.live.planes_client import LiveOrder, LiveStatus, PlanesClient, live_planes
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.capture.loop import Capture
from faintfield.rig.devices import open_rig
from faintfield.rig.plan import Grid
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import RigSettings, StepSettings
from faintfield.rig.simulation.lab import lab_experiment
from faintfield.rig.stages.protocol import Point
from tests.end_to_end.browser import Tab, answer_to
from tests.end_to_end.rigs import write_geometry, write_small_rig
from tests.faults.capturing import SMALL_RIG, capture_small, frozen_plan
from tests.patience import HANG_S

_CAMERA = SimulatedSettings(size_px=(96, 72), unlit_photons_per_s=30.0)
_DEPTHS_MM = (400.0, 500.0, 600.0)
_AT_500_MM = 1

# Between two looks at a process of the lowest priority, which would get no time if the tests did not rest.
_POLL_S = 0.02


def rig(nodes: int) -> RigSettings:
    """Return a simulated rig that takes the dark scene alone."""
    grid = Grid(nodes, nodes, 140.0 / nodes, Point(-350.0, -350.0))
    return replace(SMALL_RIG, camera=_CAMERA, grid=grid, step=(StepSettings("dark_scene", 0.1),))


def write_calibrations(folder: Path, settings: RigSettings) -> None:
    """Write noise.json and geometry.json as they truly are."""
    lab, grid = lab_experiment(_CAMERA), settings.grid
    names = ("offset_dn", "gain_dn_per_e", "read_noise_e", "dark_current_e_per_s", "saturation_dn")
    numbers = {name: {"value": float(getattr(lab.sensor, name))} for name in names}
    folder.mkdir()
    (folder / "noise.json").write_text(json.dumps(numbers))
    optics = lab.optics
    lens = LensRecord("opencv", optics.fx_px, optics.fy_px, optics.cx_px, optics.cy_px, tuple(optics.distortion))
    write_geometry(folder, grid, lens, _CAMERA.size_px)


class Running:
    """A capture in a thread, with live planes and a page; it waits after as many frames as it may take."""

    def __init__(self, folder: Path, nodes: int, *, calibrated: bool = False) -> None:
        self.folder, self.settings = folder / "session", rig(nodes)
        known = folder / "known"
        if calibrated:
            write_calibrations(known, self.settings)
        place = known if calibrated else None
        self._order = LiveOrder(self.folder, folder / "rig.toml", _DEPTHS_MM, place, place)
        self._panel = CapturePanel(unattended=True)
        self._may_take = 0
        self._allowed = threading.Condition()
        self._stack = ExitStack()
        self._begin = threading.Event()

    def __enter__(self) -> "Running":
        begun, opened = threading.Event(), []

        # The journal belongs to the thread that opens it
        def capture() -> None:
            with open_session(self.folder, frozen_plan(self.settings)) as session:
                opened.append(session)
                begun.set()
                self._begin.wait()
                Capture(session, open_rig(self.settings, session.journal), self._panel, read_pixels).run()

        self._thread = threading.Thread(target=capture, daemon=True)
        self._thread.start()
        assert begun.wait(HANG_S)
        self.taken = SessionFrames(opened[0])
        client = self._stack.enter_context(live_planes(self._order, self.taken.of_dark_scene))
        assert client is not None
        self.client: PlanesClient = client
        self._panel.on_change += [client.note_change, self._wait_for_leave]
        self.address = self._stack.enter_context(serve_page(self._panel, self.taken, client))
        self._begin.set()
        return self

    def __exit__(self, *_: object) -> None:
        with self._stack:
            self.end()

    def take(self, frames: int) -> None:
        """Let the capture go on until there are so many frames."""
        with self._allowed:
            self._may_take = frames
            self._allowed.notify()

    def end(self) -> None:
        """Let the capture go on to its end, and wait for it."""
        self.take(10**6)
        self._thread.join(HANG_S)
        assert not self._thread.is_alive()

    def _wait_for_leave(self) -> None:
        with self._allowed:
            assert self._allowed.wait_for(lambda: len(self.taken.of_dark_scene()) < self._may_take, HANG_S)


def shown_levels(browser: Tab, side: str) -> NDArray[np.float64]:
    """Return the grey levels (row, column) of the picture at one side of the wipe, as the browser has decoded it."""
    picture = f"document.getElementById('{side}-picture')"
    browser.wait_until(f"{picture}.complete && {picture}.naturalWidth > 0")
    levels = browser.evaluate(
        f"""(() => {{
            const picture = {picture}, canvas = document.createElement("canvas");
            canvas.width = picture.naturalWidth;
            canvas.height = picture.naturalHeight;
            const context = canvas.getContext("2d");
            context.drawImage(picture, 0, 0);
            const data = context.getImageData(0, 0, canvas.width, canvas.height).data;
            return {{ width: canvas.width, levels: Array.from(data.filter((_, index) => index % 4 === 0)) }};
        }})()"""
    )
    return np.array(levels["levels"], float).reshape(-1, levels["width"])


def test_planes_sharpen_on_page_during_capture(tmp_path: Path, browser: Tab) -> None:
    levels: dict[int, NDArray[np.float64]] = {}
    with Running(tmp_path, 4, calibrated=True) as running:
        browser.open(running.address)
        for count in (2, 16):
            running.take(count)
            browser.wait_until(f"document.getElementById('planes-words').textContent.startsWith('{count} of {count} ')")
            browser.set_slider("depth", _AT_500_MM)
            # "up to date" is said when pictures, focus and PMLEM of all depths are
            browser.wait_until("document.getElementById('planes-words').textContent.endsWith('now: up to date')")
            assert browser.evaluate("document.getElementById('right').value") == "pmlem"
            words = f"right: PMLEM so far, {count} nodes, black "
            browser.wait_until(f"document.getElementById('right-words').textContent.startsWith('{words}')")
            levels[count] = shown_levels(browser, "right")
        check_controls(browser)
        running.end()
    (running.folder / "noise.json").write_bytes((tmp_path / "known" / "noise.json").read_bytes())
    out = tmp_path / "planes"
    options = ["--geometry", str(tmp_path / "known"), "--depth-mm", "500", "--prior", "tv", "--out", str(out)]
    assert cli.run(["reconstruct", str(running.folder), *options]) == 0
    final = tifffile.imread(out / "plane_00500.0.tiff")
    of_two, of_all = (float(np.corrcoef(picture.ravel(), final.ravel())[0, 1]) for picture in levels.values())
    assert of_two < 0.8  # else two nodes would do, and the rise says little
    assert of_all >= 0.9
    assert browser.complaints == []


def check_controls(browser: Tab) -> None:
    """Try slider, wipe, choices and nodes of a page that shows a whole capture."""
    text = browser.text()
    assert "16 of 16 frames of the dark scene added up, from 16 of 16 nodes" in text
    assert "poses: measured, of " in text
    at_500_mm = shown_levels(browser, "left")
    browser.set_slider("depth", 0)
    browser.wait_until("document.querySelector('label[for=depth]').textContent === '400 mm'")
    browser.wait_until("document.getElementById('left-picture').src.includes('plane_000_view')")
    assert not np.array_equal(shown_levels(browser, "left"), at_500_mm)
    # The best picture stands in full beside the wipe
    browser.wait_until("document.getElementById('best-words').textContent.startsWith('400 mm: PMLEM so far, 16 nodes')")
    assert browser.evaluate("document.getElementById('best-picture').src.includes('plane_000_pmlem')")
    assert browser.box("#best-picture")[0] < browser.box("#wipe-box")[0]
    # The right picture begins where the line of the wipe stands
    browser.set_slider("wipe", 30)
    assert "30%" in browser.evaluate("document.getElementById('right-picture').style.clipPath")
    left, _, width, _ = browser.box("#wipe-box")
    line, _, thickness, _ = browser.box("#wipe-line")
    assert line + thickness / 2 == pytest.approx(left + 0.3 * width, abs=2.0)
    browser.choose("left", "mean")
    browser.wait_until("document.getElementById('left-words').textContent.startsWith('left: mean so far, 16 nodes')")
    assert browser.evaluate("document.querySelectorAll('#focus circle').length") == len(_DEPTHS_MM)
    browser.evaluate("document.querySelector('#grid button[title=\"node 2, 3\"]').click()")
    browser.wait_until("document.getElementById('node-picture').naturalWidth > 0")
    words = browser.evaluate("document.getElementById('node-words').textContent")
    for part in ("_dark_scene_0_r2_c3", "stage at -245.000, -280.000 mm", "exposed for 0.1 s", "written at "):
        assert part in words


def content(session: Path) -> dict[str, bytes]:
    """Return the files of a session, except for the journal, whose times differ, and the sums over it."""
    left_out = ("journal.sqlite", "SHA256SUMS")
    return {path.name: path.read_bytes() for path in session.rglob("*") if path.is_file() and path.name not in left_out}


def wait_for(client: PlanesClient, holds: Callable[[LiveStatus], bool]) -> None:
    """Wait until the process of live planes says what is wanted."""
    while client.status is None or not holds(client.status):
        assert client.failure() is None
        time.sleep(_POLL_S)


@pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.deep)])
def test_end_of_live_planes_leaves_session_alone(tmp_path: Path, number: signal.Signals) -> None:
    capture_small(tmp_path / "without", rig(2), decode=read_pixels)
    with Running(tmp_path, 2) as running:
        running.take(2)
        wait_for(running.client, lambda status: status.frames == 2 and "mean" in status.planes[0].pictures)
        check_access(running.address)
        os.kill(running.client.pid, number)
        if number == signal.SIGKILL:
            while running.client.failure() is None:
                time.sleep(_POLL_S)
            assert running.client.failure() == "live planes ended (by signal 9); the capture goes on without them"
        running.end()
    verdict = verify(running.folder)
    assert (verdict.problems, verdict.present, verdict.sealed) == ((), 4, True)
    assert content(running.folder) == content(tmp_path / "without")
    assert not Path(f"/proc/{running.client.pid}").exists()


def check_access(address: str) -> None:
    """Check that the page gives pictures and nodes, and no other file, to those who know its token only."""
    for name in ("planes/plane_000_mean.png?1", "planes/node_r0_c0.png", "node/0/0"):
        assert answer_to(address + name).status == 200, name
    for name in (
        *("planes/status.json", "planes/", "planes/../state", "node/-1/0", "node/0/x", "planes/plane_999_mean.png"),
        *("planes/plane_000_mean.png%0a", "planes/..%2f..%2fetc%2fpasswd", "planes/%2e%2e/plane_000_mean.png"),
    ):
        assert answer_to(address + name).status == 404, name
    token = urllib.parse.urlsplit(address).path
    elsewhere = address.replace(token, "/" + "x" * (len(token) - 2) + "/")
    assert answer_to(elsewhere + "planes/plane_000_mean.png").status == 404


@pytest.mark.deep
def test_process_of_planes_ends_with_killed_capture(tmp_path: Path) -> None:
    line, end = Pipe()
    command = [sys.executable, "-m", "faintfield.pipelines.live.planes_process", str(end.fileno())]
    with subprocess.Popen(command, pass_fds=[end.fileno()]) as process, line:
        end.close()
        line.send(LiveOrder(tmp_path, tmp_path / "rig.toml", (500.0,)))
        assert line.recv().doing == "waiting for frames of the dark scene"
        line.close()
        assert process.wait(HANG_S) == 0


def test_long_step_of_planes_ends_with_killed_capture() -> None:
    line, end = Pipe()
    endless = (
        "import sys, time; from faintfield.pipelines.live import planes_process as planes; "
        "planes.LivePlanes.run = lambda self: (self._report(), time.sleep(3600)); planes.main()"
    )
    with subprocess.Popen([sys.executable, "-c", endless, str(end.fileno())], pass_fds=[end.fileno()]) as process, line:
        end.close()
        line.send(LiveOrder(Path(), Path(), (500.0,)))
        line.recv()
        line.close()
        assert process.wait(HANG_S) == 0


def test_capture_goes_on_without_live_planes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    small, session = write_small_rig(tmp_path / "rig.toml"), tmp_path / "session"
    assert cli.run(["capture", str(small), str(session), "--yes", "--page", "--live-depth-mm", "500"]) == 0
    assert "warning: there are no live planes ([Errno 2] No such file" in capsys.readouterr().err
    assert verify(session).sealed
