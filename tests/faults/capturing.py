"""Small captures, in this process or in another that can be killed, and an operator with prepared answers."""

import ctypes
import multiprocessing
import threading
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from faintfield.rig.cameras.protocol import Decode
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.capture.guide import Answer, OperatorInterface, OperatorRequest, Prompt, ShownFrame, Status
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.rounds import NoisePredictor
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.errors import RigError
from faintfield.rig.plan import Grid
from faintfield.rig.session.journal import Journal, JournalEvent
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan
from faintfield.rig.session.verify import verify
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
DRIFTING = replace(SMALL_RIG, drift=DriftSettings())
FRAMES = 2 * 3 + 2 * 3 + 4
BOARD = BoardSettings("large", 9, 6, 40.0, 30.0)


class Operator:
    """An operator with prepared answers and requests; gives every other prompt its unattended answer.

    `answers` holds a list for each prompt key; `requests` is keyed by the number of frames shown before.
    """

    def __init__(
        self,
        answers: Mapping[str, Sequence[Answer]] | None = None,
        requests: Mapping[int, OperatorRequest] | None = None,
    ) -> None:
        self.answers = {key: list(values) for key, values in (answers or {}).items()}
        self.requests = dict(requests or {})
        self.prompts: list[Prompt] = []
        self.statuses: list[Status] = []
        self.shown: list[ShownFrame] = []
        self.frames: list[int] = []
        self.on_status: Callable[[Status], object] = lambda status: None

    def ask(self, prompt: Prompt) -> Answer:
        self.prompts.append(prompt)
        waiting = self.answers.get(prompt.key)
        answer = waiting.pop(0) if waiting else prompt.unattended
        assert answer in prompt.answers
        return answer

    def take_request(self) -> OperatorRequest | None:
        return self.requests.pop(len(self.frames), None)

    def show_status(self, status: Status) -> None:
        self.statuses.append(status)
        self.on_status(status)

    def show_frame(self, shown: ShownFrame) -> None:
        self.shown.append(shown)
        if shown.recorded:
            self.frames.append(shown.frame.number)


def frozen_plan(settings: RigSettings) -> FrozenPlan:
    return FrozenPlan(survey(open_rig(settings), settings).plan, settings)


def capture_small(
    folder: Path,
    settings: RigSettings = SMALL_RIG,
    operator: OperatorInterface | None = None,
    decode: Decode = lambda path: None,
    noise: NoisePredictor | None = None,
) -> None:
    """Begin or resume a session, and complete it."""
    with open_session(folder, frozen_plan(settings)) as session:
        Capture(session, open_rig(settings, session.journal), operator or Operator(), decode, noise).run()


def capture(
    folder: Path,
    operator: OperatorInterface | None = None,
    settings: RigSettings = SMALL_RIG,
    decode: Decode = lambda path: None,
    noise: NoisePredictor | None = None,
) -> RigError | None:
    """Begin or resume a session; return the failure, None without one."""
    try:
        capture_small(folder, settings, operator, decode, noise)
    except RigError as failure:
        return failure
    return None


def assert_complete(folder: Path, superseded: int = 0) -> None:
    verdict = verify(folder)
    assert verdict.problems == ()
    assert (verdict.present, verdict.sealed, verdict.superseded) == (FRAMES, True, superseded)


def events(folder: Path, kind: str) -> list[JournalEvent]:
    """Return the events of a kind in the journal of a session."""
    with Journal(folder / "journal.sqlite", read_only=True) as journal:
        return journal.events(kind)


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
