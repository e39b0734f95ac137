"""`faintfield capture`: capture a session with guidance, or resume one."""

import sys
from pathlib import Path
from typing import Any

from faintfield.pipelines.console import console
from faintfield.pipelines.errors import WrongUsage


def capture(rig: Path, session: Path, /, *, yes: bool = False, page: bool = False) -> dict[str, Any]:
    """Capture a session, step by step; run it again to go on where it stopped.

    Keys: p pause, r take the last frame again, s skip, q stop. Ctrl-C stops after the present frame, a second one at
    once.

    Parameters
    ----------
    rig
        The rig.toml.
    session
        Folder of the session.
    yes
        Answer every prompt with its usual answer: for scripts.
    page
        Also serve a local web page, on this computer alone.
    """
    from faintfield.pipelines.formats.rig_file import read_rig
    from faintfield.pipelines.live.guided import capture_session

    if not (yes or page or (console.is_terminal and sys.stdin.isatty())):
        raise WrongUsage("there is no terminal to answer prompts on; give --yes, or --page and answer there")
    taken = capture_session(read_rig(rig), session, unattended=yes, page=page)
    return {"session": str(session), "complete": True, "taken": taken}
