"""Record what a program flushes to disk, and lay out what is left if the power fails at any moment.

The model is the strictest that POSIX allows: a file has the bytes that it had when it was last flushed, and a folder
the entries that it had when it was last flushed; all else is lost. SQLite flushes by itself, below Python: of its files
the bytes at the cut are taken to be on disk, and their entries as soon as the folder holds the journal.
"""

import os
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock


class Disk:
    """What is on disk below a folder, as far as it is flushed.

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
            entries = {it.name: it.inode() for it in os.scandir(descriptor)}
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
        present = {it.name: it.inode() for it in os.scandir(folder)} if all_entries else {}
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
