"""Scientific cameras, through Micro-Manager's device adapters."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from faintfield.rig.cameras.bounded import call_within
from faintfield.rig.cameras.protocol import CameraReport, Exposure
from faintfield.rig.cameras.settings import MicroManagerSettings
from faintfield.rig.errors import CameraError, CameraTimeout, MissingExtra, in_one_line


class MicroManagerCamera:
    """A `Camera` that Micro-Manager supports, through pymmcore-plus.

    Parameters
    ----------
    settings : MicroManagerSettings
        The `[camera]` table.
    """

    def __init__(self, settings: MicroManagerSettings) -> None:
        self._settings = settings
        self._core: Any = None

    def open(self) -> None:
        """Load the configuration, and change the camera's properties as configured."""
        try:
            from pymmcore_plus import CMMCorePlus
        except ImportError as failure:
            raise MissingExtra(
                "backend 'micromanager' needs a package that is not installed; "
                "run: pip install 'faintfield[micromanager]'"
            ) from failure
        self.close()
        self._core = CMMCorePlus()
        try:
            self._bounded(self._load, f"loading {self._settings.configuration or 'the demonstration configuration'}")
        except CameraError:
            self.close()
            raise

    def report(self) -> CameraReport:
        """Return name, frame size and the camera's properties."""
        return self._bounded(self._read_report, "reporting its properties")

    def expose(self, exposure_s: float, number: int) -> Exposure:
        """Take one frame."""
        pixels, label = self._bounded(
            lambda: self._snap(exposure_s), f"an exposure of {exposure_s:g} s", extra_s=2.0 * exposure_s
        )
        if pixels.dtype.kind != "u" or pixels.dtype.itemsize > 2:
            raise CameraError(
                f"the camera gives pixels of type {pixels.dtype}; set its PixelType to 16bit, or 8bit if it has no more"
            )
        return Exposure(".tiff", pixels=pixels, metadata={"camera": label})

    def close(self) -> None:
        """Unload the devices."""
        core, self._core = self._core, None
        if core is not None:
            try:
                call_within(self._settings.answer_s, core.unloadAllDevices, "disconnecting")
            except (CameraError, RuntimeError):
                pass  # any fault was already raised when the camera was used

    def _bounded[T](self, call: Callable[[], T], what: str, extra_s: float = 0.0) -> T:
        """Call with a time limit, and raise `CameraError` for what the library raises."""
        if self._core is None:
            raise CameraError("the camera is not connected; open it first")
        try:
            return call_within(self._settings.answer_s + extra_s, call, what)
        except CameraTimeout:
            self._core = None  # it hangs, so it is not asked to disconnect
            raise
        except (RuntimeError, OSError) as failure:
            raise CameraError(
                f"the camera failed at {what}: {in_one_line(failure)}; check its cable, its power and the "
                "configuration file"
            ) from failure

    def _load(self) -> None:
        """Load the configured devices and set the camera's properties."""
        if self._settings.adapters:
            self._core.setDeviceAdapterSearchPaths([self._settings.adapters])
        if self._settings.configuration:
            self._core.loadSystemConfiguration(str(Path(self._settings.configuration).absolute()))
        else:
            self._core.loadSystemConfiguration()
        camera = self._core.getCameraDevice()
        if not camera:
            raise RuntimeError("the configuration has no camera")
        for name, value in self._settings.properties.items():
            self._core.setProperty(camera, name, value)

    def _snap(self, exposure_s: float) -> tuple[Any, str]:
        """Expose, and return the pixels and the camera's label."""
        self._core.setExposure(1e3 * exposure_s)
        return self._core.snap(), self._core.getCameraDevice()

    def _read_report(self) -> CameraReport:
        """Return the report."""
        core = self._core
        label = core.getCameraDevice()
        pixels = core.getImageWidth() * core.getImageHeight() * core.getNumberOfComponents()
        properties = {name: core.getProperty(label, name) for name in core.getDevicePropertyNames(label)}
        return CameraReport(
            name=f"{core.getDeviceLibrary(label)} {core.getDeviceName(label)}",
            frame_bytes=pixels * core.getBytesPerPixel() + 512,
            readout_s=0.05,
            settings=properties,
        )
