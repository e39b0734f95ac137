"""`faintfield verify`: compare every frame of a session with its hash, and the journal with the plan."""

from pathlib import Path
from typing import Any

import msgspec

from faintfield.pipelines.console import inform, progress
from faintfield.rig.errors import SessionCorrupt
from faintfield.rig.session.verify import verify as verify_session

# Problems printed one by one; the failure gives their number.
_MAX_SHOWN = 10


def verify(session: Path, /) -> dict[str, Any]:
    """Verify a session without changing a byte of it.

    Parameters
    ----------
    session
        Its folder.
    """
    verdict = verify_session(session, lambda paths: progress(list(paths), "hashing"))
    for problem in verdict.problems[:_MAX_SHOWN]:
        inform(f"problem: {problem}")
    if verdict.problems:
        raise SessionCorrupt(
            f"{session}: {len(verdict.problems)} problems, the first: {verdict.problems[0]}; "
            f"restore files from a copy, or run capture again if the session is not complete"
        )
    state = "complete" if verdict.sealed else f"{len(verdict.missing)} still to be taken"
    inform(f"{session}: {verdict.present} of {verdict.planned} frames present and whole, {state}")
    for count, what in (
        (len(verdict.left_out), "left out by the operator"),
        (verdict.superseded, "taken again; the earlier files are kept"),
        (len(verdict.suspect), "kept although the stage lost its scale after them"),
    ):
        if count:
            inform(f"  {count} {what}")
    return {"session": str(session), **msgspec.to_builtins(verdict)}
