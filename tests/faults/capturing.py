"""Run small captures in processes of their own, which can be killed."""

import ctypes
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any
from unittest import mock

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.capture.guide import Answer, OperatorRequest, Prompt, Status
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.plan import Grid, PlannedFrame
from faintfield.rig.session import disk, session
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan
from faintfield.rig.settings import BoardSettings, DriftSettings, RigSettings, SettleSettings, StepSettings
from faintfield.rig.simulation.lab import SimulatedLab
from faintfield.rig.stages.protocol import Point, StageSettings

SMALL_RIG = RigSettings(
    stage=StageSettings("simulated"),
    camera=SimulatedSettings(size_px=(16, 12)),
    grid=Grid(2, 3, 50.0, Point(-350.0, -350.0)),
    step=(StepSettings("bright", 0.1), StepSettings("dark_scene", 0.1), StepSettings("dark", (0.1, 1.0), 2)),
    settle=SettleSettings(measure=False),
    drift=DriftSettings(check=False),
)
FRAMES = 2 * 3 + 2 * 3 + 4
BOARD = BoardSettings("large", 9, 6, 40.0, 30.0)

# The steps by which a frame reaches the disk, each with the function before or after which the power may fail
STEPS: Mapping[str, tuple[Any, str]] = {
    "intent": (Journal, "intend"),
    "exposure": (SimulatedLab, "expose"),
    "writing": (disk, "write_new"),
    "flushing": (os, "fsync"),
    "naming": (Path, "rename"),
    "flushing the folder": (disk, "sync_folder"),
    "file written": (session.Session, "write"),
    "commit": (Journal, "commit"),
}


class Unattended:
    """Stands in for a person: gives every prompt its unattended answer, and shows nothing."""

    def ask(self, prompt: Prompt) -> Answer:
        return prompt.unattended

    def take_request(self) -> OperatorRequest | None:
        return None

    def show_status(self, status: Status) -> None:
        pass

    def show_frame(self, frame: PlannedFrame, pixels: Pixels, values: Mapping[str, float]) -> None:
        pass


def capture_small(folder: Path, settings: RigSettings = SMALL_RIG) -> None:
    """Begin or resume a session without a person, and complete it."""
    frozen = FrozenPlan(survey(open_rig(settings), settings).plan, settings)
    with open_session(folder, frozen) as begun:
        Capture(begun, open_rig(settings, begun.journal), Unattended(), lambda path: None).run()


def capture_and_die(folder: Path, step: str, *, after: bool, countdown: int) -> None:
    """Capture, and be killed before or after a step, the `countdown`-th time it is reached since the first intent."""
    owner, name = STEPS[step]
    with kill_at(owner, name, after=after, countdown=countdown):
        capture_small(folder)


@contextmanager
def kill_at(owner: Any, name: str, *, after: bool, countdown: int) -> Iterator[None]:
    """Kill this process when `owner.name` is called for the `countdown`-th time since the first intent."""
    original: Callable[..., Any] = getattr(owner, name)
    intend = Journal.intend
    left = [countdown]
    begun = [name == "intend"]

    def watched_intend(journal: Journal, frame: int) -> int:
        begun[0] = True
        return intend(journal, frame)

    def watched(*arguments: Any, **named: Any) -> Any:
        left[0] -= begun[0]
        dies = begun[0] and left[0] == 0
        if dies and not after:
            os.kill(os.getpid(), signal.SIGKILL)
        result = original(*arguments, **named)
        if dies:
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    places = [(owner, name)] + ([(session, name)] if owner is disk and hasattr(session, name) else [])
    with mock.patch.object(Journal, "intend", watched_intend):
        patches = [mock.patch.object(place, attribute, watched) for place, attribute in places]
        for patch in patches:
            patch.start()
        yield
        for patch in patches:
            patch.stop()


def drop_rights() -> None:
    """Give up all privileges, so that permissions hold for the superuser too (capset, Linux)."""
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)
    if ctypes.CDLL(None, use_errno=True).capset(header, (ctypes.c_uint32 * 6)()) != 0:
        raise OSError(ctypes.get_errno(), "capset")


def in_process(target: Callable[..., None], *arguments: Any, **named: Any) -> ForkServerProcess:
    """Start a process that runs `target`; the imports are preloaded."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    process = context.Process(target=_quietly, args=(target, arguments, named), daemon=True)
    process.start()
    return process


def _quietly(target: Callable[..., None], arguments: tuple[Any, ...], named: dict[str, Any]) -> None:
    """Run `target` without reports of failed threads."""
    threading.excepthook = lambda _: None
    target(*arguments, **named)
