"""The exceptions of the rig, in one tree: catch `RigError` to catch them all.

A `StageError` concerns the stage, a `CameraError` the camera, a `LightError` a light that the rig switches, and a
`SessionError` the files of a capture; a
`PlanRefused` is raised before anything moves, and `CaptureStopped` when the operator stops a capture. Every message is
one line that says what is wrong, the value found, its limit, and what to do.
"""


class RigError(Exception):
    """The stage, the camera or the session on disk does not work as it must.

    All failures of the rig are of this class. Each message says what is wrong, the value and its limit, and after a
    semicolon what to do.

    Examples
    --------
    A stage that was not homed is not moved:

    >>> from faintfield import RigError, StageSettings, open_stage
    >>> stage = open_stage(StageSettings("grbl", port="simulated:grbl"))
    >>> stage.connect()
    >>> try:
    ...     stage.move_to(-100.0, -50.0)
    ... except RigError as failure:
    ...     print(failure)
    the stage's position is not known, so it is not sent to (-100.000, -50.000) mm; home it first
    >>> stage.close()
    """


class StageError(RigError):
    """The stage did not obey a command.

    Attributes
    ----------
    position_kept : bool
        Whether the controller still knows the position of the stage; if not, the stage must be homed.
    suspect : tuple
        Frames that a check for drift puts in doubt: those since the last passed check, in order.
    """

    position_kept = False

    def __init__(self, message: str, *, position_kept: bool | None = None, suspect: tuple[object, ...] = ()) -> None:
        super().__init__(message)
        self.suspect = suspect
        if position_kept is not None:
            self.position_kept = position_kept


class StageAlarm(StageError):
    """The controller has stopped and reported why."""


class StageTimeout(StageError):
    """A wait has timed out: no answer, or a motion that does not end."""


class StageLost(StageError):
    """The connection is lost, or the controller has restarted."""


class StageRejected(StageError):
    """The controller refused a command, and nothing moved."""

    position_kept = True


class StageUnfit(StageError):
    """The stage obeys, but not well enough for a capture."""

    position_kept = True


class PositionLost(StageError):
    """The stage is not at its target."""


class PositionDrifted(PositionLost):
    """Homing again showed lost steps: positions since the last passed check are suspect."""


class DriftUnknown(StageError):
    """Homing could not be timed, as answers were delayed: nothing is known about lost steps."""

    position_kept = True


class PlanRefused(RigError):
    """A request is refused before anything moves."""


class OutsideTravel(PlanRefused):
    """A position, or the path to it, leaves the travel of the stage; nothing has moved.

    Examples
    --------
    >>> from faintfield import OutsideTravel, StageSettings, open_stage
    >>> stage = open_stage(StageSettings("grbl", port="simulated:grbl"))
    >>> stage.connect()
    >>> _ = stage.home()
    >>> try:
    ...     stage.move_to(100.0, 0.0)
    ... except OutsideTravel as failure:
    ...     print(failure)
    position (100.000, 0.000) mm is outside the travel [-400, 0] x [-400, 0] mm; choose one inside, or move the grid
    >>> stage.close()
    """


class KeepOutCrossed(PlanRefused):
    """A position, or the path to it, enters a keep-out box."""


class NotHomed(PlanRefused):
    """The stage has not been homed since its position was lost."""


class WrongFirmware(PlanRefused):
    """The firmware, or one of its settings, cannot be used safely."""


class UnknownPlugin(PlanRefused):
    """No driver of this name is built in or installed, or it does not have these settings."""


class PluginFailed(PlanRefused):
    """A driver that another package brings cannot be imported or used."""


class CameraError(RigError):
    """The camera did not take the requested frame."""


class CameraTimeout(CameraError):
    """The camera did not answer, or no file arrived, in time."""


class MissingExtra(CameraError):
    """The package for this kind of camera or stage is not installed."""


class LightError(RigError):
    """A light was not switched, or is not in the state that it was switched to."""


class SessionError(RigError):
    """The folder of the session cannot be used."""


class SessionCorrupt(SessionError):
    """Plan, journal and frames disagree, and nothing shows which is right."""


class SessionBusy(SessionError):
    """Another capture uses the session."""


class SessionUnreadable(SessionError):
    """A file or folder of the session exists and cannot be read; nothing is known to be wrong with it."""


class SessionUnwritable(SessionError):
    """A frame or a journal entry could not be written; what was committed before is safe."""


class CaptureStopped(RigError):
    """The operator has stopped the capture; running it again resumes it."""


def in_one_line(failure: BaseException) -> str:
    """Return the message of `failure` without line breaks, or its type if it has none."""
    return " ".join(str(failure).split()) or type(failure).__name__
