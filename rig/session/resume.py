"""Begin or resume a session: plan, journal, files and hashes have to agree."""

import errno
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from faintfield.rig.errors import SessionCorrupt
from faintfield.rig.files import make_folder, sha256
from faintfield.rig.session.changes import settings_of
from faintfield.rig.session.disk import (
    PART,
    list_names,
    lock_session,
    set_aside,
    translate_errors,
    translate_read_errors,
    write_new,
)
from faintfield.rig.session.journal import Begun, CommittedFrame, Journal
from faintfield.rig.session.session import (
    ASIDE,
    FRAMES,
    JOURNAL,
    PLAN,
    FrozenPlan,
    Session,
    has_session,
    is_sealed,
    open_journal,
    read_plan_and_hash,
)

type Progress = Callable[[Iterable[CommittedFrame]], Iterable[CommittedFrame]]


@contextmanager
def open_session(folder: Path, plan: FrozenPlan | None, progress: Progress = iter) -> Iterator[Session]:
    """Begin a session in `folder`, or resume the one it holds; close it when the block ends.

    A session that was begun keeps its own plan. `progress` wraps the iteration over the frames whose hashes are
    compared, to draw a progress bar.

    Raises
    ------
    SessionBusy
        Another capture holds the session.
    SessionCorrupt
        Plan and journal disagree or are damaged, the session is complete, or the folder holds other files and no
        session.
    SessionUnreadable, SessionUnwritable
        The folder cannot be read or written.
    """
    with translate_errors(folder):
        make_folder(folder)
    with lock_session(folder):
        if is_sealed(folder):
            raise SessionCorrupt(f"{folder}: is complete and is not written to any more; name another folder")
        if not has_session(folder):
            _begin(folder, plan)
        frozen, digest = read_plan_and_hash(folder)
        names = list_names(folder / FRAMES)
        if names and not (folder / JOURNAL).exists():
            raise SessionCorrupt(f"{folder / JOURNAL}: is missing but there are frames; restore it from a copy")
        with open_journal(folder, frozen, create=True) as journal:
            _check_plan_hash(folder, journal, digest, begun=bool(names))
            with translate_errors(folder):
                make_folder(folder / FRAMES)
            session = Session(folder, frozen, journal)
            session.rig = settings_of(frozen, journal)
            _reconcile(session, names, progress)
            yield session


def _begin(folder: Path, plan: FrozenPlan | None) -> None:
    if plan is None:
        raise SessionCorrupt(f"{folder}: holds no session; name another folder, or begin one from a rig.toml")
    unexpected = [name for name in list_names(folder) if name not in ("lock", PLAN + PART)]
    if unexpected:
        raise SessionCorrupt(f"{folder}: holds {unexpected[0]} and no session; name a new or empty folder")
    write_new(folder / PLAN, msgspec.json.format(msgspec.json.encode(plan)) + b"\n")


def _check_plan_hash(folder: Path, journal: Journal, digest: str, *, begun: bool) -> None:
    begun_events = journal.details("begun", Begun)
    if not begun_events:
        if begun:
            raise SessionCorrupt(f"{folder / JOURNAL}: is empty but there are frames; restore the journal from a copy")
        journal.event("begun", plan_sha256=digest)
    elif begun_events[0].plan_sha256 != digest:
        raise SessionCorrupt(f"{folder / PLAN}: was changed after the session was begun; restore it from a copy")
    else:
        journal.event("resumed")


def _reconcile(session: Session, names: list[str], progress: Progress) -> None:
    folder, journal = session.folder, session.journal
    committed = {frame.file for frame in journal.committed()}
    present = set(names)
    for name in names:
        if name not in committed:
            moved = set_aside(folder / FRAMES / name, folder / ASIDE)
            printable = os.fsencode(name).decode(errors="backslashreplace")
            journal.event("set_aside", file=printable, to=moved.name, why="not committed")
    for frame in progress(list(session.valid().values())):
        path = session.path_of(frame)
        if frame.file not in present:
            journal.event("gone", frame=frame.frame, file=frame.file)
        elif not _is_intact(path, frame.sha256):
            moved = set_aside(path, folder / ASIDE)
            journal.event("set_aside", frame=frame.frame, file=path.name, to=moved.name, why="altered")
        else:
            continue
        session.void([frame], "altered or gone")


def _is_intact(path: Path, digest: str) -> bool:
    """Return whether a frame's file is what was written; one that cannot be read may be, and is an error."""
    with translate_read_errors(path):
        try:
            return sha256(path) == digest
        except OSError as failure:
            if failure.errno in (errno.EINVAL, errno.ENOENT, errno.ELOOP):  # no regular file, or a link to nowhere
                return False
            raise
