"""Read a session: its plan, and the frames that were taken."""

from pathlib import Path

import msgspec

from faintfield.rig.errors import SessionCorrupt
from faintfield.rig.session.frames import PlannedFrame, planned_frames
from faintfield.rig.session.journal import CommittedFrame, Journal
from faintfield.rig.session.session import FRAMES, JOURNAL, PLAN, FrozenPlan


def read_plan(folder: Path) -> FrozenPlan:
    """Read the plan of the session in `folder`.

    Raises
    ------
    SessionCorrupt
        The plan is missing or cannot be read.
    """
    path = folder / PLAN
    try:
        return msgspec.json.decode(path.read_bytes(), type=FrozenPlan)
    except OSError as failure:
        raise SessionCorrupt(f"{path}: {failure.strerror}; name the folder of a session, or restore the file") from None
    except (msgspec.DecodeError, ValueError) as failure:
        raise SessionCorrupt(f"{path}: is not a plan ({failure}); restore it from a copy") from failure


def has_session(folder: Path) -> bool:
    """Return whether `folder` holds a session."""
    return (folder / PLAN).exists()


def taken_frames(folder: Path) -> list[tuple[PlannedFrame, CommittedFrame, Path]]:
    """Return the valid frames of a session in the order of the plan, each with its journal entry and its file.

    Raises
    ------
    SessionCorrupt
        Plan or journal cannot be read.
    """
    frames = planned_frames(read_plan(folder).plan)
    with Journal(folder / JOURNAL, read_only=True) as journal:
        valid = {it.frame: it for it in journal.committed() if it.void is None}
    return [(it, valid[it.number], folder / FRAMES / valid[it.number].file) for it in frames if it.number in valid]
