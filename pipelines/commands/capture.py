"""`faintfield capture`: a guided session, begun or resumed."""

import signal
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from faintfield.pipelines.commands.check import ROOM_FACTOR, time_in_words
from faintfield.pipelines.console import console, progress, inform
from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.files import require_room
from faintfield.pipelines.formats.rig_file import decoded, read_rig
from faintfield.pipelines.live.panel import CapturePanel
from faintfield.pipelines.live.terminal import TerminalView
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.session.access import has_session, opened, read_plan, check_same_rig
from faintfield.rig.session.session import FrozenPlan, is_sealed
from faintfield.rig.settings import RigSettings


def capture(rig: Path, session: Path, /, *, yes: bool = False, page: bool = False) -> dict[str, Any]:
    """Capture a session, step by step; run it again to go on where it stopped.

    Keys: p pause, r take the last frame again, s skip, q stop. Ctrl-C stops after the present frame, twice at once.

    Parameters
    ----------
    rig
        The rig.toml.
    session
        Folder of the session.
    yes
        Answer every prompt with its usual answer: for scripts.
    page
        Also serve a local web page, on this computer alone.
    """
    if not (yes or page or (console.is_terminal and sys.stdin.isatty())):
        raise WrongUsage("there is no terminal to answer prompts on; give --yes, or --page and answer there")
    settings = read_rig(rig)
    frozen = _planned(settings, session)
    if is_sealed(session):
        inform(f"{session}: is complete; there is nothing left to capture")
        return {"session": str(session), "complete": True, "taken": 0}
    panel = CapturePanel(unattended=yes)
    with ExitStack() as stack:
        open_session = stack.enter_context(opened(session, frozen, lambda frames: progress(list(frames), "comparing")))
        before = len(open_session.valid())
        if before:
            inform(f"{session}: {before} of {len(open_session.frames)} frames are there; going on")
        if page:
            from faintfield.pipelines.live.capture_page import serve_page

            inform(f"page: {stack.enter_context(serve_page(panel))}")
        stack.enter_context(TerminalView(panel).show())
        stack.enter_context(_stop_on_interrupt(panel))
        Capture(open_session, open_rig(settings, open_session.journal), panel, decoded).run()
        taken = len(open_session.valid()) - before
    inform(f"{session}: complete, {taken} frames taken; faintfield verify {session} compares every byte")
    return {"session": str(session), "complete": True, "taken": taken}


def _planned(settings: RigSettings, session: Path) -> FrozenPlan:
    """Return the plan of a session that was begun, or lay one down after looking at the rig."""
    if has_session(session):
        frozen = read_plan(session)
        check_same_rig(frozen, settings)
        return frozen
    found = survey(open_rig(settings), settings)
    for warning in found.stage.warnings:
        inform(f"warning: {warning}")
    require_room(session, round(ROOM_FACTOR * found.plan.disk_bytes()))
    inform(f"{found.plan.frame_count()} frames, {time_in_words(found.duration_s, settings.stage)}")
    return FrozenPlan(found.plan, settings)


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
