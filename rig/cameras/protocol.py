"""Defines a camera: the types that drivers, capture and simulators share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from msgspec import Struct
from numpy.typing import NDArray

type Pixels = NDArray[Any]
type Metadata = Mapping[str, str | int | float | Sequence[float] | None]


class CameraReport(Struct, frozen=True):
    """What the camera reports about itself.

    Parameters
    ----------
    name : str
        Maker, model and serial number, as far as the camera reports them.
    frame_bytes : int
        Size of one frame on disk, or an upper estimate.
    exposures_s : tuple of float, optional
        Available exposure times; None if any can be set.
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

    def offers(self, exposure_s: float) -> bool:
        """Return whether this exposure time can be set, to within 1 %."""
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
        What the camera reports about this frame.
    """

    suffix: str
    content: bytes | None = None
    pixels: Pixels | None = None
    metadata: Metadata = field(default_factory=dict)

    def __post_init__(self) -> None:
        if (self.content is None) == (self.pixels is None):
            raise ValueError("an exposure is either a file's bytes or an array; give one of them")


class Camera(Protocol):
    """Takes frames. Every method is bounded in time and raises a `CameraError` if it fails."""

    def open(self) -> None:
        """Connect to the camera, without exposing."""

    def report(self) -> CameraReport:
        """Return the camera's name, limits and settings."""

    def expose(self, exposure_s: float, number: int) -> Exposure:
        """Take one frame.

        Parameters
        ----------
        exposure_s : float
            Exposure time.
        number : int
            Number of the exposure in the session, counting those that were not kept.
        """

    def close(self) -> None:
        """Disconnect; closing twice does no harm."""
