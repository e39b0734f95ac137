"""The session of a capture: its frames that are taken or missing, how one is recorded, and how all are read."""

import hashlib
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec
from msgspec import Struct

from faintfield.rig.cameras.protocol import Exposure
from faintfield.rig.errors import SessionCorrupt
from faintfield.rig.plan import CapturePlan, PlannedFrame, planned_frames
from faintfield.rig.session.disk import encode_exposure, write_new
from faintfield.rig.session.journal import CommittedFrame, FrameRecord, Journal
from faintfield.rig.session.regular_files import sha256
from faintfield.rig.settings import RigSettings

PLAN, JOURNAL, FRAMES, SUMS, ASIDE = "plan.json", "journal.sqlite", "frames", "SHA256SUMS", "set_aside"


class FrozenPlan(Struct, frozen=True, forbid_unknown_fields=True):
    """Content of plan.json: the plan of a capture and the rig that it was made for.

    Parameters
    ----------
    plan : CapturePlan
        All positions and frames.
    rig : RigSettings
        Configuration of the rig when the session was begun.
    format : int
        Version of the file format.
    """

    plan: CapturePlan
    rig: RigSettings
    format: int = 1


class WrittenFile(Struct, frozen=True):
    """A frame's file that is complete on disk but not yet committed."""

    intent: int
    path: Path
    sha256: str
    bytes: int


class Session:
    """A session open for writing, as `rig.session.resume.open_session` yields it.

    Parameters
    ----------
    folder : Path
        Folder of the session.
    frozen : FrozenPlan
        Content of plan.json.
    journal : Journal
        Open journal of the session.

    Attributes
    ----------
    frames : tuple of PlannedFrame
        All frames of the plan, in order.
    """

    def __init__(self, folder: Path, frozen: FrozenPlan, journal: Journal) -> None:
        self.folder = folder
        self.frozen = frozen
        self.journal = journal
        self.frames = planned_frames(frozen.plan)
        self._skipped: set[int] = set()
        self._valid = {it.frame: it for it in journal.committed() if it.void is None}

    @property
    def plan(self) -> CapturePlan:
        """Plan of the capture."""
        return self.frozen.plan

    def valid(self) -> Mapping[int, CommittedFrame]:
        """Return the valid frames by their index in the plan."""
        return self._valid

    def missing(self) -> list[PlannedFrame]:
        """Return the frames still to be taken, in order, without those skipped since the session was opened."""
        return [it for it in self.frames if it.number not in self._valid and it.number not in self._skipped]

    def skipped(self) -> list[PlannedFrame]:
        """Return the frames that were skipped since the session was opened."""
        return [self.frames[number] for number in sorted(self._skipped)]

    def skip(self, frame: PlannedFrame) -> None:
        """Leave a frame out until it is asked for again."""
        self.journal.event("skipped", frame=frame.number)
        self._skipped.add(frame.number)

    def unskip(self) -> None:
        """Count the skipped frames as missing again."""
        self._skipped.clear()

    def intend(self, frame: PlannedFrame) -> int:
        """Record that `frame` will be taken now, and return the number of the exposure."""
        return self.journal.intend(frame.number)

    def write(self, frame: PlannedFrame, intent: int, exposure: Exposure) -> WrittenFile:
        """Write the file of an exposure under a name that contains its number, and is therefore unique."""
        content = encode_exposure(exposure)
        path = self.folder / FRAMES / f"{frame.name}_x{intent}{exposure.suffix}"
        # Hash the bytes in memory, while they are written: `verify` then finds errors of the disk.
        with ThreadPoolExecutor(1) as hashing:
            digest = hashing.submit(hashlib.sha256, content)
            write_new(path, content)
        return WrittenFile(intent, path, digest.result().hexdigest(), len(content))

    def commit(self, frame: PlannedFrame, written: WrittenFile, record: FrameRecord) -> CommittedFrame:
        """Record that a frame is taken; earlier takes of it become void."""
        self.journal.commit(written.intent, written.path.name, written.sha256, written.bytes, record)
        done = CommittedFrame(written.intent, frame.number, written.path.name, written.sha256, written.bytes, record)
        self._valid[frame.number] = done
        return done

    def void(self, frames: Iterable[CommittedFrame], why: str) -> None:
        """Declare frames void: their files stay, and the frames are missing again."""
        voided = [it for it in frames if self._valid.get(it.frame) == it]
        self.journal.void([it.intent for it in voided], why)
        for it in voided:
            del self._valid[it.frame]

    def path_of(self, committed: CommittedFrame) -> Path:
        """Return the path of a frame's file."""
        return self.folder / FRAMES / committed.file

    def seal(self) -> None:
        """Close the journal and write SHA256SUMS over plan, journal and frames, which completes the session.

        Skipped frames are left out for good, as the journal records.
        """
        self.journal.event("sealed", skipped=sorted(self._skipped), frames=len(self._valid))
        self.journal.close()
        names = [PLAN, JOURNAL, *sorted(f"{FRAMES}/{path.name}" for path in (self.folder / FRAMES).iterdir())]
        lines = [f"{sha256(self.folder / name)}  {name}\n" for name in names]
        write_new(self.folder / SUMS, "".join(lines).encode())


def is_sealed(folder: Path) -> bool:
    """Return whether the session in `folder` is complete."""
    return (folder / SUMS).is_file()


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
