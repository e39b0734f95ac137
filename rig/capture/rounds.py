"""Rounds of a capture over the grid: how far a step is from its wanted noise, and when it needs no more of them."""

from bisect import bisect_left
from collections.abc import Callable, Sequence

from msgspec import Struct

from faintfield.rig.plan import CaptureStep, PlannedFrame, Until
from faintfield.rig.session.journal import FrameRecord, RoundsEnded, RoundsLimited
from faintfield.rig.session.session import Session

# Predicts, from the frames of a step so far, the noise of a sample of the planes after a number of rounds, as `Until`
# states it, which falls with each round; None if it is not known.
type NoisePredictor = Callable[[CaptureStep, Sequence[FrameRecord]], Callable[[float], float] | None]


class Progress(Struct, frozen=True):
    """State of a step in rounds, `whole` ones so far, and the number `wanted` in all.

    These are the fewest that reach the noise of `until`, or `most`, if none do or that is not known. `begun` says that
    a further round is begun. The predicted noise of a sample is `sigma_e` with the frames so far, and `final_e` after
    the wanted rounds; None if it is not known.
    """

    until: Until
    most: int
    whole: int
    begun: bool
    wanted: int
    sigma_e: float | None
    final_e: float | None

    @property
    def reached(self) -> bool:
        """Return whether the frames so far have the wanted noise."""
        return self.sigma_e is not None and self.sigma_e <= self.until.sigma_e


class Rounds:
    """The rounds of a session's steps; without a `predictor`, all of them are needed."""

    def __init__(self, session: Session, predictor: NoisePredictor | None) -> None:
        self._session, self._predictor = session, predictor
        self._last: dict[int, tuple[tuple[int, int, int], Progress]] = {}

    def limit(self, frame: PlannedFrame) -> None:
        """Record that the operator wants no round after that of the next frame, nor that one if it is not begun."""
        step, session = frame.step, self._session
        begun = any((other.step, other.round) == (step, frame.round) for other in self._taken(step))
        session.limit_rounds(RoundsLimited(step, max(frame.round + begun, 1)))
        self.end_steps()

    def progress(self, step: int) -> Progress | None:
        """Return the state of a step; None if it is not in rounds."""
        session = self._session
        until = session.plan.steps[step].until
        if until is None:
            return None
        most = min(session.rounds_limited.get(step, until.at_most_rounds), until.at_most_rounds)
        state = len(session.valid()), len(session.missing()), most
        last = self._last.get(step)
        if last is None or last[0] != state:
            last = self._last[step] = state, self._progress(step, until, most)
        return last[1]

    def expected(self, frames: Sequence[PlannedFrame]) -> list[PlannedFrame]:
        """Return the frames without those of rounds that will probably not be needed."""
        wanted = {step: progress.wanted for step in self._steps() if (progress := self.progress(step)) is not None}
        return [frame for frame in frames if frame.round < wanted.get(frame.step, frame.round + 1)]

    def end_steps(self) -> None:
        """Record which steps need no further round, each after a whole one."""
        session = self._session
        if session.is_decided:
            return
        for step in self._steps():
            progress = self.progress(step)
            if progress is None or progress.begun or step in session.rounds_ended or not progress.whole:
                continue
            limited = progress.whole >= progress.most
            if progress.whole < progress.until.at_most_rounds and (limited or progress.reached):
                by_operator = limited and not progress.reached
                session.end_rounds(RoundsEnded(step, progress.whole, progress.sigma_e, by_operator))

    def _steps(self) -> list[int]:
        return [index for index, step in enumerate(self._session.plan.steps) if step.until is not None]

    def _taken(self, step: int) -> list[PlannedFrame]:
        valid = self._session.valid()
        return [frame for frame in self._session.frames if frame.step == step and frame.number in valid]

    def _progress(self, step: int, until: Until, most: int) -> Progress:
        session, taken = self._session, self._taken(step)
        open_rounds = [frame.round for frame in session.missing() if frame.step == step]
        whole = min(open_rounds, default=max((frame.round + 1 for frame in taken), default=0))
        begun = any(frame.round >= whole for frame in taken)
        least = max(whole + begun, 1)
        records = [session.valid()[frame.number].record for frame in taken]
        noise_e = None if self._predictor is None else self._predictor(session.plan.steps[step], records)
        if noise_e is None:
            return Progress(until, most, whole, begun, max(most, least), None, None)
        frames_of_round = sum((frame.step, frame.round) == (step, 0) for frame in session.frames)
        now_e = noise_e(len(taken) / frames_of_round) if taken else None
        enough = min(1 + bisect_left(range(1, most + 1), -until.sigma_e, key=lambda rounds: -noise_e(rounds)), most)
        # Frames that were left out cost a further round
        further = now_e is not None and not begun and now_e > until.sigma_e and whole < most
        wanted = max(enough, least, whole + further)
        return Progress(until, most, whole, begun, wanted, now_e, noise_e(wanted))
