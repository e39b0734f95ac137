"""Begin or resume a session: plan, journal, files and hashes have to agree."""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from faintfield.rig.errors import PlanRefused, SessionCorrupt
from faintfield.rig.session.disk import PART, lock_session, set_aside, translate_errors, write_new
from faintfield.rig.session.durable import sync_folder
from faintfield.rig.session.journal import Begun, CommittedFrame, Journal
from faintfield.rig.session.regular_files import sha256
from faintfield.rig.session.session import (
    ASIDE,
    FRAMES,
    JOURNAL,
    PLAN,
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
