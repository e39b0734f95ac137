"""Find lost steps during a capture by homing again, and have the affected frames taken again."""

from faintfield.rig.capture.dialogue import MAX_UNATTENDED_TRIES, Dialogue
from faintfield.rig.capture.guide import Answer, Prompt
from faintfield.rig.capture.pace import Pace
from faintfield.rig.devices import Rig
from faintfield.rig.errors import PositionDrifted
from faintfield.rig.session.journal import CommittedFrame
from faintfield.rig.session.session import Session
from faintfield.rig.stages.drift import DriftWatch


class DriftChecks:
    """The drift checks of a capture, if the rig asks for any.

    Parameters
    ----------
    session : Session
        Open session, whose frames become void if they are taken again.
    rig : Rig
        Stage and clock.
    dialogue : Dialogue
        Asks what to do after lost steps.
    pace : Pace
        Learns how long a check takes.

    Attributes
    ----------
    watch : DriftWatch or None
        Measures the drift; None if `drift.check` is off.
    """

    def __init__(self, session: Session, rig: Rig, dialogue: Dialogue, pace: Pace) -> None:
        settings = session.frozen.rig.drift
        self._session = session
        self._rig = rig
        self._dialogue = dialogue
        self._pace = pace
        self._nodes = 0
        self._failures = 0
        self.watch = DriftWatch(rig.stage, limit_mm=settings.limit_mm) if settings.check else None

    def begin(self) -> None:
        """Home, and learn how long homing and a check take if drift is checked."""
        if self.watch is None:
            self._rig.stage.home()
            return
        self.watch.begin()
        begun_s = self._rig.clock.now_s()
        self.watch.check()
        self._pace.check_s = self._rig.clock.now_s() - begun_s

    def count_node(self) -> None:
        """Note that the stage moved to a node."""
        self._nodes += 1

    def add(self, frame: CommittedFrame) -> None:
        """Note that a frame relies on the position of the stage."""
        if self.watch is not None:
            self.watch.visited(frame)

    def check_after(self, nodes: int) -> None:
        """Check for drift if at least `nodes` nodes were visited since the last check; 0 means no check."""
        if self.watch is None or nodes == 0 or self._nodes < nodes or not self.watch.unchecked:
            return
        self._nodes = 0
        self._pace.here = None
        try:
            drift = self.watch.check()
        except PositionDrifted as failure:
            self._handle_drift(failure)
        else:
            self._session.journal.event("drift_check", away_mm=drift.away_mm)

    def _handle_drift(self, failure: PositionDrifted) -> None:
        """Record which frames are suspect, and ask whether to take them again."""
        suspect = [it for it in failure.suspect if isinstance(it, CommittedFrame)]
        self._session.journal.event("suspect", message=str(failure), intents=[it.intent for it in suspect])
        self._dialogue.warn(str(failure))
        self._failures += 1
        unattended: Answer = "retake" if self._failures < MAX_UNATTENDED_TRIES else "stop"
        answer = self._dialogue.ask(
            Prompt("drift", "The stage lost its scale", (str(failure),), ("retake", "keep", "stop"), unattended)
        )
        if answer == "stop":
            self._dialogue.stop()
        if answer == "retake":
            self._session.void(suspect, "taken from a doubtful position")
        self._rig.stage.recover()
        self.begin()
