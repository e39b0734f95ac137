"""After an error: back to work, and to the switches only if that is agreed to."""

from collections.abc import Callable

from rig.errors import NotHomed
from rig.stages.protocol import Stage


def recover(stage: Stage, may_home: Callable[[str], bool]) -> bool:
    """Make the stage usable again after a `StageError`.

    Parameters
    ----------
    stage : Stage
        The stage that failed.
    may_home : callable
        Asked, with the question in words, before the stage moves to its switches: a prompt to the operator, or an
        answer given in advance (`lambda question: True`).

    Returns
    -------
    bool
        Whether it was homed, so that what had been visited can no longer be checked for drift.

    Raises
    ------
    StageError
        It cannot be recovered; the message says what the operator should do.
    NotHomed
        Homing was declined, and positions are not known.
    """
    stage.recover()
    if stage.trusted:
        return False
    if not may_home("The stage's position is lost. Home it now? It will move to its switches."):
        raise NotHomed("homing was declined and the stage's position is not known; home it before going on")
    stage.home()
    return True
