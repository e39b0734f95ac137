"""The messages that GRBL and Marlin have in common, and the failure of a restart."""

from dataclasses import dataclass

from faintfield.rig.errors import StageLost


@dataclass(frozen=True, slots=True)
class Ok:
    """The controller has accepted a command; its motion may still be under way."""


@dataclass(frozen=True, slots=True)
class Unknown:
    """A line of no known form, such as a damaged one."""

    text: str


def restart_failure() -> StageLost:
    """Return the exception for a controller that has reported a restart."""
    return StageLost("the controller has restarted, and its position is lost; check its power, then home it")
