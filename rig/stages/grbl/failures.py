"""What GRBL's errors, alarms and states mean, and what the operator should do."""

from faintfield.rig.errors import StageAlarm, StageRejected
from faintfield.rig.stages.grbl.messages import Report

LOCKED = 9
"""The error of a command that the present state does not allow."""

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

_STATES = {
    "Hold": ("is on hold", "release what holds it, then recover", True),
    "Door": ("stands with its safety door open", "close the door, then recover", True),
    "Jog": ("is moving although nothing was asked of it", "wait until it stands", True),
    "Run": ("is moving although nothing was asked of it", "wait until it stands", True),
    "Check": ("is in check mode, where nothing moves", "recover, which leaves it", True),
    "Home": ("is homing although nothing was asked of it", "wait until it stands, then home it", False),
    "Sleep": ("is asleep with its motors off", "recover and home it", False),
    "Tool": ("waits for a tool change", "recover and home it", False),
}


def refusal(command: str, code: int) -> StageRejected:
    """Return the failure that stands for an error in answer to `command`."""
    meaning, remedy = _ERRORS.get(code, ("unknown here", "look it up in the firmware's list of errors"))
    return StageRejected(f"the controller refused {command!r}: error:{code}, {meaning}; nothing moved by it; {remedy}")


def alarm_failure(code: int) -> StageAlarm:
    """Return the failure that stands for an alarm; only alarm 2 keeps the position."""
    meaning = _ALARMS.get(code, "see the firmware's list of alarms")
    remedy = "recover it" if code == 2 else "look for the cause, then recover and home it"
    return StageAlarm(f"ALARM:{code}: {meaning}; {remedy}", code=code, position_kept=code == 2)


def state_failure(report: Report, alarm: int | None) -> StageAlarm:
    """Return the failure that stands for a state in which nothing can be done.

    Parameters
    ----------
    report : Report
        Tells the state.
    alarm : int or None
        The last alarm that was seen.
    """
    if report.state != "Alarm":
        what, remedy, kept = _STATES[report.state]
        return StageAlarm(f"the controller {what}; {remedy}", position_kept=kept)
    if alarm is not None:
        return alarm_failure(alarm)
    return StageAlarm("the controller is locked: it has restarted or was never homed; home the stage")
