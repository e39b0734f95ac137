"""The frames of a session while it is captured, for those who look on: read in other threads, never waited for."""

from contextlib import suppress

from msgspec import Struct

from faintfield.pipelines.live.planes_messages import LiveFrame
from faintfield.rig.plan import PlannedFrame
from faintfield.rig.session.journal import CommittedFrame
from faintfield.rig.session.session import Session


class TakenFrame(Struct, frozen=True):
    """A frame that was taken: its name, where the stage was in mm, when its file was written (s since 1970)."""

    name: str
    position_mm: tuple[float, float]
    exposure_s: float
    written_s: float | None
    values: dict[str, float]


class TakenFrames:
    """The valid frames of an open session.

    Parameters
    ----------
    session : Session
        The session; its capture goes on in another thread.
    """

    def __init__(self, session: Session) -> None:
        self._session = session

    def at(self, step: int, node: tuple[int, int]) -> list[TakenFrame]:
        """Return the frames of a step at a node, in the order of the plan."""
        return [
            self._record(frame, planned)
            for frame, planned in self._valid()
            if planned.step == step and planned.stop.node == node
        ]

    def of_dark_scene(self) -> tuple[LiveFrame, ...]:
        """Return the frames of the dark scene, in the order of the plan."""
        return tuple(
            LiveFrame(frame.intent, frame.file, planned.stop.node, planned.exposure_s)
            for frame, planned in self._valid()
            if planned.kind == "dark_scene"
        )

    def _valid(self) -> list[tuple[CommittedFrame, PlannedFrame]]:
        """Return the valid frames in the order of the plan."""
        # Sorting copies them in one step: the capture changes them meanwhile
        frames = sorted(self._session.valid().values(), key=lambda frame: frame.frame)
        return [(frame, self._session.frames[frame.frame]) for frame in frames]

    def _record(self, frame: CommittedFrame, planned: PlannedFrame) -> TakenFrame:
        x_mm, y_mm = frame.record.position_mm
        written_s = None
        with suppress(OSError):
            written_s = self._session.path_of(frame).stat().st_mtime
        return TakenFrame(planned.name, (x_mm, y_mm), frame.record.exposure_s, written_s, dict(frame.record.checks))
