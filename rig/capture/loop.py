"""Run a capture: take every missing frame of a session, step by step, and handle requests and failures."""

from contextlib import suppress

import msgspec

from faintfield.rig.capture.guide import MAX_UNATTENDED_TRIES, Answer, Dialogue, OperatorInterface, Prompt, step_prompt
from faintfield.rig.capture.pace import Pace
from faintfield.rig.capture.survey import check_plan
from faintfield.rig.capture.take import Decode, DriftChecks, FrameTaker
from faintfield.rig.devices import Rig
from faintfield.rig.errors import CameraError, NotHomed, StageError
from faintfield.rig.plan import PlannedFrame
from faintfield.rig.session.session import Session
from faintfield.rig.stages.drift import recover


class Capture:
    """Takes the missing frames of a session; call `run` once.

    Parameters
    ----------
    session : Session
        Open session, where the frames are stored.
    rig : Rig
        Stage and camera, not yet connected.
    operator : OperatorInterface
        Answers prompts and shows the state of the capture.
    decode : callable
        Reads the pixels of a frame's file for checks and display; returns None if it cannot.
    """

    def __init__(self, session: Session, rig: Rig, operator: OperatorInterface, decode: Decode) -> None:
        self._session = session
        self._rig = rig
        self._operator = operator
        self._pace = Pace(rig.stage, rig.clock, session.plan.settle_s, session.plan.readout_s)
        self._dialogue = Dialogue(session, operator, self._pace)
        self._drift = DriftChecks(session, rig, self._dialogue, self._pace)
        self._taker = FrameTaker(session, rig, self._dialogue, self._drift, self._pace, decode)
        self._failures = 0

    def run(self) -> None:
        """Take every missing frame and seal the session.

        Raises
        ------
        CaptureStopped
            The operator stopped the capture; running it again resumes it.
        RigError
            Stage, camera or disk failed, and the operator chose to stop.
        """
        try:
            if self._session.missing():
                self._connect()
            while missing := self._session.missing() or self._ask_about_skipped():
                self._run_step(missing)
            self._session.seal()
        finally:
            self._rig.camera.close()
            self._rig.stage.close()

    def _connect(self) -> None:
        """Connect to stage and camera, check the plan, and home."""
        rig, session = self._rig, self._session
        rig.stage.connect()
        rig.camera.open()
        report, identity = rig.camera.report(), rig.stage.identify()
        session.journal.event(
            "connected", camera=msgspec.to_builtins(report), stage=msgspec.to_builtins(identity, str_keys=True)
        )
        check_plan(session.plan, rig.stage, report)
        if not self._may_home("The stage moves to its switches, to find its position.", "Keep clear of it."):
            self._dialogue.stop()
        self._drift.begin()

    def _run_step(self, missing: list[PlannedFrame]) -> None:
        """Prompt for the next step, and take its frames."""
        session, first = self._session, missing[0]
        frames = [frame for frame in missing if frame.step == first.step]
        self._dialogue.show_status(first, "waiting for your answer")
        duration_s = self._pace.remaining_s(frames, 0)
        answer = self._dialogue.ask(
            step_prompt(first, first.step + 1, len(session.plan.steps), len(frames), duration_s)
        )
        if answer == "skip":
            for frame in frames:
                session.skip(frame)
            return
        if answer == "stop":
            self._dialogue.stop()
        self._rig.arrange(first.kind, first.sweep)
        for frame in frames:
            if frame in session.skipped():
                continue
            self._handle_request(frame)
            if frame in session.missing():
                self._take(frame)
            self._drift.check_after(session.frozen.rig.drift.every_nodes)
        if session.plan.steps[first.step].at == "grid":
            self._drift.check_after(1)

    def _take(self, frame: PlannedFrame) -> None:
        """Take a frame; after a failure, ask what to do until it is taken, skipped, or the capture stops."""
        self._failures = 0
        while True:
            try:
                self._taker.take(frame)
            except (StageError, NotHomed, CameraError) as failure:
                if self._handle_failure(frame, failure) == "skip":
                    self._session.skip(frame)
                    return
            else:
                return

    def _handle_request(self, frame: PlannedFrame) -> None:
        """Do what the operator requested since the last frame."""
        request = self._operator.take_request()
        if request is None:
            return
        self._session.journal.event("wish", frame=frame.number, wish=request)
        choice: str = request
        if request == "pause":
            self._dialogue.show_status(frame, "paused")
            lines = (f"The next frame is {frame.name}.",)
            choice = self._dialogue.ask(Prompt("paused", "Paused", lines, ("go", "retake", "skip", "stop"), "go"))
        if choice == "stop":
            self._dialogue.stop()
        if choice == "skip":
            self._session.skip(frame)
        if choice == "retake" and self._taker.last is not None:
            self._take(self._taker.last)

    def _handle_failure(self, frame: PlannedFrame, failure: Exception) -> Answer:
        """Record a failure and ask what to do; prepare another try, or re-raise it if the answer is to stop."""
        device = "camera" if isinstance(failure, CameraError) else "stage"
        self._failures += 1
        self._pace.here = None
        event = {"error": type(failure).__name__, "message": str(failure)}
        self._session.journal.event(f"{device}_failed", frame=frame.number, **event)
        self._dialogue.warn(f"{frame.name}: {failure}")
        unattended: Answer = "again" if self._failures < MAX_UNATTENDED_TRIES else "stop"
        answers: tuple[Answer, ...] = ("again", "skip", "stop")
        answer = self._dialogue.ask(Prompt(device, f"The {device} failed", (str(failure),), answers, unattended))
        if answer == "stop":
            raise failure
        if answer == "again":
            # If this fails, the next motion or exposure fails as well
            with suppress(StageError, CameraError):
                if device == "stage":
                    recover(self._rig.stage, self._may_home, self._drift.watch)
                else:
                    self._rig.camera.close()
                    self._rig.camera.open()
        return answer

    def _may_home(self, *question: str) -> bool:
        """Ask before the stage moves to its switches."""
        return self._dialogue.ask(Prompt("home", "Homing", question, ("go", "stop"), "go")) == "go"

    def _ask_about_skipped(self) -> list[PlannedFrame]:
        """Ask what to do with the skipped frames; return those to be taken after all."""
        skipped = self._session.skipped()
        if not skipped:
            return []
        lines = (f"{len(skipped)} frames were skipped, the first is {skipped[0].name}.",)
        answer = self._dialogue.ask(Prompt("skipped", "Skipped frames", lines, ("again", "keep", "stop"), "stop"))
        if answer == "stop":
            self._dialogue.stop()
        if answer == "again":
            self._session.unskip()
        return self._session.missing()
