"""Captures in this process, and an operator with prepared answers."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from faintfield.rig.cameras.protocol import Decode, Pixels
from faintfield.rig.capture.guide import Answer, OperatorRequest, Prompt, Status
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.errors import RigError
from faintfield.rig.plan import PlannedFrame
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import RigSettings
from tests.faults.capturing import FRAMES, SMALL_RIG


class Operator:
    """An operator with prepared answers and requests.

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

    def show_frame(self, frame: PlannedFrame, pixels: Pixels, values: Mapping[str, float]) -> None:
        self.frames.append(frame.number)


def capture(
    folder: Path,
    operator: Operator | None = None,
    settings: RigSettings = SMALL_RIG,
    decode: Decode = lambda path: None,
) -> RigError | None:
    """Begin or resume a session; return the failure, None without one."""
    plan = FrozenPlan(survey(open_rig(settings), settings).plan, settings)
    try:
        with open_session(folder, plan) as session:
            Capture(session, open_rig(settings, session.journal), operator or Operator(), decode).run()
    except RigError as failure:
        return failure
    return None


def assert_complete(folder: Path, superseded: int = 0) -> None:
    verdict = verify(folder)
    assert verdict.problems == ()
    assert (verdict.present, verdict.sealed, verdict.superseded) == (FRAMES, True, superseded)
