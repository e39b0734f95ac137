"""Begin, resume and verify a session: plan, journal, files and hashes have to agree."""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
from msgspec import Struct

from faintfield.rig.errors import PlanRefused, SessionCorrupt
from faintfield.rig.plan import PlannedFrame, planned_frames
from faintfield.rig.session.disk import PART, lock_session, set_aside, translate_errors, write_new
from faintfield.rig.session.durable import sha256, sync_folder
from faintfield.rig.session.journal import Begun, CommittedFrame, Journal, Sealed, Suspect
from faintfield.rig.session.session import (
    ASIDE,
    FRAMES,
    JOURNAL,
    PLAN,
    SUMS,
    FrozenPlan,
    Session,
    has_session,
    is_sealed,
    read_plan,
)
from faintfield.rig.settings import RigSettings

type Progress = Callable[[Iterable[CommittedFrame]], Iterable[CommittedFrame]]


@contextmanager
def open_session(folder: Path, plan: FrozenPlan | None, progress: Progress = iter) -> Iterator[Session]:
    """Begin a session in `folder`, or resume the one it holds; close it when the block ends.

    Parameters
    ----------
    folder : Path
        Folder of the session, which is created if needed.
    plan : FrozenPlan, optional
        Plan of a new session. A session that was begun keeps its own plan.
    progress : callable
        Wraps the iteration over the frames whose hashes are compared, to draw a progress bar.

    Raises
    ------
    SessionBusy
        Another capture holds the session.
    SessionCorrupt
        Plan and journal disagree, the session is complete, or the folder holds other files and no session.
    SessionUnwritable
        The folder cannot be written.
    """
    with translate_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with lock_session(folder):
        if is_sealed(folder):
            raise SessionCorrupt(f"{folder}: is complete and is not written to any more; name another folder")
        if not has_session(folder):
            _begin(folder, plan)
        frozen = read_plan(folder)
        with Journal(folder / JOURNAL, create=not (folder / JOURNAL).exists()) as journal:
            _check_plan_hash(folder, journal)
            with translate_errors(folder):
                (folder / FRAMES).mkdir(exist_ok=True)
            session = Session(folder, frozen, journal)
            _reconcile(session, progress)
            yield session


def _begin(folder: Path, plan: FrozenPlan | None) -> None:
    """Write the plan, the first file of a session besides the lock."""
    if plan is None:
        raise SessionCorrupt(f"{folder}: holds no session; name another folder, or begin one from a rig.toml")
    others = sorted(it.name for it in folder.iterdir() if it.name not in ("lock", PLAN + PART))
    if others:
        raise SessionCorrupt(f"{folder}: holds {others[0]} and no session; name a new or empty folder")
    write_new(folder / PLAN, msgspec.json.format(msgspec.json.encode(plan)) + b"\n")
    sync_folder(folder.parent)


def _check_plan_hash(folder: Path, journal: Journal) -> None:
    """Compare the hash of the plan with the one in the journal, or record it in a new journal."""
    digest = hashlib.sha256((folder / PLAN).read_bytes()).hexdigest()
    begun = journal.details("begun", Begun)
    if not begun:
        if any((folder / FRAMES).glob("*")):
            raise SessionCorrupt(f"{folder / JOURNAL}: is empty but there are frames; restore the journal from a copy")
        journal.event("begun", plan_sha256=digest)
    elif begun[0].plan_sha256 != digest:
        raise SessionCorrupt(f"{folder / PLAN}: was changed after the session was begun; restore it from a copy")
    else:
        journal.event("resumed")


def _reconcile(session: Session, progress: Progress) -> None:
    """Set aside files that are not in the journal; declare frames void whose file is altered or missing."""
    folder, journal = session.folder, session.journal
    committed = {it.file for it in journal.committed()}
    with translate_errors(folder):
        orphans = sorted(path for path in (folder / FRAMES).iterdir() if path.name not in committed)
    for path in orphans:
        journal.event("set_aside", file=path.name, to=set_aside(path, folder / ASIDE).name, why="not committed")
    for it in progress(list(session.valid().values())):
        path = session.path_of(it)
        if not path.is_file():
            journal.event("gone", frame=it.frame, file=it.file)
        elif sha256(path) != it.sha256:
            moved = set_aside(path, folder / ASIDE)
            journal.event("set_aside", frame=it.frame, file=path.name, to=moved.name, why="altered")
        else:
            continue
        session.void([it], "altered or gone")


def check_same_rig(frozen: FrozenPlan, now: RigSettings) -> None:
    """Raise if a session was planned for another rig than the present one.

    The port, its baud rate and the `[scene]` table, which is only read after the capture, may differ.

    Raises
    ------
    PlanRefused
        A table differs; the message names the first.
    """
    stage = msgspec.structs.replace(now.stage, port=frozen.rig.stage.port, baud=frozen.rig.stage.baud)
    now = msgspec.structs.replace(now, stage=stage, scene=frozen.rig.scene)
    for name in now.__struct_fields__:
        if getattr(now, name) != getattr(frozen.rig, name):
            raise PlanRefused(
                f"[{name}] of the rig.toml is not what the session was begun with; restore it, or begin a new session"
            )


class Verdict(Struct, frozen=True):
    """Result of `verify`.

    Parameters
    ----------
    problems : tuple of str
        All problems, one line each; empty if there is none.
    planned, present : int
        Number of frames in the plan, and of those whose file is present and unchanged.
    missing : tuple of str
        Names of the frames still to be taken, without those left out on purpose.
    left_out : tuple of str
        Names of the frames that the operator left out.
    superseded : int
        Number of files replaced by a later take of the same frame.
    suspect : tuple of str
        Names of frames that were kept although the next check of the stage failed.
    sealed : bool
        Whether the session is complete.
    """

    problems: tuple[str, ...]
    planned: int
    present: int
    missing: tuple[str, ...]
    left_out: tuple[str, ...]
    superseded: int
    suspect: tuple[str, ...]
    sealed: bool


def verify(folder: Path, progress: Callable[[Iterable[Path]], Iterable[Path]] = iter) -> Verdict:
    """Verify the session in `folder`.

    Parameters
    ----------
    folder : Path
        Folder of the session.
    progress : callable
        Wraps the iteration over the files that are read, to draw a progress bar.

    Raises
    ------
    SessionBusy
        A capture is under way.
    SessionCorrupt
        Plan or journal cannot be read.
    """
    if not (folder / PLAN).is_file():
        raise SessionCorrupt(f"{folder / PLAN}: is missing; name the folder of a session, or restore the file")
    if not (folder / "lock").exists():
        return _verify(folder, progress)
    with lock_session(folder, shared=True):
        return _verify(folder, progress)


def _verify(folder: Path, progress: Callable[[Iterable[Path]], Iterable[Path]]) -> Verdict:
    """Verify a session whose lock is held, or that has none."""
    frozen = read_plan(folder)
    frames = planned_frames(frozen.plan)
    with Journal(folder / JOURNAL, read_only=True) as journal:
        damage = journal.damage()
        committed = journal.committed()
        begun = [event.plan_sha256 for event in journal.details("begun", Begun)]
        sealed = [event.skipped for event in journal.details("sealed", Sealed)]
        suspects = {intent for event in journal.details("suspect", Suspect) for intent in event.intents}
    digests = {path.name: sha256(path) for path in progress(sorted((folder / FRAMES).glob("*")))}
    problems = [] if damage is None else [f"{JOURNAL}: {damage}"]
    if begun != [hashlib.sha256((folder / PLAN).read_bytes()).hexdigest()]:
        problems.append(f"{PLAN}: is not the plan that the session was begun with")
    problems += _compare(frames, committed, digests)
    if is_sealed(folder):
        problems += _compare_sums(folder, digests)
    valid = {it.frame: it for it in committed if it.void is None}
    left_out = {number for numbers in sealed[-1:] for number in numbers}
    open_frames = [it for it in frames if it.number not in valid]
    missing = tuple(it.name for it in open_frames if it.number not in left_out)
    if is_sealed(folder):
        problems += [f"{name}: is missing although the session is complete" for name in missing]
    return Verdict(
        problems=tuple(problems),
        planned=len(frames),
        present=sum(digests.get(it.file) == it.sha256 for it in valid.values()),
        missing=missing,
        left_out=tuple(it.name for it in open_frames if it.number in left_out),
        superseded=sum(it.void is not None and it.file in digests for it in committed),
        suspect=tuple(it.file for it in valid.values() if it.intent in suspects),
        sealed=is_sealed(folder),
    )


def _compare(
    frames: tuple[PlannedFrame, ...], committed: list[CommittedFrame], digests: dict[str, str]
) -> Iterator[str]:
    """Yield the disagreements between plan, journal and files."""
    taken: dict[int, str] = {}
    for it in committed:
        if not 0 <= it.frame < len(frames) or not it.file.startswith(frames[it.frame].name):
            yield f"{FRAMES}/{it.file}: is not a frame of the plan"
        elif it.void is None and taken.setdefault(it.frame, it.file) != it.file:
            yield f"{FRAMES}/{it.file}: is the same frame as {taken[it.frame]}"
        if it.file not in digests:
            if it.void is None:
                yield f"{FRAMES}/{it.file}: is missing"
        elif digests[it.file] != it.sha256 and it.void is None:
            yield f"{FRAMES}/{it.file}: was altered"
    for name in sorted(digests.keys() - {it.file for it in committed}):
        yield f"{FRAMES}/{name}: is not in the journal"


def _compare_sums(folder: Path, digests: dict[str, str]) -> Iterator[str]:
    """Yield the disagreements between SHA256SUMS and the files."""
    lines = (folder / SUMS).read_text(encoding="utf-8", errors="replace").splitlines()
    stated = {name: digest for digest, _, name in (line.partition("  ") for line in lines)}
    actual = {f"{FRAMES}/{name}": digest for name, digest in digests.items()}
    actual |= {name: sha256(folder / name) for name in (PLAN, JOURNAL)}
    for name in sorted(stated.keys() | actual.keys()):
        if stated.get(name) != actual.get(name):
            yield f"{name}: does not agree with {SUMS}"
