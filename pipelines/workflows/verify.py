"""Sessions verified against their journals, and results against their records and inputs: `faintfield verify`."""

from collections.abc import Sized
from pathlib import Path

import msgspec

from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import MissingFile, ResultDamaged
from faintfield.pipelines.formats.files import sha256
from faintfield.pipelines.formats.results.verification import (
    ResultVerdict,
    inputs_around,
    inputs_in,
    records_below,
    records_of,
    verify_results,
)
from faintfield.rig.capture.guide import describe_rounds
from faintfield.rig.errors import SessionCorrupt
from faintfield.rig.session.session import JOURNAL, has_session, taken_frames
from faintfield.rig.session.verify import WAL_NOT_COVERED, Verdict, repair, verify

# Problems printed one by one; the failure gives their number.
_MAX_SHOWN = 10


class Verified(msgspec.Struct, frozen=True):
    """The result of `faintfield verify`: what was found of a session, and of results."""

    path: str
    session: Verdict | None
    results: ResultVerdict | None


def verify_folder(path: Path, inputs: Path | None, *, repaired: bool = False) -> Verified:
    """Verify a session, which is sealed again first if it is to be `repaired`, and the results in a folder or record.

    Raises
    ------
    SessionCorrupt, ResultDamaged
        Something is damaged; the message counts the problems.
    """
    if inputs is not None and not inputs.is_dir():
        raise MissingFile(f"{inputs}: no such folder; name that of the session or set")
    session, known = None, {}
    if has_session(path) or (path / JOURNAL).exists():
        session = (repair if repaired else verify)(path, lambda paths: progress(list(paths), "hashing"))
        _report_session(path, session)
        if not session.problems:
            known = {frame.resolve(): taken.sha256 for _, taken, frame in taken_frames(path)}  # just found to be true
    records = records_below(path) if session else records_of(path)
    results = None
    if records:
        results = verify_results(
            records,
            inputs_in(inputs) if inputs else inputs_around,
            lambda paths: progress(paths, "hashing"),
            lambda file: known.get(file) or sha256(file),
        )
        _report_results(path, results)
    if session and session.problems == (WAL_NOT_COVERED,):
        raise SessionCorrupt(f"{path}: {WAL_NOT_COVERED}")
    if session and session.problems:
        raise SessionCorrupt(
            f"{path}: is damaged: {_count(session.problems, 'problem')}, the first: {session.problems[0]}; "
            "restore these files from a copy, and move what is not in the journal out of frames/"
        )
    if results and results.problems:
        raise ResultDamaged(
            f"{path}: {_count(results.problems, 'problem')} in its results, the first: {results.problems[0]}; "
            "restore these files from a copy, or make the results again by the command that made them"
        )
    return Verified(str(path), session, results)


def _report_session(folder: Path, verdict: Verdict) -> None:
    _list("problem", verdict.problems)
    state = "complete"
    if not verdict.sealed:
        state = (
            f"{len(verdict.missing)} still to be taken" if verdict.missing else "not sealed: run capture to finish it"
        )
    if verdict.problems:
        state = "damaged"
    inform(f"{folder}: {verdict.present} of {verdict.planned} frames present and whole, {state}")
    for count, what in (
        (len(verdict.left_out), "left out by the operator"),
        (verdict.superseded, "taken again; the earlier files are kept"),
        (len(verdict.suspect), "kept although no check of the stage confirms them"),
        (len(verdict.interrupted), "of an exposure that was interrupted, which is no damage; run capture again"),
    ):
        if count:
            inform(f"  {count} {what}")
    for ended in verdict.rounds:
        inform(f"  {describe_rounds(ended)}")


def _report_results(path: Path, verdict: ResultVerdict) -> None:
    _list("not checked", verdict.unchecked)
    _list("problem", verdict.problems)
    if not verdict.problems:
        inform(
            f"{path}: all agrees: records: {verdict.records}, files beside them: {verdict.files}, "
            f"inputs: {verdict.inputs}; not checked: {len(verdict.unchecked) or 'nothing'}"
        )


def _count(things: Sized, noun: str) -> str:
    return f"{len(things)} {noun}{'' if len(things) == 1 else 's'}"


def _list(label: str, lines: tuple[str, ...]) -> None:
    for line in lines[:_MAX_SHOWN]:
        inform(f"{label}: {line}")
    if len(lines) > _MAX_SHOWN:
        inform(f"  and {len(lines) - _MAX_SHOWN} more")
