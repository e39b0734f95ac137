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

    The group of the failures below, each of which has its remedy.

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
    """The controller has stopped and reported why.

    Read the number of the alarm: ALARM:1 is a switch or interference; 8 and 9 are homing: check wiring, `$23`, `$27`,
    no Z axis; 10 is the emergency stop of grblHAL: release it. Then `faintfield stage home`.
    """


class StageTimeout(StageError):
    """A wait has timed out: no answer, or a motion that does not end.

    Check cable, power, `baud`, `protocol`, whether something is in the way, and whether Marlin waits for its button.
    """


class StageLost(StageError):
    """The connection is lost, or the controller has restarted.

    The port is gone for longer than `reconnect_s`. Check USB cable, hub, supply, and other programs on the port; home
    again.
    """


class StageRejected(StageError):
    """The controller refused a command, and nothing moved.

    The message says which command and why.
    """

    position_kept = True


class StageUnfit(StageError):
    """The stage obeys, but not well enough for a capture.

    `faintfield stage test` found a fault: correct what its table shows; for lost steps lower `$120` and `$121`.
    """

    position_kept = True


class PositionLost(StageError):
    """The stage is not at its target.

    Reported position and target differ. Look for an obstacle or a pulling cable; home.
    """


class PositionDrifted(PositionLost):
    """Homing again showed lost steps: positions since the last passed check are suspect.

    Lower the acceleration, look for friction; let the capture take the doubtful frames again.
    """


class DriftUnknown(StageError):
    """Homing could not be timed, as answers were delayed: nothing is known about lost steps.

    Nothing is known to be wrong with the stage. Let nothing else run on this computer; let the capture take the frames
    again.
    """

    position_kept = True


class PlanRefused(RigError):
    """A request is refused before anything moves.

    rig.toml has impossible values, or differs from that of the session: the message names key and values. A session
    that has begun keeps its plan; `faintfield check rig.toml --session SESSION` lists what may change
    (docs/how-to/run_a_capture.md).
    """


class OutsideTravel(PlanRefused):
    """A position, or the path to it, leaves the travel of the stage.

    Nothing moved. Correct `origin_mm`, `pitch_mm` or `[stage.travel_mm]`.

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
    """A position, or the path to it, enters a keep-out box.

    Nothing moved. Correct `origin_mm`, `pitch_mm` or the keep-out boxes.
    """


class NotHomed(PlanRefused):
    """The stage has not been homed since its position was lost.

    Use `--home`, or answer yes to homing.
    """


class WrongFirmware(PlanRefused):
    """The firmware, or one of its settings, cannot be used safely.

    Set the `$…` that the message names.
    """


class UnknownPlugin(PlanRefused):
    """No driver of this name is built in or installed, or it does not have these settings.

    Choose a `backend` or `protocol` that the message lists, or install its package (docs/tutorials/camera_driver.md).
    """


class PluginFailed(PlanRefused):
    """A driver that another package brings cannot be imported or used.

    The message gives the driver's own failure; install what it needs.
    """


class CameraError(RigError):
    """The camera did not take the requested frame.

    The camera refused, or its file is no image. Check M mode, raw, card, battery; close the vendor's program and the
    desktop's photo importer.

    A message that names two times: the file in the watched folder was begun before the frame was asked for, when the
    stage perhaps moved. Start no exposure by hand; state the shutter's true time (a nominal 13 s lasts 12.7 s).

    Came without a request: the program that saves into the watched folder takes frames by itself, or was triggered
    before the capture was "exposing". Set it to take one frame each time it is triggered; or state `delay_s`
    (docs/how-to/run_a_capture.md).

    A message that names two sizes: the camera's region, binning, image size or bit depth was changed. Set it as it was;
    to go on with the new one, begin a new session. If the only frame so far is the odd one, take this one again: the
    first is then taken again, too.

    The folder is gone: a disk or a network folder is not mounted any more. Mount it, answer `again`.

    A message that names a setting: the camera does not offer this name or value. Choose one of those that the message
    lists.
    """


class CameraTimeout(CameraError):
    """The camera did not answer, or no file arrived, in time.

    Set the camera's auto-off to never; raise `answer_s`, `arrival_s`.

    A message that names a temperature: the sensor did not reach `settle_temperature_c`. Switch the cooler on, compare
    its set point; raise `settle_limit_s`.
    """


class MissingExtra(CameraError):
    """The package for this kind of camera or stage is not installed.

    The message gives the `pip install` command.
    """


class LightError(RigError):
    """A light was not switched, or is not in the state that it was switched to.

    A light reports another state than the step wants: something else switches it, or a relay is stuck. Look for its
    switch, its cable; `faintfield check rig.toml` tries it.

    A mean above or below a frame without light: a lamp has burnt out, the lens is covered, or another light is on. Look
    at the lamps; `set_aside/` has the frame.
    """


class SessionError(RigError):
    """The folder of the session cannot be used.

    The group of the failures below, each of which has its remedy.
    """


class SessionCorrupt(SessionError):
    """Plan, journal and frames disagree, and nothing shows which is right.

    Edit nothing; restore from a copy; `faintfield verify` lists the files. An interrupted exposure is no damage: run
    `capture` again.

    A message that names journal.sqlite-wal: version 0.2.0 sealed the session while another program read its journal.
    Use `faintfield verify SESSION --repair` (docs/how-to/check_a_session.md).
    """


class SessionBusy(SessionError):
    """Another capture uses the session.

    Stop the other one.
    """


class SessionUnreadable(SessionError):
    """A file or folder of the session exists and cannot be read; nothing is known to be wrong with it.

    Allow it to be read, check the disk; for an interrupted session on a write-protected medium, copy it first.
    """


class SessionUnwritable(SessionError):
    """A frame or a journal entry could not be written; what was committed before is safe.

    The disk is full or read-only. Make room; the same command resumes.

    Cannot be sealed: all frames are there, but another program has the journal open. Close it in the program that the
    message names; the same command seals the session.
    """


class CaptureStopped(RigError):
    """The operator has stopped the capture; running it again resumes it.

    Run the same command to resume.
    """


def in_one_line(failure: BaseException) -> str:
    """Return the message of `failure` without line breaks, or its type if it has none."""
    return " ".join(str(failure).split()) or type(failure).__name__
