"""After an error: back to work, and to the switches only if that is agreed to."""

from collections.abc import Callable

from faintfield.rig.errors import NotHomed
from faintfield.rig.stages.drift import DriftWatch
from faintfield.rig.stages.protocol import Stage


def recover(stage: Stage, may_home: Callable[[str], bool], watch: DriftWatch | None = None) -> None:
    """Make the stage usable again after a `StageError`.

    Parameters
    ----------
    stage : Stage
        The stage that failed.
    may_home : callable
        Asked, with the question in words, before the stage moves to its switches: a prompt to the operator, or an
        answer given in advance (`lambda question: True`).
    watch : DriftWatch, optional
        Begins anew if the stage is homed; what was not yet checked for drift becomes doubtful.

    Raises
    ------
    StageError
        It cannot be recovered; the message says what the operator should do.
    NotHomed
        Homing was declined, and positions are not known.
    """
    stage.recover()
    if stage.trusted:
        return
    if not may_home("The stage's position is lost. Home it now? It will move to its switches."):
        raise NotHomed("homing was declined and the stage's position is not known; home it before going on")
    if watch is None:
        stage.home()
    else:
        watch.begin()
