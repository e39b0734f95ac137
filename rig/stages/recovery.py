"""Recovers the stage after an error, and homes it only with permission."""

from collections.abc import Callable

from faintfield.rig.errors import NotHomed
from faintfield.rig.stages.drift import DriftWatch
from faintfield.rig.stages.gantry import Gantry


def recover(stage: Gantry, may_home: Callable[[str], bool], watch: DriftWatch | None = None) -> None:
    """Make the stage usable again after a `StageError`.

    Parameters
    ----------
    stage : Gantry
        The stage that failed.
    may_home : callable
        Called with a question before the stage moves to its switches; homing needs the answer True.
    watch : DriftWatch, optional
        Begins again if the stage is homed; positions not yet checked for drift become doubtful.

    Raises
    ------
    StageError
        The stage cannot be recovered; the message says what to do.
    NotHomed
        Homing was declined and the position is not known.
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
