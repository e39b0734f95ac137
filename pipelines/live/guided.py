"""Run a guided capture: plan or resume the session, and show it in the terminal and on the page."""

import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType

from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import InputError
from faintfield.pipelines.formats.files import require_room
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.live.panel import CapturePanel
from faintfield.pipelines.live.preflight import duration_words, needed_bytes
from faintfield.pipelines.live.terminal import TerminalView
from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.session.resume import check_same_rig, open_session
from faintfield.rig.session.session import FrozenPlan, has_session, is_sealed, read_plan
from faintfield.rig.settings import RigSettings


def capture_session(settings: RigSettings, folder: Path, *, unattended: bool, page: bool) -> int:
    """Begin or resume the session in `folder` and take its missing frames; return the number of frames taken.

    Parameters
    ----------
    settings : RigSettings
        Content of the rig.toml.
    folder : Path
        Folder of the session.
    unattended : bool
        Give every prompt its usual answer.
    page : bool
        Show the capture on a local web page as well.

    Raises
    ------
    RigError, DiskFull
        The plan is not possible, the session cannot be used, or the capture stopped before its end.
    """
    frozen = _plan_session(settings, folder)
    if is_sealed(folder):
        inform(f"{folder}: is complete; there is nothing left to capture")
        return 0
    panel = CapturePanel(unattended=unattended)
    with ExitStack() as stack:
        session = stack.enter_context(open_session(folder, frozen, lambda frames: progress(list(frames), "comparing")))
        before = len(session.valid())
        if before:
            inform(f"{folder}: {before} of {len(session.frames)} frames are there; going on")
        if page:
            from faintfield.pipelines.live.capture_page import serve_page  # slow: imports a web server

            inform(f"page: {stack.enter_context(serve_page(panel))}")
        stack.enter_context(TerminalView(panel).show())
        stack.enter_context(_stop_on_interrupt(panel))
        Capture(session, open_rig(settings, session.journal), panel, _read_pixels).run()
        taken = len(session.valid()) - before
    inform(f"{folder}: complete, {taken} frames taken; faintfield verify {folder} compares every byte")
    return taken


def _plan_session(settings: RigSettings, folder: Path) -> FrozenPlan:
    """Return the plan of the session in `folder`, or make one after a survey of the rig."""
    if has_session(folder):
        frozen = read_plan(folder)
        check_same_rig(frozen, settings)
        return frozen
    found = survey(open_rig(settings), settings)
    for warning in found.stage.warnings:
        inform(f"warning: {warning}")
    require_room(folder, needed_bytes(found.plan))
    inform(f"{found.plan.frame_count()} frames, {duration_words(found.duration_s, settings.stage)}")
    return FrozenPlan(found.plan, settings)


def _read_pixels(path: Path) -> Pixels | None:
    """Return the pixels of a frame's file, None if it cannot be decoded."""
    try:
        return read_frame(path).pixels_dn
    except InputError:
        return None


@contextmanager
def _stop_on_interrupt(panel: CapturePanel) -> Iterator[None]:
    """Let the first Ctrl-C press the stop button, and the second interrupt."""

    def stop(number: int, frame: FrameType | None) -> None:
        panel.press("stop")
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
