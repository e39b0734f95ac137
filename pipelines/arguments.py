"""Types of command-line arguments whose limits are checked before a command runs."""

from typing import Annotated, Any, Literal

from cyclopts import Parameter

# Nothing that is measured here is larger, and numbers up to it overflow nowhere.
_MOST = 1e9


def _within(least: float, most: float = _MOST) -> Parameter:
    """Return the check that a number, or each of a tuple, lies within limits."""

    def check(_: Any, value: float | str | tuple[float, ...] | None) -> None:
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int | float) and not least <= number <= most:
                limits = f"at least {least:g}" if number < least else f"a number of at most {most:g}"
                raise ValueError(f"Must be {limits}, got {number:g}.")

    return Parameter(validator=check)


type Count = Annotated[int, _within(1)]
type Seed = Annotated[int, _within(0)]
type Positive = Annotated[float, _within(1e-9)]
type NotNegative = Annotated[float, _within(0)]
type NotNegativeOrAuto = Annotated[float | Literal["auto"], _within(0)]
type Fraction = Annotated[float, _within(1e-9, 1)]
type LensName = Literal["opencv5", "opencv8", "opencv4", "pinhole"]
type SizePx = Annotated[tuple[int, int], _within(2)]
