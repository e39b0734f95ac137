"""Ask and inform the operator during a capture, and keep both in the journal."""

from typing import NoReturn

from faintfield.rig.capture.guide import Answer, OperatorInterface, Prompt, Status, step_title
from faintfield.rig.capture.pace import Pace
from faintfield.rig.errors import CaptureStopped
from faintfield.rig.session.frames import PlannedFrame
from faintfield.rig.session.session import Session

# Without a person, a frame is given up after this many failures in a row, and a stage after losing steps as often.
MAX_UNATTENDED_TRIES = 3


class Dialogue:
    """The capture's side of the conversation with the operator.

    Parameters
    ----------
    session : Session
        Open session whose state is shown, and whose journal keeps what is said.
    operator : OperatorInterface
        Answers prompts and shows the state of the capture.
    pace : Pace
        Estimates the remaining time.

    Attributes
    ----------
    warnings : tuple of str
        The latest warnings, shown with the status.
    """

    def __init__(self, session: Session, operator: OperatorInterface, pace: Pace) -> None:
        self._session = session
        self._pace = pace
        self.operator = operator
        self.warnings: tuple[str, ...] = ()

    def ask(self, prompt: Prompt) -> Answer:
        """Ask the operator, and record question and answer."""
        answer = self.operator.ask(prompt)
        self._session.journal.event("prompt", key=prompt.key, title=prompt.title, lines=prompt.lines, answer=answer)
        return answer

    def warn(self, text: str) -> None:
        """Record a warning, and show it from now on."""
        self._session.journal.event("warning", message=text)
        self.warnings = (text,)

    def stop(self) -> NoReturn:
        """End the capture on behalf of the operator.

        Raises
        ------
        CaptureStopped
            Always.
        """
        self._session.journal.event("stopped")
        done, total = len(self._session.valid()), len(self._session.frames)
        raise CaptureStopped(f"stopped with {done} of {total} frames taken; run the same command to go on")

    def show_status(self, frame: PlannedFrame, doing: str) -> None:
        """Show the state of the capture, which is `doing` something for `frame`."""
        session = self._session
        missing, steps = session.missing(), session.plan.steps
        drift_checks = len({it.step for it in missing if steps[it.step].at == "grid"})
        if not session.frozen.rig.drift.check:
            drift_checks = 0
        self.operator.show_status(
            Status(
                doing=doing,
                step=frame.step + 1,
                steps=len(steps),
                title=step_title(frame, frame.step + 1, len(steps)),
                done=len(session.valid()),
                total=len(session.frames),
                to_go_s=self._pace.remaining_s(missing, drift_checks),
                node=frame.stop.node,
                grid=self._shares_done(frame.step),
                warnings=self.warnings,
            )
        )

    def _shares_done(self, step: int) -> tuple[tuple[float, ...], ...]:
        """Return the share of a step's frames that is done, per row and column; −1 where the step has none."""
        grid, valid = self._session.frozen.rig.grid, self._session.valid()
        counts = {(row, column): [0, 0] for row in range(grid.rows) for column in range(grid.columns)}
        for frame in self._session.frames:
            if frame.step == step:
                counts[frame.stop.node][0] += frame.number in valid
                counts[frame.stop.node][1] += 1
        return tuple(
            tuple(done / of if of else -1.0 for done, of in (counts[row, column] for column in range(grid.columns)))
            for row in range(grid.rows)
        )
