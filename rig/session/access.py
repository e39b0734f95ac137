"""To begin a session, or to go on with one: plan, journal, files and hashes brought into agreement first."""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from faintfield.rig.errors import PlanRefused, SessionCorrupt
from faintfield.rig.session.disk import PART, in_words, locked, set_aside, sha256, sync_folder, write_new
from faintfield.rig.session.frames import PlannedFrame, planned_frames
from faintfield.rig.session.journal import Committed, Journal
from faintfield.rig.session.session import ASIDE, FRAMES, JOURNAL, PLAN, FrozenPlan, Session, is_sealed
from faintfield.rig.settings import RigSettings

type Progress = Callable[[Iterable[Committed]], Iterable[Committed]]


def read_plan(folder: Path) -> FrozenPlan:
    """Return the plan of the session in `folder`.

    Raises
    ------
    SessionCorrupt
        There is none, or it cannot be read.
    """
    path = folder / PLAN
    try:
        return msgspec.json.decode(path.read_bytes(), type=FrozenPlan)
    except OSError as failure:
        raise SessionCorrupt(f"{path}: {failure.strerror}; name the folder of a session, or restore the file") from None
    except (msgspec.DecodeError, ValueError) as failure:
        raise SessionCorrupt(f"{path}: is no plan ({failure}); restore it from a copy") from failure


def has_session(folder: Path) -> bool:
    """Return whether a session was begun in `folder`."""
    return (folder / PLAN).exists()


def taken_frames(folder: Path) -> list[tuple[PlannedFrame, Committed, Path]]:
    """Return the frames that count, in the order of the plan, each with its record and its file: for all who read.

    Raises
    ------
    SessionCorrupt
        Plan or journal cannot be read.
    """
    frames = planned_frames(read_plan(folder).plan)
    with Journal(folder / JOURNAL, read_only=True) as journal:
        valid = {it.frame: it for it in journal.committed() if it.void is None}
    return [(it, valid[it.number], folder / FRAMES / valid[it.number].file) for it in frames if it.number in valid]


@contextmanager
def opened(folder: Path, plan: FrozenPlan | None, progress: Progress = iter) -> Iterator[Session]:
    """Begin a session in `folder`, or go on with the one that is there, and close it in the end.

    Parameters
    ----------
    folder : Path
        Where it is or shall be.
    plan : FrozenPlan, optional
        To begin with. A session that was begun goes by its own, which is never computed again.
    progress : callable
        Draws a bar over the frames whose hashes are compared.

    Raises
    ------
    SessionBusy
        Another capture has it.
    SessionCorrupt
        Plan and journal do not agree, or the folder is complete, or holds other things.
    SessionUnwritable
        The folder cannot be written.
    """
    with in_words(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        if is_sealed(folder):
            raise SessionCorrupt(f"{folder}: is complete and is not written to any more; name another folder")
        if not has_session(folder):
            _begin(folder, plan)
        frozen = read_plan(folder)
        with Journal(folder / JOURNAL, create=not (folder / JOURNAL).exists()) as journal:
            _agree_on_plan(folder, journal)
            with in_words(folder):
                (folder / FRAMES).mkdir(exist_ok=True)
            session = Session(folder, frozen, journal)
            _reconcile(session, progress)
            yield session


def _begin(folder: Path, plan: FrozenPlan | None) -> None:
    """Freeze the plan: the first thing to be in the folder besides the lock."""
    if plan is None:
        raise SessionCorrupt(f"{folder}: holds no session; name another folder, or begin one from a rig.toml")
    strangers = sorted(it.name for it in folder.iterdir() if it.name not in ("lock", PLAN + PART))
    if strangers:
        raise SessionCorrupt(f"{folder}: holds {strangers[0]} and no session; name a new or empty folder")
    write_new(folder / PLAN, msgspec.json.format(msgspec.json.encode(plan)) + b"\n")
    sync_folder(folder.parent)


def _agree_on_plan(folder: Path, journal: Journal) -> None:
    """Compare the plan with the hash that the journal holds, or record it in a new journal."""
    digest = hashlib.sha256((folder / PLAN).read_bytes()).hexdigest()
    begun = journal.events("begun")
    if not begun:
        if any((folder / FRAMES).glob("*")):
            raise SessionCorrupt(f"{folder / JOURNAL}: is empty but there are frames; restore the journal from a copy")
        journal.event("begun", plan_sha256=digest)
    elif begun[0].detail["plan_sha256"] != digest:
        raise SessionCorrupt(f"{folder / PLAN}: was changed after the session was begun; restore it from a copy")
    else:
        journal.event("resumed")


def _reconcile(session: Session, progress: Progress) -> None:
    """Set aside what the journal does not vouch for; let frames that are damaged or gone be taken again."""
    folder, journal = session.folder, session.journal
    committed = {it.file for it in journal.committed()}
    with in_words(folder):
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


def refuse_other_rig(frozen: FrozenPlan, now: RigSettings) -> None:
    """Refuse to go on with a session on another rig than it was planned for.

    The port's name may change, and so may what is read after the capture only.

    Raises
    ------
    PlanRefused
        With the first table that differs.
    """
    stage = msgspec.structs.replace(now.stage, port=frozen.rig.stage.port, baud=frozen.rig.stage.baud)
    now = msgspec.structs.replace(now, stage=stage, scene=frozen.rig.scene)
    for name in now.__struct_fields__:
        if getattr(now, name) != getattr(frozen.rig, name):
            raise PlanRefused(
                f"[{name}] of the rig.toml is not what the session was begun with; restore it, or begin a new session"
            )
