"""Explains every alarm, error and state of GRBL: what it means, whether the position is kept, and what to do."""

from faintfield.rig.errors import StageAlarm, StageRejected
from faintfield.rig.stages.grbl.messages import Report

SOFT_LIMIT_ALARM = 2
"""The only alarm that keeps the position."""

LOCKED_ERROR = 9
"""The error of a command that the present state does not allow."""

# ALARM:N → meaning
_ALARMS = {
    1: "a limit switch was hit; the position is lost",
    2: "a target was outside the soft limits; the position is kept",
    3: "reset while moving; the position is lost",
    4: "probe was already closed",
    5: "probe found nothing",
    6: "homing failed: reset during homing",
    7: "homing failed: safety door opened",
    8: "homing failed: a switch did not open on pulling off",
    9: "homing failed: no switch was found",
    10: "homing failed: the second motor's switch was not found",
}

# error:N → meaning, remedy
_ERRORS = {
    2: ("bad number format", "check the serial line"),
    3: ("unknown $ command", "flash GRBL 1.1 or grblHAL"),
    5: ("homing is not enabled", "set $22=1"),
    8: ("only allowed when idle", "wait until the stage stands, then try again"),
    9: ("locked by an alarm or a jog in progress", "recover and home it"),
    11: ("line too long", "check the serial line"),
    15: ("jog target outside the travel", "choose one inside, or correct $130 and $131"),
    16: ("bad jog command", "check the serial line"),
    20: ("unsupported command", "flash GRBL 1.1 or grblHAL"),
    22: ("no feed rate", "set stage.feed_mm_per_min"),
}

# State of a report → meaning, remedy, whether the position is kept
_STATES = {
    "Hold": ("is on hold", "release what holds it, then recover", True),
    "Door": ("has stopped because its safety door is open", "close the door, then recover", True),
    "Jog": ("is moving without a command", "wait until it stands", True),
    "Run": ("is moving without a command", "wait until it stands", True),
    "Check": ("is in check mode, where nothing moves", "recover, which leaves it", True),
    "Home": ("is homing without a command", "wait until it stands, then home it", False),
    "Sleep": ("is asleep with its motors off", "recover and home it", False),
    "Tool": ("waits for a tool change", "recover and home it", False),
}


def alarm_failure(code: int) -> StageAlarm:
    """Return the exception for an alarm."""
    kept = code == SOFT_LIMIT_ALARM
    meaning = _ALARMS.get(code, "see the firmware's list of alarms")
    remedy = "recover it" if kept else "look for the cause, then recover and home it"
    return StageAlarm(f"ALARM:{code}: {meaning}; {remedy}", code=code, position_kept=kept)


def error_failure(command: str, code: int) -> StageRejected:
    """Return the exception for an error in answer to `command`."""
    meaning, remedy = _ERRORS.get(code, ("unknown here", "look it up in the firmware's list of errors"))
    return StageRejected(f"the controller refused {command!r}: error:{code}, {meaning}; nothing moved by it; {remedy}")


def state_failure(report: Report, alarm: int | None) -> StageAlarm:
    """Return the exception for a state in which the stage cannot be used.

    Parameters
    ----------
    report : Report
        The report with that state.
    alarm : int or None
        Code of the last alarm.
    """
    if report.state != "Alarm":
        meaning, remedy, kept = _STATES[report.state]
        return StageAlarm(f"the controller {meaning}; {remedy}", position_kept=kept)
    if alarm is not None:
        return alarm_failure(alarm)
    return StageAlarm("the controller is locked: it has restarted or was never homed; home the stage")
