"""Run a guided capture: survey the rig, plan or resume the session, and show it in the terminal and on the page."""

import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType

import numpy as np

from faintfield.pipelines.console import console, inform, progress
from faintfield.pipelines.errors import InputError, UnknownFormat
from faintfield.pipelines.formats.files import require_room
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.geometry import DEFAULT_DEPTHS_MM
from faintfield.pipelines.live.board_progress import BoardOrder
from faintfield.pipelines.live.boards_client import BoardsClient, followed_boards
from faintfield.pipelines.live.capture_page import serve_page
from faintfield.pipelines.live.light_meter import LightMeter
from faintfield.pipelines.live.panel import CapturePanel, SessionFrames
from faintfield.pipelines.live.planes_client import NO_POSES, LiveOrder, live_planes
from faintfield.pipelines.live.terminal import TerminalView
from faintfield.pipelines.termination import interrupt_on_termination
from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.capture.guide import describe_frame_count, describe_rounds, format_capture_duration
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.rounds import NoisePredictor
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.errors import CameraError, CaptureStopped, RigError
from faintfield.rig.session.resume import adopt_settings, check_same_rig, open_session
from faintfield.rig.session.session import FrozenPlan, Session, has_session, is_sealed, read_plan
from faintfield.rig.settings import RigSettings


def capture_session(
    settings: RigSettings,
    folder: Path,
    *,
    unattended: bool,
    page: bool,
    planes: LiveOrder | None = None,
    meter: LightMeter | None = None,
    noise: NoisePredictor | None = None,
) -> int:
    """Begin or resume the session in `folder` and take its missing frames; return the number of frames taken.

    Unattended, every prompt gets its usual answer. The `page` shows `planes` of the frames so far, if they are ordered.
    The `meter` reads the light of the dark scene; steps in rounds end by the `noise` that is predicted.
    Raises `RigError` or `DiskFull` if the plan is not possible, the session cannot be used, or the capture stopped
    before its end.
    """
    frozen = _plan_session(settings, folder)
    if is_sealed(folder):
        inform(f"{folder}: is complete, nothing is left to capture; `faintfield verify` compares every byte of it")
        return 0
    panel = CapturePanel(unattended=unattended)
    with interrupt_on_termination(), ExitStack() as stack:
        session = stack.enter_context(open_session(folder, frozen, lambda frames: progress(list(frames), "comparing")))
        for change in adopt_settings(session, settings):
            inform(f"{folder}: {change}, from now on")
        before = len(session.valid())
        if before:
            inform(f"{folder}: {before} of {len(session.wanted())} frames are there; going on")
        frames = SessionFrames(session)
        # Without a person at page or terminal, nobody could follow the advice
        boards = _follow_boards(panel, stack, session, frames) if page or not unattended else None
        if page:
            _open_page(panel, stack, frames, planes, boards, meter)
        stack.enter_context(TerminalView(panel, frames, meter).show())
        stack.enter_context(_stop_on_interrupt(panel))
        try:
            Capture(session, open_rig(settings, session.journal, read_pixels), panel, read_pixels, noise).run()
        except RigError as failure:
            panel.end(str(failure))
            raise
        following = _next_command(session)
        panel.end(f"Complete. Next: {following}")
        count = len(session.valid()) - before
        for ended in session.rounds_ended.values():
            inform(f"{folder}: {describe_rounds(ended)}")
    inform(f"{folder}: complete, {count} frames taken; next: {following}")
    return count


def _next_command(session: Session) -> str:
    """Return the command that makes results of a complete session; of one without any, that which verifies it."""
    folder, kinds = session.folder, {session.frames[number].kind for number in session.valid()}
    if "dark_scene" in kinds:
        return f"faintfield run {folder}" + ("" if session.rig.scene.depth_mm else " --depth-mm DEPTH")
    measured = {"dark": "noise", "charuco": "geometry"}
    commands = [f"faintfield {command} {folder}" for kind, command in measured.items() if kind in kinds]
    return " and ".join(commands) or f"faintfield verify {folder}"


def _plan_session(settings: RigSettings, folder: Path) -> FrozenPlan:
    """Read the plan of the session in `folder`, or make one after a survey of the rig."""
    if has_session(folder):
        frozen = read_plan(folder)
        check_same_rig(frozen, settings)
        return frozen
    rig = survey(open_rig(settings), settings)
    for warning in rig.stage.warnings:
        inform(f"warning: {warning}")
    require_room(folder, rig.plan.wanted_room_bytes())
    inform(f"{describe_frame_count(rig.plan)}, {format_capture_duration(rig.duration_s, settings.stage)}")
    return FrozenPlan(rig.plan, settings)


def _follow_boards(
    panel: CapturePanel, stack: ExitStack, session: Session, frames: SessionFrames
) -> BoardsClient | None:
    """Follow the board sweeps until the stack is closed; None if there are none, or that cannot begin."""
    if not any(frame.kind == "charuco" for frame in session.frames):
        return None
    out = Path(stack.enter_context(TemporaryDirectory(prefix="faintfield-")))
    depths_mm = session.rig.scene.depth_mm or DEFAULT_DEPTHS_MM
    frames.note_homings()
    order = BoardOrder(session.folder.absolute(), out, depths_mm, session.rig.checks.transfer_px)
    boards = stack.enter_context(followed_boards(order, frames.of_boards))
    if boards is not None:
        panel.on_change += [frames.note_homings, boards.note_change]
    return boards


def _open_page(
    panel: CapturePanel,
    stack: ExitStack,
    frames: SessionFrames,
    order: LiveOrder | None,
    boards: BoardsClient | None,
    meter: LightMeter | None,
) -> None:
    """Serve the page until the stack is closed; if that fails, go on where prompts can be answered otherwise."""
    planes = None
    if order is not None:
        poses = (lambda: NO_POSES) if boards is None else boards.poses
        planes = stack.enter_context(live_planes(order, frames.of_dark_scene, poses))
    if planes is not None:
        panel.on_change.append(planes.note_change)
        if boards is not None:
            boards.on_poses.append(planes.note_change)
    try:
        address = stack.enter_context(serve_page(panel, frames, planes, boards, meter))
    except (OSError, RuntimeError) as failure:
        if not (panel.unattended or console.is_terminal):
            raise CaptureStopped(
                f"there is no page ({failure}) and no terminal to answer prompts on; run the same command in a terminal"
            ) from failure
        inform(f"warning: there is no page ({failure}); the capture goes on without it")
    else:
        inform(f"page: {address}")


def read_pixels(path: Path) -> Pixels | None:
    """Return the pixels of a frame's file, None if files of its kind cannot be decoded here.

    Raises `CameraError` if the file is truncated or damaged, or holds what is no number.
    """
    try:
        pixels_dn = read_frame(path).pixels_dn
    except UnknownFormat:
        return None
    except InputError as failure:
        raise CameraError(str(failure)) from failure
    if not np.isfinite(pixels_dn).all():
        raise CameraError(f"{path}: holds values that are no numbers; let the camera's program save integers")
    return pixels_dn


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
