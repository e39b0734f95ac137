"""The frames of a session while it is captured, for those who look on: read in other threads, never waited for."""

from pathlib import Path

from msgspec import Struct

from faintfield.pipelines.live.planes_messages import LiveFrame
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
        planned = self._session.frames
        found = [
            frame
            for frame in self._valid()
            if planned[frame.frame].step == step and planned[frame.frame].stop.node == node
        ]
        return [self._taken(frame) for frame in sorted(found, key=lambda frame: frame.frame)]

    def of_dark_scene(self) -> tuple[LiveFrame, ...]:
        """Return the frames of the dark scene, in the order of the plan."""
        planned = self._session.frames
        found = [frame for frame in self._valid() if planned[frame.frame].kind == "dark_scene"]
        return tuple(
            LiveFrame(frame.intent, frame.file, planned[frame.frame].stop.node, planned[frame.frame].exposure_s)
            for frame in sorted(found, key=lambda frame: frame.frame)
        )

    def _valid(self) -> list[CommittedFrame]:
        """Return the valid frames, copied in one step, as the capture changes them meanwhile."""
        return list(self._session.valid().values())

    def _taken(self, frame: CommittedFrame) -> TakenFrame:
        """Return what is known of a frame."""
        x_mm, y_mm = frame.record.position_mm
        name = self._session.frames[frame.frame].name
        written_s = _written_s(self._session.path_of(frame))
        return TakenFrame(name, (x_mm, y_mm), frame.record.exposure_s, written_s, dict(frame.record.checks))


def _written_s(path: Path) -> float | None:
    """Return when a file was written, None if it does not tell."""
    try:
        return path.stat().st_mtime
    except OSError:
        return None
