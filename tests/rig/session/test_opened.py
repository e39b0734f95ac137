"""What holds after a session was opened: work without a limit, and reading without a lock file."""

import shutil
from pathlib import Path

import pytest

from faintfield.rig.session import database
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.verify import verify
from tests.faults.capturing import FRAMES, capture_small


def test_only_the_checks_at_opening_are_limited_in_their_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "_STEPS", 20_000)
    monkeypatch.setattr(database, "_STEPS_PER_BYTE", 1)
    with Journal(tmp_path / "journal.sqlite", create=True) as journal:
        for number in range(1500):
            journal.event("warning", message=str(number))
        assert len(list(journal.events("warning"))) == 1500


def test_a_session_copied_without_its_lock_file_is_verified_and_stays_without(tmp_path: Path) -> None:
    capture_small(tmp_path / "session")
    copy = Path(shutil.copytree(tmp_path / "session", tmp_path / "copy"))
    (copy / "lock").unlink()
    before = sorted(path.name for path in copy.rglob("*"))
    verdict = verify(copy)
    assert verdict.problems == ()
    assert (verdict.present, verdict.sealed) == (FRAMES, True)
    assert sorted(path.name for path in copy.rglob("*")) == before
