"""The capture: every missing frame of a session taken, in order, each from a verified place."""

import itertools
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

from faintfield.rig.cameras.protocol import Exposure, Pixels
from faintfield.rig.capture.checks import LIT, check_frame
from faintfield.rig.capture.guide import Answer, Operator, Prompt, Status, step_prompt
from faintfield.rig.capture.pace import Pace
from faintfield.rig.capture.settling import Settling, measure_settling
from faintfield.rig.capture.survey import refuse_what_cannot_be_done
from faintfield.rig.capture.sweeps import board_doubts
from faintfield.rig.devices import Rig
from faintfield.rig.errors import CameraError, CaptureStopped, NotHomed, PositionDrifted, StageError
from faintfield.rig.session.frames import PlannedFrame
from faintfield.rig.session.journal import Committed
from faintfield.rig.session.session import Session
from faintfield.rig.stages.drift import DriftWatch
from faintfield.rig.stages.protocol import Point
from faintfield.rig.stages.recovery import recover

type Decode = Callable[[Path], Pixels | None]

# Without a person, a frame is given up after this many failures in a row, and a stage after losing steps so often.
_UNATTENDED_TRIES = 3
# Frames that are not kept are numbered from here, far from those that are.
_FIRST_SHORT_FRAME = 10**9


class Capture:
    """Takes the frames that a session misses; `run` once.

    Parameters
    ----------
    session : Session
        Where frames go; open.
    rig : Rig
        Stage and camera, not yet connected.
    operator : Operator
        Who is asked, and told.
    decode : callable
        Reads the pixels of a frame's file for checks and pictures; None when it cannot.
    """

    def __init__(self, session: Session, rig: Rig, operator: Operator, decode: Decode) -> None:
        self._session = session
        self._journal = session.journal
        self._settings = session.frozen.rig
        self._rig = rig
        self._operator = operator
        self._decode = decode
        self._watch = DriftWatch(rig.stage, limit_mm=self._settings.drift.limit_mm)
        self._pace = Pace(rig.stage, rig.clock, session.plan.settle_s, session.plan.readout_s)
        self._here: Point | None = None
        self._repeated = False
        self._settle_s: float | None = None
        self._last: Committed | None = None
        self._warnings: tuple[str, ...] = ()
        self._failures = 0
        self._since_check = 0
        self._drifts = 0
        self._short_frames = itertools.count(_FIRST_SHORT_FRAME)

    def run(self) -> None:
        """Take every missing frame and seal the session.

        Raises
        ------
        CaptureStopped
            The operator has stopped it, or a frame could not be had; running it again goes on.
        RigError
            Stage, camera or disk failed and it was not to go on.
        """
        try:
            if self._session.missing():
                self._connect()
            while missing := self._session.missing() or self._skipped_again():
                self._step(missing)
            self._session.seal()
        finally:
            self._rig.camera.close()
            self._rig.stage.close()

    def _connect(self) -> None:
        """Connect, refuse what cannot be done, and home."""
        rig, session = self._rig, self._session
        rig.stage.connect()
        rig.camera.open()
        report, identity = rig.camera.report(), rig.stage.identify()
        self._journal.event(
            "connected", camera=msgspec.to_builtins(report), stage=msgspec.to_builtins(identity, str_keys=True)
        )
        refuse_what_cannot_be_done(session.plan, rig.stage, report)
        lines = ("The stage moves to its switches, to know where it is.", "Keep clear of it.")
        if not self._may_home(*lines):
            self._stop()
        self._begin_watch()

    def _step(self, missing: list[PlannedFrame]) -> None:
        """Ask for what the next step needs, and take its frames."""
        first = missing[0]
        frames = [frame for frame in missing if frame.step == first.step]
        duration_s = self._pace.to_go_s(frames, self._here, 0)
        self._show_status(first, "waiting for your answer")
        answer = self._ask(step_prompt(first, first.step + 1, len(self._session.plan.steps), len(frames), duration_s))
        if answer == "skip":
            for frame in frames:
                self._session.skip(frame)
            return
        if answer == "stop":
            self._stop()
        self._rig.arrange(first.kind, first.sweep)
        for frame in frames:
            if frame.number in {it.number for it in self._session.skipped()}:
                continue
            self._obey_wishes(frame)
            if frame in self._session.missing():
                self._take_with_care(frame)
            self._check_drift(nodes=self._settings.drift.every_nodes)
        if self._session.plan.steps[first.step].at == "grid":
            self._check_drift(nodes=1)

    def _take_with_care(self, frame: PlannedFrame) -> None:
        """Take a frame; when something fails, ask what to do, until it is taken, skipped, or the capture stops."""
        self._failures = 0
        while True:
            try:
                self._show_status(frame, "moving")
                self._go_to(frame)
                self._show_status(frame, "exposing")
                self._take(frame)
            except (StageError, NotHomed) as failure:
                answer = self._after_failure("stage", frame, failure)
                if answer == "again":
                    self._recover_stage()
            except CameraError as failure:
                answer = self._after_failure("camera", frame, failure)
                if answer == "again":
                    self._reopen_camera()
            else:
                return
            if answer == "skip":
                self._session.skip(frame)
                return

    def _go_to(self, frame: PlannedFrame) -> None:
        """Bring the stage to a frame's node and let it come to rest."""
        target = frame.stop.target
        if self._here == target:
            return
        begun_s, start = self._rig.clock.now_s(), self._here
        self._here, self._repeated = None, False
        self._rig.stage.move_to(*target)
        self._since_check += 1
        usual = self._settle_s is not None or frame.kind not in LIT
        if not usual:
            self._settle_s = self._find_settling(frame)
        # Also where nothing was measured just now: the rest may be that of the plan, or of before an interruption
        self._rig.clock.sleep_s(self._session.plan.settle_s if self._settle_s is None else self._settle_s)
        if usual:
            self._pace.stopped(begun_s, start, target)
        self._here = target

    def _take(self, frame: PlannedFrame) -> None:
        """Intent, verified position, exposure, position again, file, checks, commit: in this order."""
        rig, session = self._rig, self._session
        begun_s, repeated = rig.clock.now_s(), self._repeated
        target = frame.stop.target
        intent = session.intend(frame)
        position = rig.stage.verify_at(*target)
        exposure = rig.camera.expose(frame.exposure_s, intent)
        rig.stage.verify_at(*target)
        written = session.write(frame, intent, exposure)
        pixels = exposure.pixels if exposure.pixels is not None else self._decode(written.path)
        values, warnings = self._checked(frame, pixels)
        detail = {
            "position_mm": position.point,
            "exposure_s": frame.exposure_s,
            "camera": dict(exposure.metadata),
            "checks": values,
            "warnings": warnings,
        }
        self._last = session.commit(frame, written, detail)
        self._watch.visited(self._last)
        self._warnings = tuple(f"{frame.name}: {warning}" for warning in warnings) or self._warnings
        if frame.kind == "charuco":
            self._judge_boards(frame)
        self._pace.exposed(begun_s, frame.exposure_s, repeated=repeated)
        self._repeated = True
        if pixels is not None:
            self._operator.show_frame(frame, pixels, values)

    def _checked(self, frame: PlannedFrame, pixels: Pixels | None) -> tuple[dict[str, float], tuple[str, ...]]:
        """Return what was measured in a frame, and the warnings."""
        if pixels is None:
            return {}, (
                "the file cannot be decoded here, so nothing was checked; look at it with the camera's program",
            )
        earlier = [
            it.detail["checks"]["sharpness"]
            for it in self._session.valid().values()
            if self._session.frames[it.frame].step == frame.step and "sharpness" in it.detail["checks"]
        ]
        findings = check_frame(pixels, frame.kind, self._settings.checks, self._settings.board, earlier)
        return findings.values, findings.warnings

    def _judge_boards(self, frame: PlannedFrame) -> None:
        """Warn where a sweep, or all of them, show too little of the boards."""
        checks = {number: taken.detail["checks"] for number, taken in self._session.valid().items()}
        corners = {number: int(found["board_corners"]) for number, found in checks.items() if "board_corners" in found}
        for doubt in board_doubts(frame, self._session.frames, corners, self._settings.checks.board_corners):
            self._warn(doubt)

    def _find_settling(self, frame: PlannedFrame) -> float:
        """Return how long to rest: as measured in this session before, or now."""
        known = self._journal.events("settling")
        if known:
            return float(known[-1].detail["wait_s"])
        if not self._settings.settle.measure:
            return self._session.plan.settle_s
        self._show_status(frame, "measuring how long the rig swings")
        found: Settling = measure_settling(self._short_frame, self._rig.clock, self._settings.settle)
        self._journal.event("settling", frame=frame.number, **msgspec.to_builtins(found))
        if not found.settled:
            self._warn(
                f"no rest was seen within {self._settings.settle.longest_s:g} s, which is waited from now on; "
                "light the scene, stiffen the rig or lower its acceleration, or set settle.measure = false"
            )
        return found.wait_s

    def _short_frame(self, exposure_s: float) -> Pixels:
        """Return a frame that is not kept."""
        exposure: Exposure = self._rig.camera.expose(exposure_s, next(self._short_frames))
        if exposure.content is None:
            assert exposure.pixels is not None
            return exposure.pixels
        with TemporaryDirectory(prefix="faintfield-") as folder:
            path = Path(folder) / f"frame{exposure.suffix}"
            path.write_bytes(exposure.content)
            pixels = self._decode(path)
        if pixels is None:
            raise CameraError("frames cannot be decoded here, so no settling can be seen; set settle.measure = false")
        return pixels

    def _obey_wishes(self, frame: PlannedFrame) -> None:
        """Do what the operator asked for since the last frame."""
        wish = self._operator.wish()
        if wish is None:
            return
        self._journal.event("wish", frame=frame.number, wish=wish)
        if wish == "pause":
            self._show_status(frame, "paused")
            lines = (f"The next frame is {frame.name}.",)
            wish_or_go = self._ask(Prompt("paused", "Paused", lines, ("go", "retake", "skip", "stop"), "go"))
        else:
            wish_or_go = wish
        if wish_or_go == "stop":
            self._stop()
        if wish_or_go == "skip":
            self._session.skip(frame)
        if wish_or_go == "retake" and self._last is not None:
            self._take_with_care(self._session.frames[self._last.frame])

    def _after_failure(self, key: str, frame: PlannedFrame, failure: Exception) -> Answer:
        """Record a failure and ask what to do; raises it when the answer is to stop."""
        self._failures += 1
        self._here = None
        self._journal.event(f"{key}_failed", frame=frame.number, error=type(failure).__name__, message=str(failure))
        self._warn(f"{frame.name}: {failure}")
        given_up: Answer = "again" if self._failures < _UNATTENDED_TRIES else "stop"
        answer = self._ask(Prompt(key, f"The {key} failed", (str(failure),), ("again", "skip", "stop"), given_up))
        if answer == "stop":
            raise failure
        return answer

    def _recover_stage(self) -> None:
        """Make the stage usable again; a failure of this counts like the first."""
        with suppress(StageError):
            recover(self._rig.stage, self._may_home, self._watch if self._settings.drift.check else None)

    def _reopen_camera(self) -> None:
        """Connect to the camera anew; a failure of this shows at the next exposure."""
        with suppress(CameraError):
            self._rig.camera.close()
            self._rig.camera.open()

    def _may_home(self, *question: str) -> bool:
        """Ask before the stage moves to its switches."""
        return self._ask(Prompt("home", "Homing", question, ("go", "stop"), "go")) == "go"

    def _begin_watch(self) -> None:
        """Home; learn how long homing takes if drift is to be found."""
        if not self._settings.drift.check:
            self._rig.stage.home()
            return
        self._watch.begin()
        begun_s = self._rig.clock.now_s()
        self._watch.check()
        self._pace.check_s = self._rig.clock.now_s() - begun_s

    def _check_drift(self, nodes: int) -> None:
        """Home again if `nodes` were visited since the last time; frames that relied on a lost scale are retaken."""
        if not self._settings.drift.check or nodes == 0 or self._since_check < nodes or not self._watch.unchecked:
            return
        self._since_check = 0
        self._here = None
        try:
            drift = self._watch.check()
        except PositionDrifted as failure:
            self._after_drift(failure)
        else:
            self._journal.event("drift_check", away_mm=drift.away_mm)

    def _after_drift(self, failure: PositionDrifted) -> None:
        """Mark the frames that relied on the stage's scale; ask whether to take them again."""
        suspect = [it for it in failure.suspect if isinstance(it, Committed)]
        self._journal.event("suspect", message=str(failure), intents=[it.intent for it in suspect])
        self._warn(str(failure))
        self._drifts += 1
        given_up: Answer = "retake" if self._drifts < _UNATTENDED_TRIES else "stop"
        prompt = Prompt("drift", "The stage lost its scale", (str(failure),), ("retake", "keep", "stop"), given_up)
        answer = self._ask(prompt)
        if answer == "stop":
            self._stop()
        if answer == "retake":
            self._session.void(suspect, "taken from a doubtful position")
        self._rig.stage.recover()
        self._begin_watch()

    def _skipped_again(self) -> list[PlannedFrame]:
        """Ask what becomes of the frames that were skipped; return those to be taken after all."""
        skipped = self._session.skipped()
        if not skipped:
            return []
        lines = (f"{len(skipped)} frames were skipped, the first is {skipped[0].name}.",)
        answer = self._ask(Prompt("skipped", "Skipped frames", lines, ("again", "keep", "stop"), "stop"))
        if answer == "stop":
            self._stop()
        if answer == "again":
            self._session.unskip()
        return self._session.missing()

    def _ask(self, prompt: Prompt) -> Answer:
        """Ask the operator and put question and answer into the journal."""
        answer = self._operator.ask(prompt)
        self._journal.event("prompt", key=prompt.key, title=prompt.title, lines=prompt.lines, answer=answer)
        return answer

    def _stop(self) -> None:
        """End the capture in good order."""
        self._journal.event("stopped")
        done, total = len(self._session.valid()), len(self._session.frames)
        raise CaptureStopped(f"stopped with {done} of {total} frames taken; run the same command to go on")

    def _warn(self, text: str) -> None:
        """Record a warning and show it from now on."""
        self._journal.event("warning", message=text)
        self._warnings = (text,)

    def _show_status(self, frame: PlannedFrame, doing: str) -> None:
        """Tell the operator where the capture stands."""
        session = self._session
        missing = session.missing()
        steps = session.plan.steps
        checks = len({it.step for it in missing if steps[it.step].at == "grid"}) if self._settings.drift.check else 0
        self._operator.show_status(
            Status(
                doing=doing,
                step=frame.step + 1,
                steps=len(steps),
                title=step_prompt(frame, frame.step + 1, len(steps), 0, 0.0).title,
                done=len(session.valid()),
                total=len(session.frames),
                to_go_s=self._pace.to_go_s(missing, self._here, checks),
                node=frame.stop.node,
                grid=self._grid(frame.step),
                warnings=self._warnings,
            )
        )

    def _grid(self, step: int) -> tuple[tuple[float, ...], ...]:
        """Return the share of a step's frames that is done, per row and column; −1 where it has none."""
        grid, valid = self._settings.grid, self._session.valid()
        counts = {(row, column): [0, 0] for row in range(grid.rows) for column in range(grid.columns)}
        for frame in self._session.frames:
            if frame.step == step:
                counts[frame.stop.node][0] += frame.number in valid
                counts[frame.stop.node][1] += 1
        return tuple(
            tuple(done / of if of else -1.0 for done, of in (counts[row, column] for column in range(grid.columns)))
            for row in range(grid.rows)
        )
