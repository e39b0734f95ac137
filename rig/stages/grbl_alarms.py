"""Explain alarms, errors and states of GRBL and grblHAL: meaning, remedy, and whether the position is kept."""

from faintfield.rig.errors import StageAlarm, StageRejected
from faintfield.rig.stages.grbl_lines import Report

# The only alarm that keeps the position; that of a grblHAL which has started and must be homed.
SOFT_LIMIT_ALARM, HOMING_REQUIRED_ALARM = 2, 11
# The alarms after which the controller obeys nothing but a reset; those above 2 are grblHAL's.
CRITICAL_ALARMS = (1, 2, 10, 17)
# The errors of a command that the present state does not allow; those above 9 are grblHAL's.
LOCKED_ERRORS = (9, 45, 46, 50, 51, 79)
_LOOK = "look for the cause, then recover and home it"

# ALARM:N → meaning, remedy; those from 10 on are grblHAL's, and GRBL has another 10. Probes and spindles have others.
ALARMS = {
    1: ("a limit switch was hit; the position is lost", _LOOK),
    2: ("a target was outside the soft limits; the position is kept", "recover it"),
    3: ("reset while moving; the position is lost", _LOOK),
    6: ("homing failed: reset during homing", _LOOK),
    7: ("homing failed: safety door opened", _LOOK),
    8: ("homing failed: a switch did not open on pulling off", _LOOK),
    9: ("homing failed: no switch was found", _LOOK),
    10: (
        "the emergency stop is pressed (or GRBL found no switch of the second motor when homing)",
        "release the emergency stop, then recover and home it",
    ),
    11: ("homing is required", "home it"),
    12: ("a limit switch is closed", "move the carriage off its switch by hand, then recover and home it"),
    15: ("homing failed: the second motor's switch was not found", _LOOK),
    16: ("the controller failed its test of itself", "switch the controller off and on, then recover and home it"),
    17: (
        "a motor driver reports a fault",
        "switch the controller off, look at motors and drivers, then recover and home it",
    ),
    18: ("homing failed: it is not set up", "correct $22 and $44 to $46, then recover and home it"),
}

_DAMAGED = "the command was damaged on its way: try again, with a shorter or shielded cable"

# error:N → meaning, remedy
ERRORS = {
    1: ("a letter was expected", _DAMAGED),
    2: ("bad number format", _DAMAGED),
    3: ("unknown $ command", "flash GRBL 1.1 or grblHAL"),
    5: ("homing is not enabled", "set $22=1"),
    8: ("only allowed when idle", "wait until the stage stands, then try again"),
    9: ("locked by an alarm or a jog in progress", "recover and home it"),
    11: ("line too long", _DAMAGED),
    13: ("the safety door is open", "close it, then recover"),
    15: ("jog target outside the travel", "choose one inside, or correct $130 and $131"),
    16: ("bad jog command", _DAMAGED),
    20: ("unsupported command", "flash GRBL 1.1 or grblHAL"),
    21: ("two commands of one group", _DAMAGED),
    22: ("no feed rate", "set stage.feed_mm_per_min"),
    23: ("a whole number was expected", _DAMAGED),
    24: ("two commands that take axes", _DAMAGED),
    25: ("a word appears twice", _DAMAGED),
    26: ("no axis is named", _DAMAGED),
    31: ("an axis is named that is not used", _DAMAGED),
    33: ("the target is invalid", _DAMAGED),
    36: ("a value is not used by the command", _DAMAGED),
    45: ("a limit switch is closed, which allows nothing but homing", "recover and home it"),
    46: ("homing is required", "home it"),
    50: ("the emergency stop is pressed", "release it, then recover and home it"),
    51: ("a motor driver reports a fault", "look at motors and drivers, then recover and home it"),
    53: ("the setting does not exist here", "flash GRBL 1.1 or grblHAL"),
    55: ("homing is not set up", "correct $22 and $44 to $46"),
    77: ("a password is needed", "switch off authentication in the controller"),
    79: ("not allowed before the alarm is cleared", "recover and home it"),
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
    meaning, remedy = ALARMS.get(code, ("see the firmware's list of alarms", _LOOK))
    return StageAlarm(f"ALARM:{code}: {meaning}; {remedy}", position_kept=code == SOFT_LIMIT_ALARM)


def error_failure(command: str, code: int) -> StageRejected:
    """Return the exception for an error in answer to `command`."""
    meaning, remedy = ERRORS.get(code, ("unknown here", "look it up in the firmware's list of errors"))
    return StageRejected(f"the controller refused {command!r}: error:{code}, {meaning}; nothing moved by it; {remedy}")


def door_failure() -> StageAlarm:
    """Return the exception for a jog that a door has frozen."""
    return StageAlarm("the safety door was opened, and the jog is frozen; close the door, then recover and home it")


def state_failure(report: Report, alarm: int | None) -> StageAlarm:
    """Return the exception for a state in which the stage cannot be used.

    `alarm` is the code of the last alarm, for controllers that do not report it with their state.
    """
    if report.state != "Alarm":
        meaning, remedy, kept = _STATES[report.state]
        return StageAlarm(f"the controller {meaning}; {remedy}", position_kept=kept)
    alarm = 10 if report.emergency_stop else report.substate or alarm
    if alarm is not None:
        return alarm_failure(alarm)
    return StageAlarm("the controller is locked: it has restarted or was never homed; home the stage")
