"""Verify a session: compare its plan, journal, files and hashes; nothing is changed."""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from msgspec import Struct

from faintfield.rig.errors import SessionCorrupt
from faintfield.rig.plan import PlannedFrame, planned_frames
from faintfield.rig.session.disk import lock_session
from faintfield.rig.session.journal import Begun, CommittedFrame, Journal, Sealed, Suspect
from faintfield.rig.session.regular_files import sha256
from faintfield.rig.session.session import FRAMES, JOURNAL, PLAN, SUMS, is_sealed, read_plan


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
    interrupted : tuple of str
        Names of the files of an exposure that was interrupted, which are no damage.
    """

    problems: tuple[str, ...]
    planned: int
    present: int
    missing: tuple[str, ...]
    left_out: tuple[str, ...]
    superseded: int
    suspect: tuple[str, ...]
    sealed: bool
    interrupted: tuple[str, ...] = ()


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
