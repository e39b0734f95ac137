"""The failures of the rig, one tree: catch `RigError` to catch them all.

RigError
├── StageError
│   ├── StageAlarm
│   ├── StageTimeout
│   ├── StageLost
│   ├── StageRejected
│   ├── StageUnfit
│   └── PositionLost
│       └── PositionDrifted
├── PlanRefused
│   ├── OutsideTravel
│   ├── KeepOutCrossed
│   ├── NotHomed
│   └── WrongFirmware
├── CameraError
│   ├── CameraTimeout
│   └── MissingExtra
├── SessionError
│   ├── SessionCorrupt
│   ├── SessionBusy
│   └── SessionUnwritable
└── CaptureStopped

A `StageError` happened to the stage, a `CameraError` to the camera; a `PlanRefused` was found before anything moved. A
`SessionError` is about the files of a capture, and `CaptureStopped` ends one that the operator has stopped. Every
message says what is wrong, the value found, the limit it broke, and what to do, in one line.
"""


class RigError(Exception):
    """Something in the world (stage, camera, session on disk) is not as it must be."""


class StageError(RigError):
    """The stage did not do what it was told.

    Attributes
    ----------
    position_kept : bool
        Whether the controller still knows where the stage is. When it does not, only homing restores it.
    """

    position_kept = False


class StageAlarm(StageError):
    """The controller has stopped and says why.

    Attributes
    ----------
    code : int or None
        The controller's own number for the alarm, where it has one.
    """

    def __init__(self, message: str, *, code: int | None = None, position_kept: bool = False) -> None:
        super().__init__(message)
        self.code = code
        self.position_kept = position_kept


class StageTimeout(StageError):
    """A wait has reached its bound: no answer, or a motion that does not end."""


class StageLost(StageError):
    """The connection is gone, or the controller has restarted behind it."""


class StageRejected(StageError):
    """The controller refused a command; nothing moved."""

    position_kept = True


class StageUnfit(StageError):
    """The stage does what it is told, but not well enough for a capture."""

    position_kept = True


class PositionLost(StageError):
    """The stage is not where it was sent."""


class PositionDrifted(PositionLost):
    """Homing again found the stage off its scale: positions since the last good check are suspect.

    Attributes
    ----------
    suspect : tuple
        What was visited since the last good check, in order.
    """

    def __init__(self, message: str, *, suspect: tuple[object, ...] = ()) -> None:
        super().__init__(message)
        self.suspect = suspect


class PlanRefused(RigError):
    """What was asked for is refused before anything moves."""


class OutsideTravel(PlanRefused):
    """A position, or the way to it, leaves the travel of the stage."""


class KeepOutCrossed(PlanRefused):
    """A position, or the way to it, enters a keep-out box."""


class NotHomed(PlanRefused):
    """The stage has not been homed since its position was last in doubt."""


class WrongFirmware(PlanRefused):
    """The controller's firmware, or one of its settings, cannot be driven safely."""


class CameraError(RigError):
    """The camera did not take the frame that it was asked for."""


class CameraTimeout(CameraError):
    """The camera did not answer, or no file came, within the bound."""


class MissingExtra(CameraError):
    """The package that talks to this kind of camera is not installed."""


class SessionError(RigError):
    """The session's folder cannot be used."""


class SessionCorrupt(SessionError):
    """Plan, journal and frames do not agree, and it cannot be told from them which is right."""


class SessionBusy(SessionError):
    """Another capture has the session."""


class SessionUnwritable(SessionError):
    """A frame or an entry of the journal could not be written; what was committed before is safe."""


class CaptureStopped(RigError):
    """The operator has stopped the capture; running it again goes on."""
