"""Take the page of a capture in each phase of a simulated session, on screens of three widths.

`python docs/draw_capture.py FOLDER`, from the root of the repository, puts all pictures into a folder; without one,
those that the guide shows are put into docs/pictures. Chromium takes them.
"""

import base64
import io
import math
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

from PIL import Image

from faintfield.pipelines.commands.capture import init
from faintfield.pipelines.formats.toml_files import read_rig
from faintfield.pipelines.live.board_progress import BoardOrder
from faintfield.pipelines.live.boards_client import followed_boards
from faintfield.pipelines.live.capture_page import serve_page
from faintfield.pipelines.live.guided import read_pixels
from faintfield.pipelines.live.light_meter import LightMeter
from faintfield.pipelines.live.panel import CapturePanel, SessionFrames
from faintfield.pipelines.live.planes_client import LiveOrder, live_planes
from faintfield.pipelines.planning.known import known_sensor
from faintfield.pipelines.planning.sample_noise import MeasuredNoise
from faintfield.rig.cameras.protocol import Exposure
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.errors import CameraError, RigError
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan
from faintfield.rig.settings import RigSettings
from tests.end_to_end.browser import Tab, open_browser

_PICTURES = Path(__file__).parent / "pictures"
# Widths and heights of the screens.
_SCREENS = ((1400, 1000), (1024, 1000), (390, 844))
_DEPTHS_MM = (400.0, 450.0, 500.0, 550.0, 600.0, 650.0, 700.0)
# Electrons per pixel and second, as the dark scene is planned.
_LIGHT_E_PER_S = 13.0
# What docs/how-to/run_a_capture.md shows: phase and width.
_SHOWN = (("prompt", 1400), ("boards", 1024), ("dark_scene", 1400), ("dark_scene", 390))
# Their longest part, in widths of the screen, and their width.
_LONGEST = 2.2
_WIDTH_PX = 1000
# Board sweeps, and nodes of the grid.
_SWEEPS, _NODES = 4, 25


class _Session:
    """A capture in a thread, which waits before its frames of given numbers."""

    def __init__(self, folder: Path, settings: RigSettings) -> None:
        self.panel = CapturePanel(unattended=False)
        self.failing = False
        self._folder, self._settings = folder, settings
        self._stack = ExitStack()
        self._may_take = 0
        self._allowed = threading.Condition()

    @contextmanager
    def run(self) -> Iterator[str]:
        """Run the capture while the block runs; yield the address of its page."""
        opened: list[SessionFrames] = []
        begun, go = threading.Event(), threading.Event()

        rig_toml = self._folder.parent / "rig.toml"
        known = None, None, None
        noise = MeasuredNoise(self._settings, rig_toml, self._folder, *known, light_e_per_s=_LIGHT_E_PER_S)

        def capture() -> None:  # the journal belongs to the thread that opens it
            frozen = FrozenPlan(survey(open_rig(self._settings), self._settings).plan, self._settings)
            with open_session(self._folder, frozen) as session:
                opened.append(SessionFrames(session))
                self.panel.on_change.append(opened[0].note_homings)
                begun.set()
                go.wait()
                rig = open_rig(self._settings, session.journal)
                try:
                    with mock.patch.object(rig.camera, "expose", self._failing(rig.camera.expose)):
                        Capture(session, rig, self.panel, read_pixels, noise.predict).run()
                except RigError as failure:
                    self.panel.end(str(failure))
                else:
                    self.panel.end(f"Complete. Next: faintfield run {self._folder.name}")

        thread = threading.Thread(target=capture, daemon=True)
        thread.start()
        begun.wait()
        order = LiveOrder(self._folder, rig_toml, _DEPTHS_MM)
        out = self._folder.parent / "boards"
        out.mkdir()
        board_order = BoardOrder(self._folder, out, (500.0, 700.0), None)
        with ExitStack() as stack:
            boards = stack.enter_context(followed_boards(board_order, opened[0].of_boards))
            assert boards is not None
            client = stack.enter_context(live_planes(order, opened[0].of_dark_scene, boards.poses))
            assert client is not None
            boards.on_poses.append(client.note_change)
            self.panel.on_change += [boards.note_change, client.note_change, self._wait]
            meter = LightMeter(lambda: known_sensor(self._settings, None), _LIGHT_E_PER_S).wait()
            address = stack.enter_context(serve_page(self.panel, opened[0], client, boards, meter))
            go.set()
            yield address

    def take(self, frames: int) -> None:
        """Let the capture go on until there are so many frames."""
        with self._allowed:
            self._may_take = frames
            self._allowed.notify()

    def _wait(self) -> None:
        status = self.panel.status
        with self._allowed:
            self._allowed.wait_for(lambda: status is None or status.doing != "exposing" or status.done < self._may_take)

    def _failing(self, expose: Callable[[float, int], Exposure]) -> Callable[[float, int], Exposure]:
        """Return an exposure that fails once where that is asked for."""

        def expose_or_fail(exposure_s: float, number: int) -> Exposure:
            if self.failing:
                self.failing = False
                raise CameraError("the camera did not answer in 20 s; check cable and battery, switch it off and on")
            return expose(exposure_s, number)

        return expose_or_fail


def draw_phases(take: Callable[[Tab, str], None]) -> None:
    """Lead a simulated session from the first prompt to its end, and call `take` in each phase."""
    with TemporaryDirectory() as scratch, open_browser(Path(scratch) / "browser") as tab:
        tab.call("Emulation.setScrollbarsHidden", hidden=True)
        session = _Session(Path(scratch) / "session", _rig(Path(scratch) / "rig.toml"))
        with session.run() as address:
            tab.resize(*_SCREENS[0])
            tab.open(address)
            tab.wait_until("document.getElementById('title').textContent === 'Homing'")
            take(tab, "homing")
            tab.click("go")
            _wait_for(tab, "Board sweep 1")
            take(tab, "prompt")
            tab.click("test")
            tab.wait_until("document.getElementById('picture-title').textContent.includes('Test frame')")
            _wait_for(tab, "Board sweep 1")
            take(tab, "test_frame")
            tab.click("go")
            session.take(16)
            tab.wait_until("document.getElementById('count').textContent.startsWith('16 of')")
            session.failing = True
            session.take(25)
            tab.wait_until("document.getElementById('title').textContent.includes('camera failed')")
            take(tab, "failure")
            tab.click("again")
            for number in range(2, _SWEEPS + 1):
                session.take(10**6)
                _wait_for(tab, f"Board sweep {number}")
                if number == _SWEEPS:
                    tab.wait_until("document.getElementById('boards-verdict').textContent.includes('px')")
                    take(tab, "boards_prompt")
                session.take(_NODES * (number - 1) + 16)
                tab.click("go")
                if number == _SWEEPS:
                    tab.wait_until(
                        f"document.getElementById('count').textContent.startsWith('{_NODES * (number - 1) + 16} of')"
                    )
                    take(tab, "boards")
            session.take(10**6)
            _wait_for(tab, "Bright set")
            take(tab, "bright_set")
            tab.click("go")
            _wait_for(tab, "Dark-scene set")
            take(tab, "dark_prompt")
            done = tab.evaluate("parseInt(document.getElementById('count').textContent)")
            session.take(done)
            tab.click("go")
            _take_at(tab, session, done + 1, take, "dark_begins")
            session.take(done + _NODES + 20)
            tab.wait_until(f"parseInt(document.getElementById('count').textContent) === {done + _NODES + 20}")
            tab.set_slider("depth", 2)
            tab.wait_until("document.getElementById('planes-words').textContent.endsWith('now: up to date')")
            tab.wait_until(
                f"document.getElementById('best-words').textContent.includes('PMLEM so far, {_NODES} nodes')"
            )
            take(tab, "dark_scene")
            session.take(10**6)
            for title in ("Noise reference", "Dark frames", "Flat frames 1"):
                _wait_for(tab, title)
                take(tab, title.lower().replace(" ", "_"))
                tab.click("go")
            tab.wait_until("document.getElementById('title').textContent.startsWith('Complete')")
            take(tab, "complete")
        if tab.complaints:
            raise AssertionError(tab.complaints)


def _wait_for(tab: Tab, title: str) -> None:
    tab.wait_until(f"document.getElementById('title').textContent.includes('{title}')")
    tab.wait_until("document.querySelector('button[data-word=test]:not(:disabled)')")


def _take_at(tab: Tab, session: _Session, frames: int, take: Callable[[Tab, str], None], phase: str) -> None:
    """Go on to a number of frames, and take the page."""
    session.take(frames)
    tab.wait_until(f"document.getElementById('count').textContent.startsWith('{frames} of')")
    take(tab, phase)


def _rig(path: Path) -> RigSettings:
    """Write a rig.toml of a simulated rig with few steps, and return it."""
    init(path)
    text = path.read_text().replace("rows = 7\ncolumns = 7", "rows = 5\ncolumns = 5")
    text = text.replace("frames_per_node = 10", "frames_per_node = 1")
    head = text[: text.index("[[step]]")]
    steps = (
        *('kind = "charuco"\nexposure_s = 0.05',) * _SWEEPS,
        'kind = "bright"\nexposure_s = 0.05',
        'kind = "dark_scene"\nexposure_s = 0.1\nuntil = { sigma_e = 0.4, at_most_rounds = 8 }',
        *('kind = "noise_reference"\nexposure_s = 0.1', 'kind = "dark"\nexposure_s = [0.1, 1.0]\nframes_per_node = 5'),
        'kind = "flat"\nexposure_s = 0.05\nframes_per_node = 5',
    )
    path.write_text(head + "\n\n".join(f"[[step]]\n{step}" for step in steps) + "\n")
    return read_rig(path)


def _take_all(folder: Path) -> Callable[[Tab, str], None]:
    """Return a function that takes the page at all widths, from its top to its end."""
    folder.mkdir(parents=True, exist_ok=True)

    def take(tab: Tab, phase: str) -> None:
        for width_px, height_px in _SCREENS:
            (folder / f"{phase}_{width_px}.png").write_bytes(_screenshot(tab, width_px, height_px))

    return take


def _take_shown(tab: Tab, phase: str) -> None:
    for width_px, height_px in _SCREENS:
        if (phase, width_px) in _SHOWN:
            taken = _screenshot(tab, width_px, height_px, _LONGEST * width_px)
            with Image.open(io.BytesIO(taken)) as picture:
                picture.thumbnail((_WIDTH_PX, 4 * _WIDTH_PX))
                picture.convert("RGB").save(_PICTURES / f"capture_{phase}_{width_px}.webp", quality=70, method=6)


def _screenshot(tab: Tab, width_px: int, height_px: int, longest_px: float = math.inf) -> bytes:
    """Return the whole page as PNG, on a screen of this size, or its upper part of this length."""
    tab.resize(width_px, height_px)
    tab.wait_until("[...document.images].filter(it => it.offsetParent).every(it => it.complete)")
    tab.draw()
    whole = tab.evaluate("document.documentElement.scrollHeight")
    clip = {"x": 0, "y": 0, "width": width_px, "height": min(max(whole, height_px), longest_px), "scale": 1}
    taken = tab.call("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)
    return base64.b64decode(taken["data"])


if __name__ == "__main__":
    draw_phases(_take_all(Path(sys.argv[1])) if len(sys.argv) > 1 else _take_shown)
