"""The types of a camera that drivers, capture and simulators share."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from msgspec import Struct
from numpy.typing import NDArray

from faintfield.rig.clock import result_within
from faintfield.rig.errors import CameraError, CameraTimeout, in_one_line

type Pixels = NDArray[Any]
type Metadata = Mapping[str, str | int | float | Sequence[float] | None]

# Reads the pixels of a frame's file: None if files of this kind cannot be decoded here; raises `CameraError` if it is
# of a kind that can, and is truncated or damaged.
type Decode = Callable[[Path], Pixels | None]


class CameraReport(Struct, frozen=True):
    """Identity and properties that a camera reports.

    Parameters
    ----------
    name : str
        Maker, model and serial number, as far as the camera reports them.
    frame_bytes : int
        Size of one frame on disk, or an upper estimate.
    exposures_s : tuple of float, optional
        Available exposure times; None if any can be set.
    exposure_range_s : (float, float), optional
        Shortest and longest exposure time; None if there are no limits.
    readout_s : float
        Time per frame in addition to the exposure; an estimate until it is measured.
    settings : dict
        The camera's settings, for the record.
    """

    name: str
    frame_bytes: int
    exposures_s: tuple[float, ...] | None = None
    readout_s: float = 0.0
    settings: dict[str, str] = {}
    exposure_range_s: tuple[float, float] | None = None

    def offers(self, exposure_s: float) -> bool:
        """Return whether this exposure time can be set, to within 1 %."""
        if self.exposure_range_s is not None:
            shortest_s, longest_s = self.exposure_range_s
            if not 0.99 * shortest_s <= exposure_s <= 1.01 * longest_s:
                return False
        return self.exposures_s is None or any(
            abs(exposure_s - offered) <= 0.01 * offered for offered in self.exposures_s
        )


@dataclass(frozen=True)
class Exposure:
    """One frame as the camera delivers it: the bytes of a file, or an array to be written as TIFF.

    Parameters
    ----------
    suffix : str
        Suffix of the file, such as `.nef` or `.tiff`.
    content : bytes, optional
        The file, byte for byte.
    pixels : array, optional
        Values (row, column) or (row, column, colour), if there is no file.
    metadata : mapping
        What the camera reports about this frame; `temperature_c` is that of the sensor.
    """

    suffix: str
    content: bytes | None = None
    pixels: Pixels | None = None
    metadata: Metadata = field(default_factory=dict)

    def __post_init__(self) -> None:
        if (self.content is None) == (self.pixels is None):
            raise ValueError("an exposure is either a file's bytes or an array; give one of them")


class Camera(Protocol):
    """A source of frames. Every method is bounded in time and raises a `CameraError` if it fails."""

    def open(self) -> None:
        """Connect to the camera, without exposing."""

    def report(self) -> CameraReport:
        """Return the camera's name, limits and settings."""

    def expose(self, exposure_s: float, number: int) -> Exposure:
        """Take one frame; `number` counts the exposures of a session, also those that were not kept."""

    def close(self) -> None:
        """Disconnect; closing twice does no harm."""


@runtime_checkable
class Thermometer(Protocol):
    """A camera that can report the temperature of its sensor, without exposing."""

    def temperature_c(self) -> float | None:
        """Return the temperature in °C, None if this camera has no sensor for it."""


@runtime_checkable
class UntriggeredCamera(Protocol):
    """A camera that a person or a program triggers, and that has to be at rest before a frame is asked for."""

    def await_silence(self, exposure_s: float) -> None:
        """Wait until no exposure is under way that could be taken for the next frame; raises `CameraError`."""


def call_within[T](
    bound_s: float,
    call: Callable[[], T],
    what: str,
    failures: type[Exception] | tuple[type[Exception], ...] = (),
    remedy: str = "",
) -> T:
    """Return the result of `call`, or raise `CameraTimeout` if there is none within `bound_s`; see `result_within`.

    The `failures` of its library become `CameraError`s with a `remedy`; messages say `what` the call does.
    """
    try:
        return result_within(bound_s, call, "camera")
    except TimeoutError as failure:
        problem = f"the camera did not finish {what} in {bound_s:g} s"
        raise CameraTimeout(f"{problem}; check cable and battery, switch it off and on") from failure
    except failures as failure:
        raise CameraError(f"the camera failed at {what}: {in_one_line(failure)}; {remedy}") from failure
