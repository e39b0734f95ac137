"""Begin or resume a session: plan, journal, files and hashes have to agree, and only some settings may have changed."""

import errno
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from faintfield.rig.errors import PlanRefused, SessionCorrupt
from faintfield.rig.files import make_folder, sha256
from faintfield.rig.session.disk import PART, list_names, lock_session, set_aside, translate_errors, write_new
from faintfield.rig.session.journal import Begun, CommittedFrame, Journal
from faintfield.rig.session.session import (
    ASIDE,
    FRAMES,
    JOURNAL,
    PLAN,
    FrozenPlan,
    Session,
    find_wild_number,
    has_session,
    is_sealed,
    open_journal,
    read_plan,
    read_plan_and_hash,
)
from faintfield.rig.settings import RigSettings

type Progress = Callable[[Iterable[CommittedFrame]], Iterable[CommittedFrame]]

# Kind of the journal's event for a setting that changed before a session was resumed.
CHANGED = "setting_changed"

# Tables and keys that may differ when a session is resumed, as no frame depends on them: they decide on warnings, are
# read after the capture, name where a device is found, or limit a wait.
_OPEN_TABLES = {"checks", "scene"}
_OPEN_KEYS = {
    "stage.port",
    "stage.baud",
    "stage.reconnect_s",
    "camera.port",
    "camera.answer_s",
    "camera.arrival_s",
    "camera.quiet_s",
    "camera.silence_s",
    "camera.delay_s",
    "camera.file_times",
    "camera.settle_limit_s",
    "light.on",
    "light.off",
    "light.state",
    "light.limit_s",
}

# What the port says besides: frames of a real and of a simulated stage are not of one session.
_REHEARSED = "stage.port (simulated)"


class SettingChange(Struct, frozen=True):
    """A setting whose value differs; detail of the event `setting_changed`.

    The key has its table, such as `checks.leak_dn` or `step[2].exposure_s`. Values are as in JSON, None where a file
    has no such key.
    """

    key: str
    old: Any
    new: Any

    @property
    def frozen(self) -> bool:
        """Return whether a session keeps the value that it was begun with."""
        key = re.sub(r"\[\d+\]", "", self.key)
        return key.partition(".")[0] not in _OPEN_TABLES and key not in _OPEN_KEYS

    def __str__(self) -> str:
        """Return the change in words."""
        return f"{self.key} was {_toml_text(self.old)} and is {_toml_text(self.new)}"


def find_changes(before: RigSettings, now: RigSettings) -> list[SettingChange]:
    """Return every setting that differs, in the order of the tables; at last whether the stage is simulated."""
    old, new = (dict(_leaves(msgspec.to_builtins(rig))) | {_REHEARSED: rig.stage.simulated} for rig in (before, now))
    keys = dict.fromkeys([*old, *new])
    return [SettingChange(key, old.get(key), new.get(key)) for key in keys if old.get(key) != new.get(key)]


def check_same_rig(frozen: FrozenPlan, now: RigSettings) -> None:
    """Raise `PlanRefused`, naming both values, if a setting differs from the plan of a session that keeps it."""
    if changes := ", ".join(str(change) for change in find_changes(frozen.rig, now) if change.frozen):
        raise PlanRefused(
            f"the rig.toml differs from the plan.json of the session: {changes}; set it back, or begin a new session"
        )


def adopt_settings(session: Session, now: RigSettings) -> list[SettingChange]:
    """Let the open settings of the present rig.toml apply from now on; record what changed, and return it.

    Raises `PlanRefused` as `check_same_rig` does.
    """
    check_same_rig(session.frozen, now)
    changes = find_changes(_settings_of(session.frozen, session.journal), now)
    session.journal.add_events(CHANGED, [change for change in changes if not change.frozen])
    session.rig = now
    return changes


def present_settings(folder: Path) -> RigSettings:
    """Return the settings that apply at present in the session in `folder`, which may be complete.

    Raises `SessionCorrupt` or `SessionUnreadable` if the plan or the journal cannot be read.
    """
    frozen = read_plan(folder)
    with open_journal(folder, frozen, read_only=True) as journal:
        return _settings_of(frozen, journal)


def _settings_of(frozen: FrozenPlan, journal: Journal) -> RigSettings:
    """Return the settings of the plan, with the changes that the journal records."""
    content: dict[str, Any] = msgspec.to_builtins(frozen.rig)
    try:
        for change in journal.details(CHANGED, SettingChange):
            place, _, key = change.key.partition(".")
            name, _, index = place.rstrip("]").partition("[")
            table = content[name][int(index)] if index else content[name]
            if change.frozen or key not in table:
                raise ValueError(f"{change.key!r:.60} does not change in a session")
            if wild := find_wild_number(change.new, change.key):
                raise ValueError(f"{wild} is too large")
            table[key] = change.new
        return msgspec.convert(content, RigSettings)
    except (msgspec.MsgspecError, ValueError, LookupError) as failure:
        raise SessionCorrupt(f"{journal.path}: {failure}; restore the journal from a copy") from failure


def _leaves(content: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value with its key; a list of tables is taken apart, any other list is a value."""
    if isinstance(content, dict):
        for name, value in content.items():
            yield from _leaves(value, f"{key}.{name}" if key else name)
    elif isinstance(content, Sequence) and content and all(isinstance(item, dict) for item in content):
        for index, value in enumerate(content):
            yield from _leaves(value, f"{key}[{index}]")
    else:
        yield key, content


def _toml_text(value: object) -> str:
    if value is None:
        return "not set"
    text = msgspec.json.encode(value).decode()
    return text if len(text) <= 60 else f"{text[:59]}…"


@contextmanager
def open_session(folder: Path, plan: FrozenPlan | None, progress: Progress = iter) -> Iterator[Session]:
    """Begin a session in `folder`, or resume the one it holds by its own plan; close it when the block ends.

    `progress` wraps the iteration over the frames whose hashes are compared, to draw a progress bar. Raises
    `SessionBusy` if another capture holds the session, `SessionCorrupt` if it is damaged or complete, or if the folder
    holds other files, and `SessionUnreadable` or `SessionUnwritable` if the system does not let it be used.
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
            session.rig = _settings_of(frozen, journal)
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
    """Set aside the files that are no frames, and declare void the frames whose files are altered or gone."""
    folder, journal = session.folder, session.journal
    committed = {frame.file for frame in journal.committed()}
    for name in names:
        if name not in committed:
            moved = set_aside(folder / FRAMES / name, folder / ASIDE)
            printable = os.fsencode(name).decode(errors="backslashreplace")
            journal.event("set_aside", file=printable, to=moved.name, why="not committed")
    present = set(names)
    for frame in progress(list(session.valid().values())):
        if frame.file not in present:
            journal.event("gone", frame=frame.frame, file=frame.file)
        elif not _is_intact(session.path_of(frame), frame.sha256):
            moved = set_aside(session.path_of(frame), folder / ASIDE)
            journal.event("set_aside", frame=frame.frame, file=frame.file, to=moved.name, why="altered")
        else:
            continue
        session.void([frame], "altered or gone")


def _is_intact(path: Path, digest: str) -> bool:
    """Return whether a frame's file is what was written; one that cannot be read may be, and is an error."""
    with translate_errors(path, read_only=True):
        try:
            return sha256(path) == digest
        except OSError as failure:
            if failure.errno in (errno.EINVAL, errno.ENOENT, errno.ELOOP):  # no regular file, or a link to nowhere
                return False
            raise
