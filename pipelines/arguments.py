"""Types of command-line arguments, with limits that are checked before a command runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

# No quantity is larger, and computing with numbers up to it does not overflow.
_MAX_NUMBER = 1e9


def _within(minimum: float, maximum: float = _MAX_NUMBER) -> Parameter:
    """Return a parameter whose number, or each number of a tuple, must lie within limits."""

    def check(_: Any, value: float | str | tuple[float, ...] | None) -> None:
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int | float) and not minimum <= number <= maximum:
                limits = f"at least {minimum:g}" if number < minimum else f"a number of at most {maximum:g}"
                raise ValueError(f"Must be {limits}, got {number:g}.")

    return Parameter(validator=check)


type Count = Annotated[int, _within(1)]
type Seed = Annotated[int, _within(0)]
type Positive = Annotated[float, _within(1e-9)]
type NotNegative = Annotated[float, _within(0)]
type NotNegativeOrAuto = Annotated[float | Literal["auto"], _within(0)]
type Fraction = Annotated[float, _within(1e-9, 1)]
type SizePx = Annotated[tuple[int, int], _within(2)]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Options of the imports of images whose poses another program found.

    Parameters
    ----------
    images
        Folder of the images; by default that of the poses.
    mm_per_unit
        Length of the unit of the positions, which COLMAP and nerfstudio cannot know: measure something, or depths are
        relative. By default that which a table states, and 1000 for mrcal, whose unit is the metre.
    reference
        Name of the image whose camera is the reference; the one nearest to the middle by default.
    exposure_s
        Exposure of each image; by default that of EXIF; not known where there is none.
    linear
        Values of 8-bit images are proportional to light; without it the tone curve of sRGB is undone.
    srgb
        16-bit images have the tone curve of sRGB, too, which is undone.
    overwrite
        Replace an earlier set in OUT.
    """

    images: Path | None = None
    mm_per_unit: Positive | None = None
    reference: str | None = None
    exposure_s: Positive | None = None
    linear: bool = False
    srgb: bool = False
    overwrite: bool = False
