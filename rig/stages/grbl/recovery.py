"""Brings GRBL to rest, with nothing left that could go on: no jog, no motion on hold, no alarm that silences it."""

from faintfield.rig.clock import Clock
from faintfield.rig.errors import StageTimeout
from faintfield.rig.stages.grbl.connection import CANCEL_JOG, HOLD, POLL_INTERVAL_S, RESET, RESET_S, GrblConnection
from faintfield.rig.stages.grbl.failures import CRITICAL_ALARMS, state_failure
from faintfield.rig.stages.grbl.messages import Report

# Reports in a row that show the same position before a motion that was told to stop counts as stuck.
_UNCHANGED_REPORTS = 2


def bring_to_rest(grbl: GrblConnection, clock: Clock, within_s: float) -> Report:
    """Stop what moves, end what is on hold, and return a report of the state `Idle` or `Alarm`.

    A soft reset at rest keeps the position, and forgets the rest of a motion that was on hold. A motion that is told to
    stop and neither moves nor ends (a jog of grblHAL after its door was opened) is reset as well, which loses the
    position.

    Raises
    ------
    StageAlarm
        An open door or an emergency stop prevents it; nothing is left that could go on.
    StageTimeout
        The controller is not at rest within `within_s`; it was reset.
    """
    deadline_s = clock.now_s() + within_s
    last: Report | None = None
    unchanged, was_reset = 0, False
    while clock.now_s() + POLL_INTERVAL_S + RESET_S < deadline_s:
        report = grbl.poll_despite_failures()
        unchanged = unchanged + 1 if _is_same(report, last) else 0
        last = report
        if report is not None:
            if report.state == "Idle":
                return report
            if report.state == "Alarm" and _is_settled(grbl, report, was_reset=was_reset):
                return report
            if _is_moving(report) and unchanged < _UNCHANGED_REPORTS:
                grbl.send({"Jog": CANCEL_JOG, "Run": HOLD}.get(report.state, b""))
                continue
            if report.state == "Door" and was_reset:
                raise state_failure(report, grbl.alarm)
            grbl.count_lost = grbl.count_lost or _is_moving(report)
        # After critical alarms GRBL answers nothing but a reset, and ignores one that comes too early.
        grbl.reset()
        was_reset, unchanged = True, 0
    grbl.count_lost = True
    grbl.send(RESET)
    raise StageTimeout(
        f"the controller is not ready {within_s:g} s after it was told to stop, and was reset; "
        "switch it off and on, then home it"
    )


def _is_same(report: Report | None, last: Report | None) -> bool:
    if report is None or last is None:
        return False
    return (report.state, report.position) == (last.state, last.position)


def _is_moving(report: Report) -> bool:
    return report.state in ("Jog", "Run") or (report.state, report.substate) in (("Hold", 1), ("Door", 2), ("Door", 3))


def _is_settled(grbl: GrblConnection, report: Report, *, was_reset: bool) -> bool:
    """Return whether a state of alarm needs no reset; raises if the emergency stop prevents one."""
    if report.emergency_stop:
        raise state_failure(report, grbl.alarm)
    return was_reset or (report.substate or grbl.alarm) not in CRITICAL_ALARMS
