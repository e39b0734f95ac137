"""A session: begun once from a plan, resumed as often as need be, sealed when every frame is there."""

import hashlib
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from msgspec import Struct

from faintfield.rig.cameras.protocol import Exposure
from faintfield.rig.plan import CapturePlan
from faintfield.rig.session.disk import file_of, sha256, write_new
from faintfield.rig.session.frames import PlannedFrame, planned_frames
from faintfield.rig.session.journal import Committed, Journal
from faintfield.rig.settings import RigSettings

PLAN, JOURNAL, FRAMES, SUMS, ASIDE = "plan.json", "journal.sqlite", "frames", "SHA256SUMS", "set_aside"


class FrozenPlan(Struct, frozen=True, forbid_unknown_fields=True):
    """The content of plan.json: what is captured, and the rig that it was planned for.

    Parameters
    ----------
    plan : CapturePlan
        Every position and frame.
    rig : RigSettings
        The configuration as it was at the start.
    format : int
        Version of this layout.
    """

    plan: CapturePlan
    rig: RigSettings
    format: int = 1


class Written(Struct, frozen=True):
    """A file that is whole and on disk, and not committed yet."""

    intent: int
    path: Path
    sha256: str
    bytes: int


class Session:
    """An open session that no other capture has; made by `rig.session.access.opened`.

    Parameters
    ----------
    folder : Path
        Where it is.
    frozen : FrozenPlan
        What plan.json says.
    journal : Journal
        What happened so far.

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
        """The plan."""
        return self.frozen.plan

    def valid(self) -> Mapping[int, Committed]:
        """Return the frames that count, by their place in the plan."""
        return self._valid

    def missing(self) -> list[PlannedFrame]:
        """Return the frames still to be taken, in order; skipped ones come back when the session is run again."""
        return [it for it in self.frames if it.number not in self._valid and it.number not in self._skipped]

    def skipped(self) -> list[PlannedFrame]:
        """Return the frames that were skipped since the session was opened."""
        return [self.frames[number] for number in sorted(self._skipped)]

    def skip(self, frame: PlannedFrame) -> None:
        """Leave a frame out for now."""
        self.journal.event("skipped", frame=frame.number)
        self._skipped.add(frame.number)

    def unskip(self) -> None:
        """Ask for the skipped frames again."""
        self._skipped.clear()

    def intend(self, frame: PlannedFrame) -> int:
        """Record that `frame` is about to be taken, and return the number of the exposure."""
        return self.journal.intend(frame.number)

    def write(self, frame: PlannedFrame, intent: int, exposure: Exposure) -> Written:
        """Write the file of an exposure under a name that no other exposure has."""
        content = file_of(exposure)
        path = self.folder / FRAMES / f"{frame.name}_x{intent}{exposure.suffix}"
        # Of the bytes in memory, while they are written: what a disk gets wrong from here on, `verify` finds.
        with ThreadPoolExecutor(1) as hashing:
            digest = hashing.submit(hashlib.sha256, content)
            write_new(path, content)
        return Written(intent, path, digest.result().hexdigest(), len(content))

    def commit(self, frame: PlannedFrame, written: Written, detail: dict[str, Any]) -> Committed:
        """Record that a frame is there for good; an earlier take of it does not count any more."""
        self.journal.commit(written.intent, written.path.name, written.sha256, written.bytes, detail)
        done = Committed(written.intent, frame.number, written.path.name, written.sha256, written.bytes, detail)
        self._valid[frame.number] = done
        return done

    def void(self, frames: Iterable[Committed], why: str) -> None:
        """Let frames not count any more: their files stay, and they are missing again."""
        voided = [it for it in frames if self._valid.get(it.frame) == it]
        self.journal.void([it.intent for it in voided], why)
        for it in voided:
            del self._valid[it.frame]

    def path_of(self, committed: Committed) -> Path:
        """Return where a frame's file is."""
        return self.folder / FRAMES / committed.file

    def seal(self) -> None:
        """Close the journal and write SHA256SUMS over plan, journal and frames: the session is complete.

        Skipped frames are left out for good, and the journal says so.
        """
        self.journal.event("sealed", skipped=sorted(self._skipped), frames=len(self._valid))
        self.journal.close()
        names = [PLAN, JOURNAL, *sorted(f"{FRAMES}/{path.name}" for path in (self.folder / FRAMES).iterdir())]
        lines = [f"{sha256(self.folder / name)}  {name}\n" for name in names]
        write_new(self.folder / SUMS, "".join(lines).encode())


def is_sealed(folder: Path) -> bool:
    """Return whether the session in `folder` is complete."""
    return (folder / SUMS).is_file()
