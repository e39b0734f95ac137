"""Rounds of a capture over the grid: how far a step is from its wanted noise, and when it needs no more of them."""

from bisect import bisect_left
from collections.abc import Callable, Sequence

from msgspec import Struct

from faintfield.rig.plan import CaptureStep, PlannedFrame, Until
from faintfield.rig.session.journal import FrameRecord, RoundsEnded
from faintfield.rig.session.session import Session

# Predicts, from the frames of a step so far, the noise of a sample of the planes after a number of rounds, as `Until`
# states it, which falls with each round; None if it is not known.
type NoisePredictor = Callable[[CaptureStep, Sequence[FrameRecord]], Callable[[float], float] | None]


class Progress(Struct, frozen=True):
    """State of a step in rounds: its whole rounds so far, and how many in all will do.

    `sigma_e` is the predicted noise with the frames so far, and `final_e` after `enough` rounds: the fewest that reach
    the wanted noise, or all if none do or that is not known (None). `within` says that a round is begun and not whole.
    """

    until: Until
    done: int
    within: bool
    enough: int
    sigma_e: float | None
    final_e: float | None

    @property
    def reaches(self) -> bool:
        """Return whether the wanted noise will be reached."""
        return self.final_e is not None and self.final_e <= self.until.sigma_e


class Rounds:
    """The rounds of a session's steps; without a `predictor`, all of them are needed."""

    def __init__(self, session: Session, predictor: NoisePredictor | None) -> None:
        self._session, self._predictor = session, predictor
        self._last: dict[int, tuple[int, Progress]] = {}
        self._ended_by_operator: set[int] = set()

    def end_after_this(self, step: int) -> None:
        """Note that the operator wants no more than the present round of a step."""
        self._ended_by_operator.add(step)

    def progress(self, step: int) -> Progress | None:
        """Return the state of a step; None if it is not in rounds."""
        until, valid = self._session.plan.steps[step].until, self._session.valid()
        if until is None:
            return None
        last = self._last.get(step)
        if last is None or last[0] != len(valid):
            last = self._last[step] = len(valid), self._progress(step, until)
        return last[1]

    def expected(self, frames: Sequence[PlannedFrame]) -> list[PlannedFrame]:
        """Return the frames without those of rounds that will probably not be needed."""
        rounds = {
            step: max(progress.enough, progress.done + progress.within)
            for step in self._steps()
            if (progress := self.progress(step)) is not None
        }
        return [frame for frame in frames if frame.round < rounds.get(frame.step, frame.round + 1)]

    def end_steps(self) -> None:
        """Record which steps need no further round, each after a whole one."""
        for step in self._steps():
            progress = self.progress(step)
            if progress is None or step in self._session.rounds_ended or progress.within:
                continue
            by_operator = step in self._ended_by_operator
            reached = progress.reaches and progress.done >= progress.enough
            if 0 < progress.done < progress.until.at_most_rounds and (by_operator or reached):
                self._session.end_rounds(RoundsEnded(step, progress.done, progress.sigma_e, by_operator))

    def _steps(self) -> list[int]:
        return [index for index, step in enumerate(self._session.plan.steps) if step.until is not None]

    def _progress(self, step: int, until: Until) -> Progress:
        session, most = self._session, until.at_most_rounds
        frames = [frame for frame in session.frames if frame.step == step]
        taken = [frame for frame in frames if frame.number in session.valid()]
        open_rounds = [frame.round for frame in session.missing() if frame.step == step]
        done = min(open_rounds, default=max((frame.round + 1 for frame in taken), default=0))
        within = any(frame.round == done for frame in taken)
        records = [session.valid()[frame.number].record for frame in taken]
        noise_e = None if self._predictor is None else self._predictor(session.plan.steps[step], records)
        if noise_e is None:
            return Progress(until, done, within, most, None, None)
        enough = min(1 + bisect_left(range(1, most + 1), -until.sigma_e, key=lambda rounds: -noise_e(rounds)), most)
        now_e = noise_e(len(taken) * most / len(frames)) if taken else None
        return Progress(until, done, within, enough, now_e, noise_e(enough))
