"""Verify a session: compare its plan, journal, files and hashes; and seal it again where records are not covered."""

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from pathlib import Path

from msgspec import Struct

from faintfield.rig.files import read_regular, sha256
from faintfield.rig.plan import planned_frames
from faintfield.rig.session.database import wal_bytes
from faintfield.rig.session.disk import list_names, lock_session, set_aside, translate_errors
from faintfield.rig.session.journal import Begun, CommittedFrame, RoundsEnded, Sealed, Suspect
from faintfield.rig.session.session import (
    ASIDE,
    FRAMES,
    JOURNAL,
    PLAN,
    ROUNDS_ENDED,
    SUMS,
    disagreements,
    exposure_name,
    is_sealed,
    left_out_by_sealing,
    odd_rounds,
    open_journal,
    read_plan,
    read_plan_and_hash,
    wanted_frames,
    write_sums,
)

# The sums of a capture of MAX_FRAMES frames, taken three times each, have this size in bytes.
_MAX_SUMS_BYTES = 50_000_000

# Problems of a session that faintfield 0.2.0 sealed while another program read its journal: with the WAL at hand, it
# can be sealed again; in a copy without the WAL, records are lost.
WAL_NOT_COVERED = (
    f"{JOURNAL}-wal: holds records that {SUMS} does not cover, as faintfield 0.2.0 left them while another program "
    f"read the journal; run `faintfield verify` with --repair, which moves them into {JOURNAL} and writes {SUMS} anew"
)
_WAL_LOST = f"{JOURNAL}: ends before the session was sealed; copy {JOURNAL}-wal too, which was beside it"

# SHA-256 of files by name, or why a file cannot be read.
type _Digests = dict[str, str | OSError]


class Verdict(Struct, frozen=True):
    """Result of `verify`.

    Parameters
    ----------
    problems : tuple of str
        All damage, one line each; empty if there is none. Restore what is named from a copy.
    interrupted : tuple of str
        Files in `frames/` of exposures that were cut short. This is ordinary: the next capture sets them aside and
        takes their frames.
    planned, present, superseded : int
        Number of frames in the plan, without those of rounds that were not needed; of those whose file is present and
        unchanged; and of files replaced by a later take.
    missing, left_out, suspect : tuple of str
        Names of the frames still to be taken, of those that the operator left out, and of those that were kept although
        the next check of the stage failed, or the stage was homed before it.
    sealed : bool
        Whether the session is complete.
    rounds : tuple of RoundsEnded
        Steps that ended before their last round.
    """

    problems: tuple[str, ...]
    interrupted: tuple[str, ...]
    planned: int
    present: int
    missing: tuple[str, ...]
    left_out: tuple[str, ...]
    superseded: int
    suspect: tuple[str, ...]
    sealed: bool
    rounds: tuple[RoundsEnded, ...] = ()


def verify(folder: Path, progress: Callable[[Iterable[Path]], Iterable[Path]] = iter) -> Verdict:
    """Verify the session in `folder`; `progress` wraps the iteration over the files that are read, to draw a bar.

    Raises `SessionBusy` if a capture is under way, `SessionCorrupt` if plan or journal are missing, damaged or not what
    a capture wrote, and `SessionUnreadable` if the system does not let lock, plan, journal or frames be read.
    """
    with lock_session(folder, shared=True) if os.path.lexists(folder / "lock") else nullcontext():
        frozen, plan_sha256 = read_plan_and_hash(folder)
        frames = planned_frames(frozen.plan)
        with open_journal(folder, frozen, read_only=True) as journal:
            committed = journal.committed()
            begun = [event.plan_sha256 for event in journal.details("begun", Begun)]
            sealed = [event.skipped for event in journal.details("sealed", Sealed)]
            suspects = {intent for event in journal.details("suspect", Suspect) for intent in event.intents}
            rounds_ended = tuple(journal.details(ROUNDS_ENDED, RoundsEnded))
            uncommitted = journal.uncommitted()
        names = list_names(folder / FRAMES)
        digests: _Digests = {path.name: _digest(path) for path in progress([folder / FRAMES / name for name in names])}
        orphans = set(names) - {frame.file for frame in committed}
        begun_names = {exposure_name(frames[frame], intent) for intent, frame in uncommitted if frame < len(frames)}
        interrupted = tuple(sorted(name for name in orphans if name.partition(".")[0] in begun_names))
        problems: list[str] = []
        if begun != [plan_sha256] and (begun or committed or uncommitted):  # else it was interrupted as it began
            problems.append(f"{PLAN}: is not the plan that the session was begun with")
        problems += disagreements(frames, committed)
        problems += [f"{JOURNAL}: {problem}" for problem in odd_rounds(frozen.plan, rounds_ended)]
        problems += _compare(committed, digests, orphans - set(interrupted))
        if is_sealed(folder):
            problems += [WAL_NOT_COVERED] * (wal_bytes(folder / JOURNAL) > 0) + [_WAL_LOST] * (not sealed)
            problems += _compare_sums(folder, committed, digests)
        valid = {frame.frame: frame for frame in committed if frame.void is None}
        left_out = {number for numbers in sealed[-1:] for number in numbers}
        wanted = wanted_frames(frames, rounds_ended)
        open_frames = [frame for frame in wanted if frame.number not in valid]
        missing = tuple(frame.name for frame in open_frames if frame.number not in left_out)
        if is_sealed(folder):
            problems += [f"{name}: is missing although the session is complete" for name in missing]
        return Verdict(
            problems=tuple(problems),
            interrupted=interrupted,
            planned=len(wanted),
            present=sum(digests.get(frame.file) == frame.sha256 for frame in valid.values()),
            missing=missing,
            left_out=tuple(frame.name for frame in open_frames if frame.number in left_out),
            superseded=sum(frame.void is not None and frame.file in digests for frame in committed),
            suspect=tuple(frame.file for frame in valid.values() if frame.intent in suspects),
            sealed=is_sealed(folder),
            rounds=rounds_ended,
        )


def repair(folder: Path, progress: Callable[[Iterable[Path]], Iterable[Path]] = iter) -> Verdict:
    """Seal the session in `folder` again if its journal was sealed with records in a WAL; return what `verify` does.

    Nothing is changed where there is any other problem. The earlier SHA256SUMS is set aside. A sealing that was
    interrupted, this one too, is completed.
    """
    verdict = verify(folder, progress)
    if verdict.missing or verdict.problems != ((WAL_NOT_COVERED,) if verdict.sealed else ()):
        return verdict
    with lock_session(folder), open_journal(folder, read_plan(folder)) as journal:
        left_out = left_out_by_sealing(journal)
        if left_out is None:
            return verdict
        if is_sealed(folder):
            set_aside(folder / SUMS, folder / ASIDE)
        journal.event("sealed", skipped=left_out, frames=verdict.present)
        write_sums(folder, journal)
    return verify(folder, progress)


def _digest(path: Path) -> str | OSError:
    try:
        return sha256(path)
    except OSError as failure:
        return failure


def _compare(committed: list[CommittedFrame], digests: _Digests, foreign: Iterable[str]) -> Iterator[str]:
    for frame in committed:
        match digests.get(frame.file):
            case OSError() as failure:
                yield f"{FRAMES}/{frame.file}: cannot be read ({failure.strerror or type(failure).__name__})"
            case None if frame.void is None:
                yield f"{FRAMES}/{frame.file}: is missing"
            case str(digest) if frame.void is None and digest != frame.sha256:
                yield f"{FRAMES}/{frame.file}: was altered"
    for name in sorted(foreign):
        yield f"{FRAMES}/{name}: is not in the journal"


def _compare_sums(folder: Path, committed: list[CommittedFrame], digests: _Digests) -> Iterator[str]:
    """Yield the disagreements between SHA256SUMS and the files; no file is opened because it is named there."""
    with translate_errors(folder / SUMS, read_only=True):
        lines = read_regular(folder / SUMS, _MAX_SUMS_BYTES).decode(errors="backslashreplace").splitlines()
    sums = {name: digest for digest, _, name in (line.partition("  ") for line in lines)}
    frames = {
        f"{FRAMES}/{frame.file}": digests.get(frame.file)
        for frame in committed
        if frame.void is None or frame.file in digests
    }
    actual = frames | {name: _digest(folder / name) for name in (PLAN, JOURNAL)}
    for name in sorted(sums.keys() | actual.keys()):
        if sums.get(name) != actual.get(name):
            yield f"{name}: does not agree with {SUMS}"
