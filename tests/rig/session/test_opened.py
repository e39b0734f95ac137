"""What holds after a session was opened: work without a limit, and reading without a lock file."""

import shutil
from pathlib import Path

import pytest

from faintfield.rig.errors import SessionCorrupt
from faintfield.rig.session import database
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.verify import verify
from tests.faults.capturing import FRAMES, capture_small


def test_only_checks_at_opening_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "_STEPS", 0)
    monkeypatch.setattr(database, "_STEPS_PER_BYTE", 0)
    path = tmp_path / "journal.sqlite"
    with Journal(path, create=True) as journal:
        for number in range(300):
            journal.event("warning", message=str(number))
        assert len(list(journal.events("warning"))) == 300
    with pytest.raises(SessionCorrupt, match="; restore"):
        Journal(path)


def test_a_session_copied_without_its_lock_file_is_verified_and_stays_without(tmp_path: Path) -> None:
    capture_small(tmp_path / "session")
    copy = Path(shutil.copytree(tmp_path / "session", tmp_path / "copy"))
    (copy / "lock").unlink()
    before = sorted(path.name for path in copy.rglob("*"))
    verdict = verify(copy)
    assert verdict.problems == ()
    assert (verdict.present, verdict.sealed) == (FRAMES, True)
    assert sorted(path.name for path in copy.rglob("*")) == before
