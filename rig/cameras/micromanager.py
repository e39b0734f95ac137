"""Scientific cameras, through Micro-Manager's device adapters."""

import math
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from faintfield.rig.cameras.protocol import CameraReport, Exposure, Metadata, call_within
from faintfield.rig.cameras.settings import MicroManagerSettings
from faintfield.rig.errors import CameraError, CameraTimeout
from faintfield.rig.micromanager import NotOffered, SharedCore, set_properties

# Names that device adapters give the measured temperature of the sensor in °C, the surest first.
_TEMPERATURES = ("CCDTemperature", "SensorTemperature", "Temperature")


class MicroManagerCamera:
    """A `Camera` that Micro-Manager supports, through pymmcore-plus; the stage may share its core."""

    def __init__(self, settings: MicroManagerSettings, shared: SharedCore | None = None) -> None:
        self._settings = settings
        self._shared = shared or SharedCore(settings.configuration, settings.adapters)
        self._core: Any = None

    def open(self) -> None:
        """Load the configuration, and change the camera's properties as configured."""
        self._shared.import_package()
        self.close()
        what = f"loading {self._settings.configuration or 'the demonstration configuration'}"
        try:
            self._core = self._bounded(self._load, what, connecting=True)
        except CameraError:
            self._release()
            raise

    def report(self) -> CameraReport:
        """Return name, frame size and the camera's properties."""
        return self._bounded(self._read_report, "reporting its properties")

    def expose(self, exposure_s: float, number: int) -> Exposure:
        """Take one frame."""
        pixels, metadata = self._bounded(
            lambda: self._snap(exposure_s), f"an exposure of {exposure_s:g} s", extra_s=2.0 * exposure_s
        )
        if pixels.dtype.kind != "u" or pixels.dtype.itemsize > 2:
            raise CameraError(f"the camera gives pixels of type {pixels.dtype}; set its PixelType to 16bit or 8bit")
        return Exposure(".tiff", pixels=pixels, metadata=metadata)

    def temperature_c(self) -> float | None:
        """Return the temperature of the sensor in °C, None if the camera has no such property."""
        return self._bounded(self._read_temperature, "reporting its temperature")

    def close(self) -> None:
        """Unload the devices, unless the stage uses them."""
        if self._core is not None:
            self._core = None
            self._release()

    def _bounded[T](self, call: Callable[[], T], what: str, extra_s: float = 0.0, *, connecting: bool = False) -> T:
        if self._core is None and not connecting:
            raise CameraError("the camera is not connected; open it first")
        remedy = "check its cable, its power and the configuration file"
        try:
            return call_within(self._settings.answer_s + extra_s, call, what, (RuntimeError, OSError), remedy)
        except CameraTimeout:
            self._core = None
            self._shared.abandon("camera")  # it hangs, so it is not asked to disconnect
            raise
        except NotOffered as failure:
            raise CameraError(f"camera.properties: {failure}") from failure

    def _release(self) -> None:
        with suppress(CameraTimeout, RuntimeError):  # any fault was already raised when the camera was used
            call_within(self._settings.answer_s, lambda: self._shared.release("camera"), "disconnecting")

    def _load(self) -> Any:
        core = self._shared.acquire("camera")
        camera = core.getCameraDevice()
        if not camera:
            raise RuntimeError("the configuration has no camera")
        set_properties(core, camera, self._settings.properties)
        return core

    def _snap(self, exposure_s: float) -> tuple[Any, Metadata]:
        self._core.setExposure(1e3 * exposure_s)
        pixels = self._core.snap()
        return pixels, {"camera": self._core.getCameraDevice(), "temperature_c": self._read_temperature()}

    def _read_temperature(self) -> float | None:
        label = self._core.getCameraDevice()
        present = set(self._core.getDevicePropertyNames(label))
        name = next((name for name in _TEMPERATURES if name in present), None)
        try:
            temperature_c = math.nan if name is None else float(self._core.getProperty(label, name))
        except ValueError:
            return None
        return temperature_c if math.isfinite(temperature_c) else None

    def _read_report(self) -> CameraReport:
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
