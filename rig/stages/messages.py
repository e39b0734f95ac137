"""The messages that GRBL and Marlin have in common."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Ok:
    """The controller has accepted a command; its motion may still be under way."""


@dataclass(frozen=True, slots=True)
class Unknown:
    """A line of no known form, such as a damaged one."""

    text: str
