"""The session of a capture: its frames that are taken or missing, how one is recorded, and how all are read."""

import errno
import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec
from msgspec import Struct

from faintfield.rig.cameras.protocol import Exposure
from faintfield.rig.errors import SessionCorrupt, SessionUnreadable, SessionUnwritable
from faintfield.rig.files import is_plain_name, read_regular, sha256
from faintfield.rig.plan import MAX_NUMBER, CapturePlan, PlannedFrame, planned_frames
from faintfield.rig.session.database import FORMAT
from faintfield.rig.session.disk import encode_exposure, list_names, set_aside, translate_errors, write_new
from faintfield.rig.session.journal import (
    CommittedFrame,
    FrameRecord,
    Journal,
    RoundsEnded,
    RoundsLimited,
    Sealed,
)
from faintfield.rig.settings import RigSettings

PLAN, JOURNAL, FRAMES, SUMS, ASIDE = "plan.json", "journal.sqlite", "frames", "SHA256SUMS", "set_aside"

# Kinds of the journal's events for a step that needs no further rounds, and for one that shall have no more than some.
ROUNDS_ENDED, ROUNDS_LIMITED = "rounds_ended", "rounds_limited"

# Size in bytes of the plan of MAX_FRAMES stops, and more.
_MAX_PLAN_BYTES = 32_000_000


class FrozenPlan(Struct, frozen=True, forbid_unknown_fields=True):
    """`plan.json`: the plan of a capture, the rig that it was made for, and the version of the format.

    Attributes
    ----------
    plan : CapturePlan
        Frames to take, at which nodes.
    rig : RigSettings
        Settings of rig.toml at the beginning.
    format : int
        Version of the format of the session.
    """

    plan: CapturePlan
    rig: RigSettings
    format: int = FORMAT

    def __post_init__(self) -> None:
        if not 1 <= self.format <= FORMAT:
            raise ValueError(f"the session has format {self.format}, formats 1 to {FORMAT} are read; update faintfield")


class WrittenFile(Struct, frozen=True):
    """A frame's file that is complete on disk but not yet committed."""

    intent: int
    path: Path
    sha256: str
    bytes: int


class Session:
    """A session open for writing, as `rig.session.resume.open_session` yields it.

    `rig` has the settings that apply now: those of plan.json, with the changes that were made before it was resumed.
    With `is_decided` only sealing is left, and the frames that are skipped are left out for good.
    """

    def __init__(self, folder: Path, frozen: FrozenPlan, journal: Journal) -> None:
        self.folder = folder
        self.frozen = frozen
        self.journal = journal
        self.frames = planned_frames(frozen.plan)
        self.rig = frozen.rig
        left_out = left_out_by_sealing(journal)
        self.is_decided = left_out is not None
        self._skipped = set(left_out or ())
        self._valid = valid_frames(folder, self.frames, journal.committed())
        for problem in odd_rounds(frozen.plan, journal.details(ROUNDS_ENDED, RoundsEnded)):
            raise SessionCorrupt(f"{folder / JOURNAL}: {problem}; restore the journal from a copy")
        self.rounds_ended = {ended.step: ended for ended in journal.details(ROUNDS_ENDED, RoundsEnded)}
        limits = journal.details(ROUNDS_LIMITED, RoundsLimited)
        self.rounds_limited = {limited.step: limited.rounds for limited in limits}

    @property
    def plan(self) -> CapturePlan:
        """Plan of the capture."""
        return self.frozen.plan

    def valid(self) -> Mapping[int, CommittedFrame]:
        """Return the valid frames by their index in the plan."""
        return self._valid

    def wanted(self) -> list[PlannedFrame]:
        """Return the frames of the plan, in order, without those of rounds that are not needed."""
        return wanted_frames(self.frames, tuple(self.rounds_ended.values()))

    def missing(self) -> list[PlannedFrame]:
        """Return the frames still to be taken, in order, without those skipped since the session was opened."""
        there = self._valid.keys() | self._skipped
        return [frame for frame in self.wanted() if frame.number not in there]

    def limit_rounds(self, limited: RoundsLimited) -> None:
        """Record that the operator wants no more than some rounds of a step."""
        self.journal.add_events(ROUNDS_LIMITED, [limited])
        self.rounds_limited[limited.step] = limited.rounds

    def end_rounds(self, ended: RoundsEnded) -> None:
        """Record that a step needs no further rounds: their frames are not wanted any more."""
        self.journal.add_events(ROUNDS_ENDED, [ended])
        self.rounds_ended[ended.step] = ended

    def skipped(self) -> list[PlannedFrame]:
        """Return the frames that were skipped since the session was opened."""
        return [frame for frame in self.wanted() if frame.number in self._skipped]

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
        name = exposure_name(frame, intent) + exposure.suffix
        if not is_plain_name(name):
            raise SessionUnwritable(f"{exposure.suffix!r:.60} is no suffix of a file; correct what the camera gives")
        path = self.folder / FRAMES / name
        # Hash the bytes in memory, while they are written: `verify` then finds errors of the disk. Where writing fails,
        # the failure keeps them: unless they are released, Python complains as it ends.
        with encode_exposure(exposure) as content, ThreadPoolExecutor(1) as hashing:
            digest = hashing.submit(hashlib.sha256, content)
            write_new(path, content)
            return WrittenFile(intent, path, digest.result().hexdigest(), len(content))

    def reject(self, frame: PlannedFrame, written: WrittenFile, why: str) -> None:
        """Set the file of an exposure aside that is no frame of this session; its frame stays missing."""
        moved = set_aside(written.path, self.folder / ASIDE)
        self.journal.event("set_aside", frame=frame.number, file=written.path.name, to=moved.name, why=why)

    def commit(self, frame: PlannedFrame, written: WrittenFile, record: FrameRecord) -> CommittedFrame:
        """Record that a frame is taken; earlier takes of it become void."""
        self.journal.commit(written.intent, written.path.name, written.sha256, written.bytes, record)
        done = CommittedFrame(written.intent, frame.number, written.path.name, written.sha256, written.bytes, record)
        self._valid[frame.number] = done
        return done

    def void(self, frames: Iterable[CommittedFrame], why: str) -> None:
        """Declare frames void: their files stay, and the frames are missing again."""
        voided = [frame for frame in frames if self._valid.get(frame.frame) == frame]
        self.journal.void([frame.intent for frame in voided], why)
        for frame in voided:
            del self._valid[frame.frame]

    def path_of(self, committed: CommittedFrame) -> Path:
        """Return the path of a frame's file."""
        return self.folder / FRAMES / committed.file

    def seal(self) -> None:
        """Close the journal and write SHA256SUMS over plan, journal and frames, which completes the session.

        Skipped frames are left out for good, as the journal records. Raises `SessionUnwritable` if another program has
        the journal open; the session can then be resumed.
        """
        skipped = [frame.number for frame in self.skipped()]
        self.journal.event("sealed", skipped=skipped, frames=len(self._valid))
        write_sums(self.folder, self.journal)


def left_out_by_sealing(journal: Journal) -> tuple[int, ...] | None:
    """Return the frames that a sealing left out which was begun and did not end; None if none was, or work went on."""
    last = next((event for event in reversed(journal.events()) if event.kind != "resumed"), None)
    return journal.details("sealed", Sealed)[-1].skipped if last is not None and last.kind == "sealed" else None


def write_sums(folder: Path, journal: Journal) -> None:
    """Close the journal of the session in `folder` for good, and write SHA256SUMS over plan, journal and frames."""
    committed = {frame.file for frame in journal.committed()}
    journal.finish()
    names = [PLAN, JOURNAL, *(f"{FRAMES}/{name}" for name in list_names(folder / FRAMES) if name in committed)]
    with translate_errors(folder):
        lines = [f"{sha256(folder / name)}  {name}\n" for name in names]
    write_new(folder / SUMS, "".join(lines).encode())


def is_sealed(folder: Path) -> bool:
    """Return whether the session in `folder` is complete."""
    return (folder / SUMS).is_file()


def read_plan(folder: Path) -> FrozenPlan:
    """Read the plan of the session in `folder`.

    Raises `SessionCorrupt` if it is missing or none, `SessionUnreadable` if the system does not let it be read.
    """
    return read_plan_and_hash(folder)[0]


def read_plan_and_hash(folder: Path) -> tuple[FrozenPlan, str]:
    """Read the plan of the session in `folder`, and return its SHA-256, too; raises as `read_plan` does."""
    path = folder / PLAN
    try:
        encoded = read_regular(path, _MAX_PLAN_BYTES)
        content = msgspec.json.decode(encoded)
        if place := find_wild_number(content):
            raise SessionCorrupt(f"{path}: {place} in size is more than {MAX_NUMBER:g}; restore it from a copy")
        return msgspec.convert(content, FrozenPlan), hashlib.sha256(encoded).hexdigest()
    except OSError as failure:
        if failure.errno in (errno.ENOENT, errno.ENOTDIR):
            raise SessionCorrupt(f"{path}: is missing; name the folder of a session, or restore the file") from failure
        if failure.errno in (errno.EINVAL, errno.EFBIG, errno.ELOOP):
            raise SessionCorrupt(f"{path}: {failure.strerror}; restore it from a copy") from failure
        raise SessionUnreadable(f"{path}: {failure.strerror}; allow it to be read, or check the disk") from failure
    except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError) as failure:
        raise SessionCorrupt(f"{path}: is not a plan ({failure}); restore it from a copy") from failure


def find_wild_number(content: object, place: str = "plan") -> str | None:
    """Return place and value of a number that no rig has, at any depth."""
    if isinstance(content, dict):
        parts = [(value, f"{place}.{key}") for key, value in content.items()]
    elif isinstance(content, list):
        parts = [(value, f"{place}[{index}]") for index, value in enumerate(content)]
    elif isinstance(content, int | float) and not abs(content) <= MAX_NUMBER:
        return f"{place} = {float(content):g}"
    else:
        return None
    return next((wild for value, name in parts if (wild := find_wild_number(value, name))), None)


def open_journal(folder: Path, frozen: FrozenPlan, *, create: bool = False, read_only: bool = False) -> Journal:
    """Open the journal of the session in `folder`, which has to be of the format of its plan; raises as `Journal`."""
    journal = Journal(folder / JOURNAL, create=create, read_only=read_only)
    if journal.format != frozen.format:
        journal.close()
        raise SessionCorrupt(
            f"{journal.path}: has format {journal.format}, the plan {frozen.format}; restore the journal from a copy"
        )
    return journal


def disagreements(frames: Sequence[PlannedFrame], committed: Iterable[CommittedFrame]) -> Iterator[str]:
    """Yield how entries of a journal disagree with the plan, one line each."""
    taken: dict[int, str] = {}
    for frame in committed:
        if frame.frame >= len(frames):
            yield f"{FRAMES}/{frame.file}: is frame {frame.frame} of a plan of {len(frames)} frames"
        elif frame.file.partition(".")[0] != exposure_name(frames[frame.frame], frame.intent):
            yield f"{FRAMES}/{frame.file}: is not a frame of the plan"
        elif frame.record.exposure_s != frames[frame.frame].exposure_s:
            yield f"{FRAMES}/{frame.file}: has another exposure time than in the plan"
        elif frame.void is None and taken.setdefault(frame.frame, frame.file) != frame.file:
            yield f"{FRAMES}/{frame.file}: is the same frame as {taken[frame.frame]}"


def wanted_frames(frames: Iterable[PlannedFrame], rounds_ended: Iterable[RoundsEnded]) -> list[PlannedFrame]:
    """Return the frames without those of rounds that are not needed."""
    if not (rounds := {ended.step: ended.rounds for ended in rounds_ended}):
        return list(frames)
    return [frame for frame in frames if frame.round < rounds.get(frame.step, frame.round + 1)]


def odd_rounds(plan: CapturePlan, rounds_ended: Iterable[RoundsEnded]) -> Iterator[str]:
    """Yield how ends of rounds in a journal disagree with the plan, one line each."""
    most = {index: step.rounds for index, step in enumerate(plan.steps)}
    for ended in rounds_ended:
        if not ended.rounds < most.get(ended.step, 0):
            yield f"step {ended.step + 1} ended after {ended.rounds} rounds, of {most.get(ended.step, 0)} in the plan"


def exposure_name(frame: PlannedFrame, intent: int) -> str:
    """Return the name of the file of an exposure, without its suffix."""
    return f"{frame.name}_x{intent}"


def valid_frames(
    folder: Path, frames: Sequence[PlannedFrame], committed: Iterable[CommittedFrame]
) -> dict[int, CommittedFrame]:
    """Return the valid frames by their index in the plan; raises `SessionCorrupt` if an entry disagrees with it."""
    entries = list(committed)
    for problem in disagreements(frames, entries):
        raise SessionCorrupt(f"{folder / JOURNAL}: {problem}; restore the journal from a copy")
    return {frame.frame: frame for frame in entries if frame.void is None}


def has_session(folder: Path) -> bool:
    """Return whether `folder` holds a session."""
    return os.path.lexists(folder / PLAN)


def taken_frames(folder: Path) -> list[tuple[PlannedFrame, CommittedFrame, Path]]:
    """Return the valid frames of a session in the order of the plan, each with its journal entry and its file.

    Parameters
    ----------
    folder : Path
        The folder of the session.

    Returns
    -------
    list of (PlannedFrame, CommittedFrame, Path)
        The frame as planned (step, node, exposure), as taken (position, temperature, warnings), and its file.

    Raises
    ------
    SessionCorrupt, SessionUnreadable
        Plan or journal cannot be read.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from faintfield import taken_frames
    >>> from faintfield.pipelines.commands.capture import capture
    >>> rig_toml = '''
    ... stage = {protocol = "simulated"}
    ... camera = {backend = "simulated", size_px = [64, 48]}
    ... grid = {rows = 3, columns = 3, pitch_mm = 50.0, origin_mm = [-250.0, -250.0]}
    ... step = [{kind = "dark", exposure_s = [0.1, 1.0], frames_per_node = 2}]
    ... '''
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     rig, session = Path(folder, "rig.toml"), Path(folder, "session")
    ...     _ = rig.write_text(rig_toml)
    ...     _ = capture(rig, session, yes=True)  # faintfield capture rig.toml session --yes
    ...     frames = taken_frames(session)
    >>> [planned.exposure_s for planned, committed, path in frames]
    [0.1, 0.1, 1.0, 1.0]
    """
    frozen = read_plan(folder)
    frames = planned_frames(frozen.plan)
    with open_journal(folder, frozen, read_only=True) as journal:
        valid = valid_frames(folder, frames, journal.committed())
    list_names(folder / FRAMES)  # refuses a link that leads elsewhere
    present = [(frame, valid[frame.number]) for frame in frames if frame.number in valid]
    return [(frame, committed, folder / FRAMES / committed.file) for frame, committed in present]
