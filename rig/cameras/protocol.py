"""What a camera is: the vocabulary that drivers, capture and simulators share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from msgspec import Struct
from numpy.typing import NDArray

type Pixels = NDArray[Any]
type Metadata = Mapping[str, str | int | float | Sequence[float] | None]


class CameraReport(Struct, frozen=True):
    """Who the camera is, and what it can do.

    Parameters
    ----------
    name : str
        Maker, model and serial number, as far as it says.
    frame_bytes : int
        Room that one frame takes on disk, or an upper estimate.
    exposures_s : tuple of float, optional
        The exposure times that it offers; None when any will do.
    readout_s : float
        Time of a frame besides its exposure, an estimate until it is measured.
    settings : dict
        What it is set to, for the record.
    """

    name: str
    frame_bytes: int
    exposures_s: tuple[float, ...] | None = None
    readout_s: float = 0.0
    settings: dict[str, str] = {}

    def offers(self, exposure_s: float) -> bool:
        """Return whether this exposure time can be set, to one part in a hundred."""
        return self.exposures_s is None or any(abs(exposure_s - it) <= 0.01 * it for it in self.exposures_s)


@dataclass(frozen=True)
class Exposure:
    """One frame as the camera gave it: a file's bytes, or an array that becomes a TIFF.

    Parameters
    ----------
    suffix : str
        Of the file, such as `.nef` or `.tiff`.
    content : bytes, optional
        The file, byte for byte.
    pixels : array, optional
        (row, column) or (row, column, colour), when there is no file.
    metadata : mapping
        What the camera says about this frame.
    """

    suffix: str
    content: bytes | None = None
    pixels: Pixels | None = None
    metadata: Metadata = field(default_factory=dict)

    def __post_init__(self) -> None:
        if (self.content is None) == (self.pixels is None):
            raise ValueError("an exposure is either a file's bytes or an array; give one of them")


class Camera(Protocol):
    """Takes frames. Every method ends within a bound and raises a `CameraError` when it cannot do what it should."""

    def open(self) -> None:
        """Connect to the camera; nothing is exposed."""
        ...

    def report(self) -> CameraReport:
        """Return who the camera is and how it is set."""
        ...

    def expose(self, exposure_s: float, number: int) -> Exposure:
        """Take one frame.

        Parameters
        ----------
        exposure_s : float
            Exposure time.
        number : int
            Counts the exposures of the session, those that were never kept included.
        """
        ...

    def close(self) -> None:
        """Let the camera go; closing twice does no harm."""
        ...
