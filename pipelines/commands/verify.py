"""`faintfield verify`: sessions against their journals, and results against their records and inputs."""

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
from faintfield.rig.errors import SessionCorrupt
from faintfield.rig.session.session import JOURNAL, has_session, taken_frames
from faintfield.rig.session.verify import Verdict
from faintfield.rig.session.verify import verify as verify_session

# Problems printed one by one; the failure gives their number.
_MAX_SHOWN = 10


class Verified(msgspec.Struct, frozen=True):
    """The result of `faintfield verify`: what was found of a session, and of results."""

    path: str
    session: Verdict | None
    results: ResultVerdict | None


def verify(path: Path, /, *, inputs: Path | None = None) -> Verified:
    """Verify a session or results without changing a byte of them.

    Of a session: its plan, its journal and the SHA-256 of every frame, then the results in its folder. Of results:
    every record against its own digest, the files that it vouches for, and the inputs that it was made from.

    Parameters
    ----------
    path
        A session, a folder of results, or one record such as noise.json, geometry.json or reconstruction.json.
    inputs
        Folder of the session or set that the results were made from; searched for around them by default.
    """
    if inputs is not None and not inputs.is_dir():
        raise MissingFile(f"{inputs}: no such folder; name that of the session or set")
    session, known = None, {}
    if has_session(path) or (path / JOURNAL).exists():
        session = _verify_session(path)
        known = {frame.resolve(): taken.sha256 for _, taken, frame in taken_frames(path)}  # found to be true just now
    records = records_below(path) if session else records_of(path)
    if not records:
        return Verified(str(path), session, None)
    results = verify_results(
        records,
        inputs_in(inputs) if inputs else inputs_around,
        lambda paths: progress(paths, "hashing"),
        lambda file: known.get(file) or sha256(file),
    )
    _report(path, results)
    return Verified(str(path), session, results)


def _verify_session(folder: Path) -> Verdict:
    """Verify a session, and inform the user."""
    verdict = verify_session(folder, lambda paths: progress(list(paths), "hashing"))
    _list("problem", verdict.problems)
    if verdict.problems:
        raise SessionCorrupt(
            f"{folder}: is damaged: {len(verdict.problems)} problems, the first: {verdict.problems[0]}; "
            f"restore these files from a copy"
        )
    state = "complete" if verdict.sealed else f"{len(verdict.missing)} still to be taken"
    inform(f"{folder}: {verdict.present} of {verdict.planned} frames present and whole, {state}")
    for count, what in (
        (len(verdict.left_out), "left out by the operator"),
        (verdict.superseded, "taken again; the earlier files are kept"),
        (len(verdict.suspect), "kept although the stage lost its scale after them"),
        (len(verdict.interrupted), "of an exposure that was interrupted, which is no damage; run capture again"),
    ):
        if count:
            inform(f"  {count} {what}")
    return verdict


def _report(path: Path, verdict: ResultVerdict) -> None:
    """Inform the user of what was found of results."""
    _list("not checked", verdict.unchecked)
    _list("problem", verdict.problems)
    if verdict.problems:
        raise ResultDamaged(
            f"{path}: {len(verdict.problems)} problems in its results, the first: {verdict.problems[0]}; "
            "restore these files from a copy, or make the results again by the command that made them"
        )
    inform(
        f"{path}: {verdict.records} records agree with their digests, with {verdict.files} files beside them, and with "
        f"{verdict.inputs} inputs"
    )


def _list(label: str, lines: tuple[str, ...]) -> None:
    """Print the first of several findings."""
    for line in lines[:_MAX_SHOWN]:
        inform(f"{label}: {line}")
    if len(lines) > _MAX_SHOWN:
        inform(f"  and {len(lines) - _MAX_SHOWN} more")
