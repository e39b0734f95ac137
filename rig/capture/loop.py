"""Run a capture: take every missing frame of a session, step by step, and handle requests and failures."""

from contextlib import suppress

import msgspec

from faintfield.rig.cameras.protocol import Decode
from faintfield.rig.capture.guide import (
    BY_HAND,
    MAX_UNATTENDED_TRIES,
    Answer,
    Dialogue,
    OperatorInterface,
    Prompt,
    needs_hand,
    step_prompt,
)
from faintfield.rig.capture.lighting import Lighting
from faintfield.rig.capture.rounds import NoisePredictor
from faintfield.rig.capture.survey import check_plan
from faintfield.rig.capture.take import DriftChecks, FrameTaker
from faintfield.rig.devices import Rig
from faintfield.rig.errors import (
    CameraError,
    DriftUnknown,
    LightError,
    NotHomed,
    PlanRefused,
    PositionDrifted,
    RigError,
    StageError,
)
from faintfield.rig.plan import PlannedFrame, StepKind
from faintfield.rig.session.homings import begin_group, unchecked_frames
from faintfield.rig.session.journal import Suspect
from faintfield.rig.session.session import Session
from faintfield.rig.stages.drift import recover

_DEVICES = {CameraError: "camera", LightError: "light"}


class Capture:
    """Takes the missing frames of an open session, with a rig that is not yet connected; call `run` once.

    `decode` reads the pixels of a frame's file for checks and display; it returns None if it cannot. Steps in rounds
    end when the `noise` that is predicted reaches the wanted one; without a predictor they take all rounds.
    """

    def __init__(
        self,
        session: Session,
        rig: Rig,
        operator: OperatorInterface,
        decode: Decode,
        noise: NoisePredictor | None = None,
    ) -> None:
        self._session = session
        self._rig = rig
        self._dialogue = Dialogue(session, rig, operator, noise)
        self._drift = DriftChecks(self._dialogue)
        self._lighting = Lighting(session, rig)
        self._taker = FrameTaker(self._dialogue, self._drift, self._lighting, decode)
        self._failures = self._untimed_checks = 0
        self._homings_in_journal = 0
        self._unrecovered: Exception | None = None

    def run(self) -> None:
        """Take every missing frame and seal the session.

        Raises `CaptureStopped`, or the failure of stage, camera or disk after which the operator chose to stop. Running
        the capture again resumes it.
        """
        try:
            if self._session.missing():
                self._connect()
            while missing := self._missing() or self._ask_about_skipped():
                self._run_round(missing)
            if self._drift.watch is not None:  # a capture that was killed may have left nothing but the last check
                self._mark_unchecked("the capture ended")
            self._switch_lights_off()
        except BaseException:
            with suppress(RigError):  # that a journal cannot be written to is not why the capture ends
                self._switch_lights_off()
            raise
        finally:
            try:
                self._lighting.close()
            finally:
                self._rig.camera.close()
                self._rig.stage.close()
        self._dialogue.stage = self._dialogue.camera = "not connected"
        self._dialogue.show_status(self._session.frames[-1], "sealing")
        self._session.seal()
        self._dialogue.show_status(self._session.frames[-1], "complete")

    def _missing(self) -> list[PlannedFrame]:
        self._dialogue.rounds.end_steps()
        return self._session.missing()

    def _switch_lights_off(self) -> None:
        if failures := self._lighting.switch_off():
            self._dialogue.warn("; ".join(failures))
            self._dialogue.show_status(self._taker.last or self._session.frames[0], "ended, with lights that are on")

    def _connect(self) -> None:
        rig, session = self._rig, self._session
        rig.stage.connect()
        rig.camera.open()
        self._lighting.open()
        report, identity = rig.camera.report(), rig.stage.identify()
        session.journal.event(
            "connected", camera=msgspec.to_builtins(report), stage=msgspec.to_builtins(identity, str_keys=True)
        )
        check_plan(session.plan, rig.stage, report)
        self._dialogue.stage, self._dialogue.camera = "connected, its position is not known", "ready"
        self._dialogue.show_status(session.missing()[0], "connected")
        if not self._may_home("The stage moves to its switches, to find its position.", "Keep clear of it."):
            self._dialogue.stop()
        self._dialogue.stage = "homes"
        self._dialogue.show_status(session.missing()[0], "homing")
        self._begin_drift_checks()
        self._dialogue.stage = "homed"

    def _begin_drift_checks(self) -> None:
        """Home, and measure what drift is judged by; again while delayed answers prevent it, up to a bound."""
        for attempts_left in reversed(range(MAX_UNATTENDED_TRIES)):
            try:
                self._drift.begin()
            except (DriftUnknown, PositionDrifted) as failure:
                if failure.__cause__ is not None or not attempts_left:
                    raise
                self._dialogue.warn(str(failure))
            else:
                return

    def _kind_before(self, first: PlannedFrame) -> StepKind | None:
        """Return the kind of the frames taken before a step; on a resume, of those before it that need a hand."""
        if self._taker.last is not None:
            return self._taker.last.kind
        earlier = [step.kind for step in self._session.plan.steps[: first.step]]
        return next((kind for kind in earlier if kind in BY_HAND), None)

    def _run_round(self, missing: list[PlannedFrame]) -> None:
        """Take those missing frames that are of the same step and round as the first."""
        session, first = self._session, missing[0]
        of_step = [frame for frame in missing if frame.step == first.step]
        frames = [frame for frame in of_step if frame.round == first.round]
        last = self._taker.last
        continues = last is not None and last.step == first.step  # a further round, or frames to be taken again
        if needs_hand(session.plan.steps[first.step], self._kind_before(first)) and not continues:
            self._dialogue.show_status(first, "preparing the step")
            expected = self._dialogue.rounds.expected(of_step)
            duration_s = self._dialogue.pace.remaining_s(expected, 0)
            prompt = step_prompt(session.plan.steps, first, (len(expected), len(of_step)), duration_s)
            while (answer := self._dialogue.ask_or_stop(prompt)) == "test":
                self._rig.arrange(first.kind, first.sweep)
                self._take_test(first)
            if answer == "skip":
                for frame in of_step:
                    session.skip(frame)
                return
            self._dialogue.warnings = ()  # those of test frames
        self._rig.arrange(first.kind, first.sweep)
        for frame, following in zip(frames, [*frames[1:], None], strict=True):
            if frame not in session.skipped():
                self._handle_request(frame)
                if frame in session.missing():
                    self._take(frame, following)
            if following is None or following.stop != frame.stop:  # a homing would part the frames of a node
                self._check_drift(frame, session.frozen.rig.drift.every_nodes)
        if session.plan.steps[first.step].at == "grid":
            self._check_drift(frames[-1], 1)

    def _check_drift(self, frame: PlannedFrame, nodes: int) -> None:
        """Check for drift after `nodes` nodes; a failure of the stage is handled like one at `frame`."""
        self._failures = 0
        while True:
            try:
                self._drift.check_after(nodes)
            except DriftUnknown as failure:
                self._untimed_checks += 1
                reason = "taken before a check of the stage that says nothing"
                self._drift.ask_to_retake(failure, "Drift could not be checked", self._untimed_checks, reason)
            except (StageError, NotHomed, PlanRefused) as failure:
                if self._handle_failure(frame, failure) == "again":
                    continue
            else:
                if self._drift.watch is not None and not self._drift.watch.unchecked:
                    self._untimed_checks = 0
            return

    def _take(self, frame: PlannedFrame, following: PlannedFrame | None = None) -> None:
        self._failures = 0
        while True:
            try:
                if self._rig.stage.homings != self._homings_in_journal:
                    self._homings_in_journal = self._rig.stage.homings
                    if self._drift.watch is not None:
                        self._mark_unchecked("the stage was homed")
                    begin_group(self._session.journal)
                self._taker.take(frame, following)
            except (StageError, NotHomed, CameraError, LightError) as failure:
                if self._handle_failure(frame, failure) == "skip":
                    self._session.skip(frame)
                    return
            else:
                return

    def _take_test(self, frame: PlannedFrame) -> None:
        self._failures = 0
        try:
            self._taker.take_test(frame)
        except (StageError, NotHomed, CameraError, LightError) as failure:
            self._handle_failure(frame, failure)
        self._dialogue.show_status(frame, "preparing the step")

    def _handle_request(self, frame: PlannedFrame) -> None:
        request = self._dialogue.operator.take_request()
        if request is None:
            return
        self._session.journal.event("wish", frame=frame.number, wish=request)
        choice: str = request
        if request == "stop":
            self._dialogue.stop()
        if request == "pause":
            while (choice := self._ask_in_pause(frame)) == "retake":
                self._retake()
        if choice == "finish":
            self._dialogue.rounds.limit(frame)
        if choice == "skip":
            self._session.skip(frame)
        if choice == "retake":
            self._retake()

    def _ask_in_pause(self, frame: PlannedFrame) -> Answer:
        self._dialogue.show_status(frame, "paused")
        lines: tuple[str, ...] = (f"The next frame is {frame.name}.",)
        answers: tuple[Answer, ...] = ("go", "retake", "skip", "stop")
        if self._dialogue.rounds.progress(frame.step) is not None:
            answers = ("go", "retake", "skip", "finish", "stop")
            lines += ("The step can finish with this round.",)
        return self._dialogue.ask_or_stop(Prompt("paused", "Paused", lines, answers, "go"))

    def _retake(self) -> None:
        if self._taker.last is not None:
            self._take(self._taker.last)

    def _handle_failure(self, frame: PlannedFrame, failure: Exception) -> Answer:
        """Record a failure and ask what to do; prepare another try, or re-raise it if the answer is to stop."""
        if isinstance(failure, NotHomed) and self._unrecovered is not None:
            failure = self._unrecovered
        device = next((name for kind, name in _DEVICES.items() if isinstance(failure, kind)), "stage")
        self._failures += 1
        self._dialogue.pace.here = None
        self._record_failure(f"{device}_failed", frame, failure)
        self._dialogue.warn(f"{frame.name}: {failure}")
        if device == "camera":
            self._dialogue.camera = "failed"
        elif device == "stage":
            self._dialogue.stage = "failed"
        self._dialogue.show_status(frame, f"the {device} failed")
        unattended: Answer = "again" if self._failures < MAX_UNATTENDED_TRIES else "stop"
        answers: tuple[Answer, ...] = ("again", "skip", "stop")
        # The stage moves no sooner than it is answered; if it failed itself, that is not certain
        still = () if device == "stage" else ("The stage stands still. Do not move camera, boards or objects.",)
        lines = (str(failure), *still)
        answer = self._dialogue.ask(Prompt(device, f"The {device} failed", lines, answers, unattended))
        if answer == "stop":
            raise failure
        if answer == "again":
            self._recover(frame, device)
        return answer

    def _recover(self, frame: PlannedFrame, device: str) -> None:
        """Make a device usable again; if that fails, so does the next motion or exposure, which is then handled."""
        self._dialogue.show_status(frame, f"waiting for the {device}")
        self._unrecovered = None
        try:
            if device == "stage":
                recover(self._rig.stage, self._may_home, self._drift.watch)
            elif device == "light":
                self._lighting.open()
            else:
                self._rig.camera.close()
                self._rig.camera.open()
        except (StageError, CameraError, LightError, NotHomed, PlanRefused) as failure:
            self._unrecovered = failure
            self._record_failure("recovery_failed", frame, failure, device=device)
            self._dialogue.warn(f"{frame.name}: the {device} was not recovered: {failure}")

    def _record_failure(self, kind: str, frame: PlannedFrame, failure: Exception, **detail: str) -> None:
        detail |= {"error": type(failure).__name__, "message": str(failure)}
        self._session.journal.event(kind, frame=frame.number, **detail)

    def _mark_unchecked(self, event: str) -> None:
        """Mark the frames at nodes that no drift check will confirm, since `event` came before it."""
        session = self._session
        steps = [session.plan.steps[frame.step] for frame in session.frames]
        marked = {intent for suspect in session.journal.details("suspect", Suspect) for intent in suspect.intents}
        unchecked = [frame.intent for frame in unchecked_frames(session.journal) if steps[frame.frame].at == "grid"]
        if not marked.issuperset(unchecked):
            message = f"{event} before {len(unchecked)} frames were checked for drift; they stay as suspect"
            session.journal.event("suspect", message=message, intents=unchecked)
            self._dialogue.warn(message)

    def _may_home(self, *question: str) -> bool:
        return self._dialogue.ask(Prompt("home", "Homing", question, ("go", "stop"), "go")) == "go"

    def _ask_about_skipped(self) -> list[PlannedFrame]:
        skipped = self._session.skipped()
        if not skipped or self._session.is_decided:
            return []
        lines = (f"{len(skipped)} frames were skipped, the first is {skipped[0].name}.",)
        prompt = Prompt("skipped", "Skipped frames", lines, ("again", "keep", "stop"), "stop")
        if self._dialogue.ask_or_stop(prompt) == "again":
            self._session.unskip()
        return self._session.missing()
