"""Power cuts at any moment of a capture: what the journal calls committed is on disk, and the capture resumes.

The model is the strictest that POSIX allows: a file has the bytes that it had when it was last flushed, and a folder
the entries that it had when it was last flushed; all else is lost. SQLite flushes by itself, below Python: of its files
the bytes at the cut are taken to be on disk, and their entries as soon as the folder holds the journal.
"""

import itertools
import os
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from msgspec.structs import replace

from faintfield.rig.files import sync_folder
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import StepSettings
from tests.faults.capturing import SMALL_RIG, capture_small


class Disk:
    """Flushed content of the disk below a folder.

    Parameters
    ----------
    root : Path
        An existing folder, itself on disk.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._content: dict[int, bytes] = {}
        self._entries: dict[int, dict[str, int]] = {}
        self._kept: list[int] = []  # descriptors, so that no inode is given to another file

    def flush(self, descriptor: int) -> None:
        """Note that a file or folder is flushed now."""
        self._kept.append(os.dup(descriptor))
        state = os.fstat(descriptor)
        if stat.S_ISDIR(state.st_mode):
            entries = {entry.name: entry.inode() for entry in os.scandir(descriptor)}
            self._entries[state.st_ino] = entries
        else:
            self._content[state.st_ino] = Path(f"/proc/self/fd/{descriptor}").read_bytes()

    def lay_out(self, target: Path, *, all_entries: bool = False) -> None:
        """Copy to `target` what a power cut would leave now.

        With `all_entries`, folders have their present entries: a file system may write a new name early, and the bytes
        of its file late.
        """
        self._lay_out(self.root, self.root.stat().st_ino, target, all_entries)

    def close(self) -> None:
        for descriptor in self._kept:
            os.close(descriptor)

    def _lay_out(self, folder: Path, inode: int, target: Path, all_entries: bool) -> None:
        target.mkdir()
        present = {entry.name: entry.inode() for entry in os.scandir(folder)} if all_entries else {}
        for name, entry in (present or self._entries.get(inode, {})).items():
            there = folder / name
            if entry in self._entries or (there.is_dir() and there.stat().st_ino == entry):
                self._lay_out(there, entry, target / name, all_entries)
            else:
                (target / name).write_bytes(self._content.get(entry, b""))
        if (target / "journal.sqlite").exists():
            for suffix in ("", "-wal"):
                if (database := folder / f"journal.sqlite{suffix}").exists():
                    shutil.copyfile(database, target / database.name)


@contextmanager
def record(root: Path, on_change: Callable[[Disk], None]) -> Iterator[Disk]:
    """Record all that is flushed below `root`; call `on_change` before and after each flush, rename and new folder."""
    disk = Disk(root)
    at_work = False

    def notify() -> None:
        nonlocal at_work
        if not at_work:  # what is laid out is not recorded
            at_work = True
            on_change(disk)
            at_work = False

    def watch(name: str, note: Callable[..., None] = lambda *_: None) -> Any:
        original = getattr(os, name)

        def watched(*arguments: Any, **named: Any) -> Any:
            notify()
            result = original(*arguments, **named)
            note(*arguments)
            notify()
            return result

        return mock.patch.object(os, name, watched)

    try:
        with watch("fsync", disk.flush), watch("rename"), watch("mkdir"), watch("unlink"):
            yield disk
    finally:
        disk.close()


FRAMES = 3
THREE_FRAMES = replace(
    SMALL_RIG,
    grid=replace(SMALL_RIG.grid, rows=1, columns=2),
    step=(StepSettings("bright", 0.1), StepSettings("dark", 0.1)),
)


class Cuts:
    """Lays out what is left by a power cut at each change, in folders of its own."""

    all_entries = False

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.remains: list[Path] = []
        self._numbers = itertools.count()

    def __call__(self, disk: Disk) -> None:
        remains = self.folder / f"{next(self._numbers):04d}"
        disk.lay_out(remains, all_entries=self.all_entries)
        self.remains.append(remains)


@pytest.fixture
def cuts(tmp_path: Path) -> Cuts:
    (tmp_path / "cuts").mkdir()
    return Cuts(tmp_path / "cuts")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "live").mkdir()
    return tmp_path / "live"


@pytest.mark.parametrize("all_entries", [False, True])
def test_committed_frames_survive_a_power_cut(root: Path, cuts: Cuts, all_entries: bool) -> None:
    cuts.all_entries = all_entries
    with record(root, cuts):
        capture_small(root / "new" / "session", THREE_FRAMES)
    assert len(cuts.remains) > 6 * FRAMES
    present = []
    for remains in cuts.remains:
        session = remains / "new" / "session"
        if (session / "journal.sqlite").exists():
            verdict = verify(session)
            assert verdict.problems == (), remains.name
            present.append(verdict.present)
        for path in session.glob("frames/*.tiff"):
            assert path.stat().st_size > 0  # a name is given to whole files only
    assert present == sorted(present)
    assert set(present) == set(range(FRAMES + 1))
    assert not verify(cuts.remains[-1] / "new" / "session").missing
    assert verify(cuts.remains[-1] / "new" / "session").sealed


@pytest.mark.parametrize("each", [12, pytest.param(1, marks=pytest.mark.deep)])
def test_capture_resumes_after_a_power_cut(root: Path, cuts: Cuts, each: int) -> None:
    with record(root, cuts):
        capture_small(root / "session", THREE_FRAMES)
    for remains in cuts.remains[::each]:
        session = remains / "session"
        if not (session / "SHA256SUMS").exists():
            capture_small(session, THREE_FRAMES)
        verdict = verify(session)
        assert (verdict.problems, verdict.present, verdict.sealed) == ((), FRAMES, True)


def test_orphans_survive_a_power_cut_while_resuming(root: Path, cuts: Cuts) -> None:
    with record(root, cuts):
        capture_small(root / "session", THREE_FRAMES)
        (root / "session" / "SHA256SUMS").unlink()
        damaged = sorted((root / "session" / "frames").iterdir())[1]
        damaged.write_bytes(b"damaged")
        with damaged.open("rb") as file:
            os.fsync(file.fileno())
        sync_folder(root / "session")
        cuts.remains.clear()
        with open_session(root / "session", None):
            pass
    for remains in cuts.remains:
        assert any(path.read_bytes() == b"damaged" for path in (remains / "session").rglob(f"{damaged.name}*"))
