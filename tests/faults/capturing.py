"""Run small captures in processes of their own, which can be killed."""

import ctypes
import multiprocessing
import threading
from collections.abc import Callable, Mapping
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.capture.guide import Answer, OperatorRequest, Prompt, Status
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.plan import Grid, PlannedFrame
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan
from faintfield.rig.settings import BoardSettings, DriftSettings, RigSettings, SettleSettings, StepSettings
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
