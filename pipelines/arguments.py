"""Types of command-line arguments whose limits are checked before a command runs."""

from typing import Annotated, Any

from cyclopts import Parameter


def _at_least(limit: float) -> Parameter:
    """Return the check that a number is not below a limit."""

    def check(_: Any, value: float | None) -> None:
        if value is not None and not value >= limit:
            raise ValueError(f"Must be at least {limit:g}, got {value:g}.")

    return Parameter(validator=check)


type Count = Annotated[int, _at_least(1)]
type Positive = Annotated[float, _at_least(1e-9)]
type NotNegative = Annotated[float, _at_least(0)]
