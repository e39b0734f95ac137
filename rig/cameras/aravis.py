"""GenICam cameras (GigE Vision, USB3 Vision), through Aravis."""

from collections.abc import Callable
from contextlib import suppress

from faintfield.rig.cameras.aravis_device import AravisDevice
from faintfield.rig.cameras.aravis_library import AravisError, AravisLibrary
from faintfield.rig.cameras.protocol import CameraReport, Exposure, call_within
from faintfield.rig.cameras.settings import AravisSettings
from faintfield.rig.errors import CameraError, CameraTimeout, in_one_line


class AravisCamera:
    """A `Camera` that speaks GenICam.

    Parameters
    ----------
    settings : AravisSettings
        The `[camera]` table.
    """

    def __init__(self, settings: AravisSettings) -> None:
        self._settings = settings
        self._device: AravisDevice | None = None

    def open(self) -> None:
        """Connect, and set pixel format, region, gain, features and the software trigger."""
        self.close()
        library = AravisLibrary()
        what = f"connecting to {self._settings.camera or 'the first camera'}"
        self._device = self._bounded(lambda: AravisDevice(library, self._settings), what)

    def report(self) -> CameraReport:
        """Return vendor, model and serial number, region, format and limits."""
        return self._bounded(self._opened().report, "reporting its settings")

    def expose(self, exposure_s: float, number: int) -> Exposure:
        """Trigger one exposure and read its frame; no acquisition runs before or after it.

        Raises
        ------
        CameraTimeout
            No frame came.
        CameraError
            The frame is incomplete, has another size or format, or its exposure began before this call.
        """
        device = self._opened()
        what = f"an exposure of {exposure_s:g} s"
        pixels, metadata = self._bounded(lambda: device.take(exposure_s), what, extra_s=2.0 * exposure_s)
        return Exposure(".tiff", pixels=pixels, metadata=metadata)

    def temperature_c(self) -> float | None:
        """Return the temperature that the camera reports, None if it reports none."""
        return self._bounded(self._opened().temperature_c, "reporting its temperature")

    def close(self) -> None:
        """Disconnect; a camera that does not answer is ignored."""
        device, self._device = self._device, None
        if device is not None:
            with suppress(CameraTimeout):  # any fault was already raised when the camera was used
                call_within(self._settings.answer_s, device.release, "disconnecting")

    def _opened(self) -> AravisDevice:
        if self._device is None:
            raise CameraError("the camera is not connected; open it first")
        return self._device

    def _bounded[T](self, call: Callable[[], T], what: str, extra_s: float = 0.0) -> T:
        try:
            return call_within(self._settings.answer_s + extra_s, call, what)
        except CameraTimeout:
            self._device = None  # the thread of the call keeps it, and disconnects it should the call return
            raise
        except AravisError as failure:
            raise CameraError(
                f"the camera failed at {what}: {in_one_line(failure)}; check its cable, its power and [camera], and "
                "that no other program has it"
            ) from failure
