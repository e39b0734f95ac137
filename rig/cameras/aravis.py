"""GenICam cameras (GigE Vision, USB3 Vision), through Aravis: one acquisition and one trigger for each frame."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from ctypes import c_double, c_int
from typing import Any

from faintfield.rig.cameras.aravis_frames import FrameTimes, Moment, PixelFormat, Stamps
from faintfield.rig.cameras.aravis_library import AravisError, AravisLibrary, Reference
from faintfield.rig.cameras.protocol import CameraReport, Exposure, Metadata, Pixels, call_within
from faintfield.rig.cameras.settings import AravisSettings
from faintfield.rig.errors import CameraError, CameraTimeout

# The most frequent ArvBufferStatus, in words; 0 is success.
_STATUS = {1: "no data came", 2: "its packets did not all come in time", 3: "packets are missing"}
# No sensor has more rows or columns, and no frame more bytes.
_MAX_SIDE_PX, _MAX_PAYLOAD = 65_536, 2_000_000_000
# ARV_GV_STREAM_OPTION_PACKET_SOCKET_DISABLED, and ARV_AUTO_OFF
_NO_PACKET_SOCKET = 1
_AUTO_OFF = 0


class AravisDevice:
    """A camera that is connected and waits for requests; its methods block, and may hang if the camera does.

    Raises `AravisError` if no camera is found, and `CameraError` if it keeps another region, pixel format or gain.
    """

    def __init__(self, library: AravisLibrary, settings: AravisSettings) -> None:
        self._library = library
        self._settings = settings
        self._format = PixelFormat.named(settings.pixel_format)
        self._times = FrameTimes()
        self._exposure_s: float | None = None
        self._in_use = threading.Lock()
        if settings.camera.startswith("Fake"):
            library.call("arv_enable_interface", b"Fake")
        camera = library.reference("arv_camera_new", settings.camera.encode() or None)
        if camera is None:
            raise AravisError("no camera is found")
        self._camera: Reference = camera
        try:
            self._configure()
            self._format_code = self._set_format()
            self._region = self._set_region()
            self._call("arv_camera_set_trigger", b"Software")
            self._has_temperature = bool(self._call("arv_camera_is_feature_available", b"DeviceTemperature"))
            vendor, model = self._text("arv_camera_get_vendor_name"), self._text("arv_camera_get_model_name")
            self._name = " ".join(filter(None, (vendor, model, self._text("arv_camera_get_device_id"))))
        except BaseException:
            camera.release()
            raise
        self._is_fake = (vendor, model) == ("Aravis", "Fake")  # it sends a pattern at once, however long it exposes

    def release(self) -> None:
        """Disconnect as soon as no call in another thread uses the camera."""
        with self._in_use:
            self._camera.release()

    def report(self) -> CameraReport:
        """Return vendor, model and serial number, region, format and limits."""
        with self._in_use:
            width, height = self._region[2:]
            settings = {
                "PixelFormat": self._format.name,
                "Region": f"{width} x {height} at {self._region[0]}, {self._region[1]}",
                "ExposureTime": "{:g} to {:g} s".format(*self._exposure_range_s()),
                **self._settings.features,
            }
            if self._call("arv_camera_is_gain_available"):
                settings["Gain"] = f"{self._call('arv_camera_get_gain'):g}"
            return CameraReport(
                self._name,
                width * height * (1 if self._format.bits == 8 else 2) + 512,
                readout_s=0.05,
                settings=settings,
                exposure_range_s=self._exposure_range_s(),
            )

    def take(self, exposure_s: float) -> tuple[Pixels, Metadata]:
        """Expose, and return values and metadata of the frame."""
        with self._in_use:
            return self._take(exposure_s)

    def _take(self, exposure_s: float) -> tuple[Pixels, Metadata]:
        library = self._library
        if self._exposure_s != exposure_s:
            self._set_exposure(exposure_s)
        payload = self._call("arv_camera_get_payload")
        if not self._format.frame_bytes(*self._region[2:]) <= payload <= _MAX_PAYLOAD:
            problem = f"the camera announces frames of {payload} bytes for the region {list(self._region)}"
            raise CameraError(f"{problem} in {self._format.name}; open it again")
        stream = library.reference("arv_camera_create_stream", self._camera.pointer, None, None)
        buffer = library.reference("arv_buffer_new_allocate", payload)
        if stream is None or buffer is None:
            raise AravisError("it gives no stream")
        try:
            library.call("arv_stream_push_buffer", stream.pointer, buffer.transfer())
            with self._acquiring():
                requested = Moment.now()
                self._call("arv_camera_software_trigger")
                wait_us = round(1e6 * (exposure_s + 0.5 * self._settings.answer_s))
                frame = library.reference("arv_stream_timeout_pop_buffer", stream.pointer, wait_us)
                now = Moment.now()
            if frame is None:
                waited = f"{1e-6 * wait_us:g} s"
                remedy = "check its cable, and for a network camera firewall and camera.packet_bytes"
                raise CameraTimeout(f"no frame came within {waited}; {remedy}")
            try:
                return self._values(frame.pointer), self._metadata(frame.pointer, requested, now, exposure_s)
            finally:
                frame.release()
        finally:
            stream.release()

    def _configure(self) -> None:
        """Set what the settings say; the gain is read back, the other features are not."""
        settings = self._settings
        if self._call("arv_camera_is_gv_device"):
            if not settings.packet_socket:
                self._call("arv_camera_gv_set_stream_options", _NO_PACKET_SOCKET)
            if settings.packet_bytes is not None:
                self._call("arv_camera_gv_set_packet_size", settings.packet_bytes)
        with suppress(AravisError):  # a program that was killed may have left it running
            self._call("arv_camera_stop_acquisition")
        device = self._call("arv_camera_get_device")
        for name, value in settings.features.items():
            self._library.call("arv_device_set_features_from_string", device, f'{name}="{value}"'.encode())
        if self._call("arv_camera_is_exposure_auto_available"):
            self._call("arv_camera_set_exposure_time_auto", _AUTO_OFF)
        if self._call("arv_camera_is_gain_auto_available"):
            self._call("arv_camera_set_gain_auto", _AUTO_OFF)
        if (gain := settings.gain) is not None:
            self._call("arv_camera_set_gain", gain)
            kept = self._call("arv_camera_get_gain")
            if abs(kept - gain) > max(0.01, 0.01 * abs(gain)):
                raise CameraError(f"the camera keeps gain {kept:g} instead of camera.gain = {gain:g}; choose {kept:g}")

    def _set_format(self) -> int:
        name = self._format.name
        self._call("arv_camera_set_pixel_format_from_string", name.encode())
        kept, code = self._text("arv_camera_get_pixel_format_as_string"), int(self._call("arv_camera_get_pixel_format"))
        if kept != name or code >> 16 & 0xFF != self._format.stored_bits:
            raise CameraError(f"the camera keeps pixel format {kept} (0x{code:08x}) instead of {name}; choose another")
        return code

    def _set_region(self) -> tuple[int, ...]:
        region_px = self._settings.region_px
        if region_px is not None:
            left, upper, width, height = region_px
            columns, rows = self._numbers("arv_camera_get_sensor_size", c_int, 2)
            if left + width > columns or upper + height > rows:
                problem = f"camera.region_px = {list(region_px)} leaves the sensor of {columns} x {rows} pixels"
                raise CameraError(f"{problem}; correct it")
            self._call("arv_camera_set_region", *region_px)
        region = self._numbers("arv_camera_get_region", c_int, 4)
        if region_px is not None and region != region_px:
            raise CameraError(f"the camera reads the region {list(region)} instead of {list(region_px)}; set another")
        left, upper, width, height = region
        if not (0 < width <= _MAX_SIDE_PX and 0 < height <= _MAX_SIDE_PX):
            raise CameraError(f"the camera reports a frame of {width} x {height} pixels; set camera.region_px")
        if self._format.mosaic is not None and (left % 2 or upper % 2):
            problem = f"the camera's region begins at column {left}, row {upper}, which shifts its mosaic"
            raise CameraError(f"{problem}; set camera.region_px with an even column and row")
        return region

    def _exposure_range_s(self) -> tuple[float, float]:
        bounds_us = self._numbers("arv_camera_get_exposure_time_bounds", c_double, 2)
        return 1e-6 * bounds_us[0], 1e-6 * bounds_us[1]

    def _set_exposure(self, exposure_s: float) -> None:
        self._exposure_s = None  # what the camera keeps after a failure is not known
        shortest_s, longest_s = self._exposure_range_s()
        if not 0.99 * shortest_s <= exposure_s <= 1.01 * longest_s:
            limits = f"{shortest_s:g} to {longest_s:g}"
            raise CameraError(f"exposure_s = {exposure_s:g} is not among the camera's, {limits}; choose one of them")
        self._call("arv_camera_set_exposure_time", 1e6 * exposure_s)
        set_s = 1e-6 * self._call("arv_camera_get_exposure_time")
        if abs(set_s - exposure_s) > 0.01 * exposure_s:
            raise CameraError(f"the camera exposes {set_s:g} s for exposure_s = {exposure_s:g}; choose {set_s:g}")
        self._exposure_s = exposure_s

    @contextmanager
    def _acquiring(self) -> Iterator[None]:
        self._call("arv_camera_start_acquisition")
        try:
            yield
        except BaseException:
            with suppress(AravisError):
                self._call("arv_camera_stop_acquisition")
            raise
        self._call("arv_camera_stop_acquisition")

    def _values(self, frame: int) -> Pixels:
        library = self._library
        status = library.call("arv_buffer_get_status", frame)
        if status != 0:
            reason = _STATUS.get(status, f"state {status}")
            raise CameraError(f"the frame is incomplete: {reason}; check cable, network and camera.packet_bytes")
        size = (library.call("arv_buffer_get_image_width", frame), library.call("arv_buffer_get_image_height", frame))
        code = library.call("arv_buffer_get_image_pixel_format", frame)
        padding = library.numbers("arv_buffer_get_image_padding", c_int, 2, frame)
        if size != self._region[2:] or code != self._format_code or any(padding):
            raise CameraError(
                f"a frame came with {size[0]} x {size[1]} pixels in format 0x{code:08x}, padded by {list(padding)} "
                f"bytes, instead of {self._region[2]} x {self._region[3]} in {self._format.name}; open the camera again"
            )
        return self._format.values(library.bytes_of(frame), *size)

    def _metadata(self, frame: int, requested: Moment, now: Moment, exposure_s: float) -> Metadata:
        """Return what is known of a frame, after checking that it began after its request."""
        library = self._library
        stamps = Stamps(
            library.call("arv_buffer_get_system_timestamp", frame), library.call("arv_buffer_get_timestamp", frame)
        )
        self._times.check(stamps, requested, now, 0.0 if self._is_fake else exposure_s)
        metadata: dict[str, str | int | float] = {
            "camera": self._name,
            "pixel_format": self._format.name,
            "frame_id": library.call("arv_buffer_get_frame_id", frame),
            "received_ns": stamps.received_ns,
            "camera_time_ns": stamps.camera_ns,
        }
        temperature_c = self.temperature_c()
        if temperature_c is not None:
            metadata["temperature_c"] = temperature_c
        return metadata

    def temperature_c(self) -> float | None:
        """Return the temperature in °C, None if the camera does not measure it."""
        return float(self._call("arv_camera_get_float", b"DeviceTemperature")) if self._has_temperature else None

    def _text(self, name: str) -> str:
        return self._library.text(name, self._camera.pointer)

    def _numbers(self, name: str, kind: type[c_int | c_double], count: int) -> tuple[Any, ...]:
        return self._library.numbers(name, kind, count, self._camera.pointer)

    def _call(self, name: str, *arguments: object) -> Any:
        return self._library.call(name, self._camera.pointer, *arguments)


class AravisCamera:
    """A `Camera` that speaks GenICam."""

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

        Raises `CameraError` for a frame that is incomplete, of another size or format, or begun before this call.
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
        remedy = "check its cable, its power and [camera], and that no other program has it"
        try:
            return call_within(self._settings.answer_s + extra_s, call, what, AravisError, remedy)
        except CameraTimeout:
            self._device = None  # the thread of the call keeps it, and disconnects it should the call return
            raise
