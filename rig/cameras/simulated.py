"""A camera in the simulated lab; its exposures take simulated time."""

from collections.abc import Callable

from rig.cameras.protocol import CameraReport, Exposure, Pixels
from rig.cameras.settings import SimulatedSettings
from rig.clock import Clock
from rig.errors import CameraError

_READOUT_S = 0.05
_TIFF_HEADER_BYTES = 512


class SimulatedCamera:
    """A `Camera` that renders what it would see.

    Parameters
    ----------
    settings : SimulatedSettings
        The `[camera]` table.
    clock : Clock
        The simulated world's.
    view : callable
        Renders a frame of an exposure time, with a number for its noise.
    """

    def __init__(self, settings: SimulatedSettings, clock: Clock, view: Callable[[float, int], Pixels]) -> None:
        self._settings = settings
        self._clock = clock
        self._view = view
        self._open = False

    def open(self) -> None:
        """Connect."""
        self._open = True

    def report(self) -> CameraReport:
        """Return the size of a frame."""
        self._require_open()
        width, height = self._settings.size_px
        return CameraReport("simulated camera", 2 * width * height + _TIFF_HEADER_BYTES, readout_s=_READOUT_S)

    def expose(self, exposure_s: float, number: int) -> Exposure:
        """Render the scene from where the camera is when the exposure begins."""
        self._require_open()
        pixels = self._view(exposure_s, number)
        self._clock.sleep_s(exposure_s + _READOUT_S)
        return Exposure(".tiff", pixels=pixels, metadata={"camera": "simulated camera"})

    def close(self) -> None:
        """Disconnect."""
        self._open = False

    def _require_open(self) -> None:
        """Raise before `open` and after `close`."""
        if not self._open:
            raise CameraError("the camera is not connected; open it first")
