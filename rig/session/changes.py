"""Compare a rig.toml with the one that a session was begun with: what may change before it is resumed, and what not."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from faintfield.rig.errors import PlanRefused, SessionCorrupt
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.session import FrozenPlan, Session, find_wild_number, open_journal, read_plan
from faintfield.rig.settings import RigSettings

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
    "camera.file_times",
    "camera.settle_limit_s",
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
        return self.key.partition(".")[0] not in _OPEN_TABLES and self.key not in _OPEN_KEYS

    def __str__(self) -> str:
        """Return the change in words."""
        return f"{self.key} was {_toml_text(self.old)} and is {_toml_text(self.new)}"


def find_changes(before: RigSettings, now: RigSettings) -> list[SettingChange]:
    """Return every setting that differs, in the order of the tables; at last whether the stage is simulated."""
    old, new = (dict(_leaves(msgspec.to_builtins(rig))) | {_REHEARSED: rig.stage.simulated} for rig in (before, now))
    keys = dict.fromkeys([*old, *new])
    return [SettingChange(key, old.get(key), new.get(key)) for key in keys if old.get(key) != new.get(key)]


def check_same_rig(frozen: FrozenPlan, now: RigSettings) -> None:
    """Raise if a session was planned for another rig than the present one.

    Raises
    ------
    PlanRefused
        A frozen setting differs; the message names each with both values.
    """
    if changes := ", ".join(str(change) for change in find_changes(frozen.rig, now) if change.frozen):
        raise PlanRefused(
            f"the rig.toml differs from the plan.json of the session: {changes}; set it back, or begin a new session"
        )


def adopt_settings(session: Session, now: RigSettings) -> list[SettingChange]:
    """Let the open settings of the present rig.toml apply from now on; record what changed, and return it.

    Raises
    ------
    PlanRefused
        A frozen setting differs.
    """
    check_same_rig(session.frozen, now)
    changes = find_changes(settings_of(session.frozen, session.journal), now)
    session.journal.add_events(CHANGED, [change for change in changes if not change.frozen])
    session.rig = now
    return changes


def settings_of(frozen: FrozenPlan, journal: Journal) -> RigSettings:
    """Return the settings that apply at present: those of the plan, with the changes that the journal records.

    Raises
    ------
    SessionCorrupt
        The journal records an impossible change.
    """
    try:
        return _changed(frozen.rig, journal.details(CHANGED, SettingChange))
    except (msgspec.MsgspecError, ValueError) as failure:
        raise SessionCorrupt(f"{journal.path}: {failure}; restore the journal from a copy") from failure


def present_settings(folder: Path) -> RigSettings:
    """Return the settings that apply at present in the session in `folder`, which may be complete.

    Raises
    ------
    SessionCorrupt, SessionUnreadable
        The plan or the journal cannot be read.
    """
    frozen = read_plan(folder)
    with open_journal(folder, frozen, read_only=True) as journal:
        return settings_of(frozen, journal)


def _changed(rig: RigSettings, changes: Iterable[SettingChange]) -> RigSettings:
    content: dict[str, dict[str, Any]] = msgspec.to_builtins(rig)
    for change in changes:
        table, _, key = change.key.partition(".")
        if change.frozen or key not in content[table]:
            raise ValueError(f"{change.key!r:.60} does not change in a session")
        if wild := find_wild_number(change.new, change.key):
            raise ValueError(f"{wild} is too large")
        content[table][key] = change.new
    return msgspec.convert(content, RigSettings)


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
