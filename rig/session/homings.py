"""Homing groups: which frames of a session share one homing, and how well the switches repeat."""

from pathlib import Path
from statistics import stdev

from msgspec import Struct

from faintfield.rig.session.journal import CommittedFrame, Journal
from faintfield.rig.session.session import open_journal, read_plan

# Spread of homings that matters no more than that of a good drive.
NEGLIGIBLE_MM = 0.02

# Drift checks that tell the spread: switches of 0.05 mm pass for ones of 0.02 mm in 2 % of the cases.
MIN_CHECKS = 6


class Homed(Struct, frozen=True):
    """Detail of an event `homed`: a group, numbered from 1 on, begins with the exposure `first_intent`."""

    group: int
    first_intent: int


class DriftCheck(Struct, frozen=True):
    """Detail of an event `drift_check`: a check that passed; see `rig.stages.drift.Drift`."""

    away_mm: tuple[float, ...]


class HomingGroups(Struct, frozen=True):
    """The homing groups of a session; between groups, positions may differ by as much as the switches do.

    Each committed frame has a group, by the number of its exposure, or None in sessions that do not record homing.
    `spread_mm` is the standard deviation of where the switches close, per axis or one number if the axes home together,
    from so many drift checks that passed; it contains the jitter of their timing, and is None with fewer than two.
    """

    groups: dict[int, int | None]
    spread_mm: tuple[float, ...] | None
    checks: int

    def repeat(self) -> bool:
        """Return whether the switches are known to repeat so well that groups need not be told apart."""
        return self.spread_mm is not None and self.checks >= MIN_CHECKS and max(self.spread_mm) <= NEGLIGIBLE_MM


def begin_group(journal: Journal) -> None:
    """Record that the frames from here on belong to a new homing group."""
    earlier = journal.details("homed", Homed)
    group = earlier[-1].group + 1 if earlier else 1
    journal.event("homed", group=group, first_intent=journal.next_intent())


def unchecked_frames(journal: Journal) -> list[CommittedFrame]:
    """Return the frames of the newest group that count, if no drift check confirms them."""
    homed = journal.events("homed")
    if not homed or any(check.id > homed[-1].id for check in journal.events("drift_check")):
        return []
    first_intent = journal.details("homed", Homed)[-1].first_intent
    return [frame for frame in journal.committed() if frame.void is None and frame.intent >= first_intent]


def homing_groups(journal: Journal) -> HomingGroups:
    """Return the homing groups that a journal records."""
    homings = journal.details("homed", Homed)
    groups = {
        frame.intent: max((homed.group for homed in homings if homed.first_intent <= frame.intent), default=None)
        for frame in journal.committed()
    }
    away_mm = [check.away_mm for check in journal.details("drift_check", DriftCheck)]
    comparable = len(away_mm) > 1 and len(set(map(len, away_mm))) == 1
    spread_mm = tuple(stdev(axis) for axis in zip(*away_mm, strict=True)) if comparable else None
    return HomingGroups(groups, spread_mm, len(away_mm))


def read_homing_groups(folder: Path) -> HomingGroups:
    """Return the homing groups of the session in `folder`; raises as `read_plan` and `Journal` do."""
    with open_journal(folder, read_plan(folder), read_only=True) as journal:
        return homing_groups(journal)
