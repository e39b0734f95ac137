"""Tethered cameras, through libgphoto2; files are kept byte for byte."""

import re
from contextlib import suppress
from functools import partial
from pathlib import PurePath
from typing import Any

from faintfield.rig.cameras.protocol import CameraReport, Exposure, call_within
from faintfield.rig.cameras.settings import GPhoto2Settings
from faintfield.rig.errors import CameraError, CameraTimeout, MissingExtra

# Names that cameras give the setting of the exposure time.
_SHUTTER_NAMES = ("shutterspeed", "shutterspeed2", "exposuretime")
# Settings that are recorded in the report.
_RECORDED = ("iso", "f-number", "aperture", "imageformat", "imagequality", "focusmode", "batterylevel", "cameramodel")


class GPhoto2Camera:
    """A `Camera` that libgphoto2 supports."""

    def __init__(self, settings: GPhoto2Settings) -> None:
        self._settings = settings
        self._camera: Any = None
        self._gphoto2: Any = None
        self._shutter_s: float | None = None

    def open(self) -> None:
        """Connect, and change the camera's settings as configured."""
        try:
            import gphoto2
        except ImportError as failure:
            raise MissingExtra("'gphoto2' is not installed; run: pip install 'faintfield[gphoto2]'") from failure
        self._gphoto2 = gphoto2
        self.close()
        self._camera = self._bounded(self._connect, "connecting")
        for name, value in self._settings.settings.items():
            self._bounded(partial(self._set, name, value), f"setting {name} = {value}")

    def report(self) -> CameraReport:
        """Return model, serial number, exposure times and settings."""
        values = self._bounded(self._read_settings, "reporting its settings")
        name = " ".join(values.get(key, "") for key in ("manufacturer", "cameramodel", "serialnumber")).strip()
        return CameraReport(
            name=name or "camera without a name",
            frame_bytes=round(self._settings.frame_mb * 1e6),
            exposures_s=tuple(sorted(self._bounded(self._shutter_choices, "listing its exposure times"))),
            readout_s=1.0,
            settings={key: values[key] for key in _RECORDED if key in values},
        )

    def expose(self, exposure_s: float, number: int) -> Exposure:
        """Release the shutter and fetch the file."""
        if self._shutter_s != exposure_s:
            self._bounded(lambda: self._set_shutter(exposure_s), "setting the exposure time")
            self._shutter_s = exposure_s
        content, name = self._bounded(self._release, f"an exposure of {exposure_s:g} s", exposure_s)
        if not content:
            raise CameraError(f"the camera sent {name} with 0 bytes; check its card and set it to record raw files")
        return Exposure(PurePath(name).suffix.lower(), content=content, metadata={"camera_file": name})

    def close(self) -> None:
        """Disconnect; a camera that does not answer is ignored."""
        camera, self._camera, self._shutter_s = self._camera, None, None
        if camera is not None:
            with suppress(CameraError):  # any fault was already raised when the camera was used
                call_within(self._settings.answer_s, camera.exit, "disconnecting", self._gphoto2.GPhoto2Error)

    def _bounded(self, call: Any, what: str, extra_s: float = 0.0) -> Any:
        if self._camera is None and call != self._connect:
            raise CameraError("the camera is not connected; open it first")
        bound_s = self._settings.answer_s + 2.0 * extra_s
        remedy = "check cable, card, battery and that no other program has it, then go on"
        try:
            return call_within(bound_s, call, what, self._gphoto2.GPhoto2Error, remedy)
        except CameraTimeout:
            self._camera = None  # it hangs, so it is not asked to disconnect
            raise

    def _connect(self) -> Any:
        camera = self._gphoto2.Camera()
        if self._settings.port:
            ports = self._gphoto2.PortInfoList()
            ports.load()
            camera.set_port_info(ports[ports.lookup_path(self._settings.port)])
        camera.init()
        return camera

    def _read_settings(self) -> dict[str, str]:
        values: dict[str, str] = {}
        pending = [self._camera.get_config()]
        containers = (self._gphoto2.GP_WIDGET_WINDOW, self._gphoto2.GP_WIDGET_SECTION)
        while pending:
            widget = pending.pop()
            pending.extend(widget.get_children())
            if widget.get_type() not in containers and widget.get_name() not in values:
                values[widget.get_name()] = str(widget.get_value())
        return values

    def _shutter(self) -> Any:
        """Return the setting of the exposure time, under the first name that this camera has."""
        for name in _SHUTTER_NAMES:
            try:
                return self._camera.get_single_config(name)
            except self._gphoto2.GPhoto2Error as failure:
                if failure.code != self._gphoto2.GP_ERROR_BAD_PARAMETERS:
                    raise
        raise CameraError("the camera lets no program set its exposure time; turn its dial to M (manual)")

    def _shutter_choices(self) -> dict[float, str]:
        choices = list(self._shutter().get_choices())
        return {seconds: choice for choice in choices if (seconds := parse_shutter_s(choice)) is not None}

    def _set_shutter(self, exposure_s: float) -> None:
        choices = self._shutter_choices()
        nearest = min(choices, key=lambda seconds: abs(seconds - exposure_s), default=None)
        if nearest is None or abs(nearest - exposure_s) > 0.01 * nearest:
            offered = ", ".join(f"{seconds:g}" for seconds in sorted(choices))
            raise CameraError(f"exposure_s = {exposure_s:g} is not among the camera's: {offered}; choose one of them")
        widget = self._shutter()
        widget.set_value(choices[nearest])
        self._camera.set_single_config(widget.get_name(), widget)

    def _set(self, name: str, value: str) -> None:
        try:
            widget = self._camera.get_single_config(name)
        except self._gphoto2.GPhoto2Error as failure:
            present = self._read_settings()
            if name in present:
                raise
            names = ", ".join(sorted(present))
            problem = f"camera.settings.{name} = {value!r}: the camera has no setting {name}, it has: {names}"
            raise CameraError(f"{problem}; correct it") from failure
        widget.set_value(self._accepted(widget, name, value))
        self._camera.set_single_config(name, widget)

    def _accepted(self, widget: Any, name: str, value: str) -> str | int | float:
        """Return a value in the type of its setting."""
        gphoto2, kind = self._gphoto2, widget.get_type()
        key = f"camera.settings.{name} = {value!r}"
        if widget.get_readonly() and value != str(widget.get_value()):
            state = f"the camera lets no program set this, it is {widget.get_value()!r}"
            raise CameraError(f"{key}: {state}; set it at the camera, and remove the key")
        if kind in (gphoto2.GP_WIDGET_RADIO, gphoto2.GP_WIDGET_MENU, gphoto2.GP_WIDGET_TOGGLE):
            toggle = kind == gphoto2.GP_WIDGET_TOGGLE
            choices = ["0", "1"] if toggle else list(widget.get_choices())
            if value in choices:
                return int(value) if toggle else value
        elif kind == gphoto2.GP_WIDGET_RANGE:
            low, high, step = widget.get_range()
            choices = [f"{low:g} to {high:g} in steps of {step:g}"]
            with suppress(ValueError):
                if low <= float(value) <= high:
                    return float(value)
        elif kind == gphoto2.GP_WIDGET_TEXT:
            return value
        else:
            choices = ["nothing that a file can state"]
        raise CameraError(f"{key} is not offered by the camera, which offers: {', '.join(choices)}; choose one of them")

    def _release(self) -> tuple[bytes, str]:
        place = self._camera.capture(self._gphoto2.GP_CAPTURE_IMAGE)
        file = self._camera.file_get(place.folder, place.name, self._gphoto2.GP_FILE_TYPE_NORMAL)
        content = bytes(file.get_data_and_size())
        if not self._settings.keep_on_card:
            self._camera.file_delete(place.folder, place.name)
        return content, place.name


def parse_shutter_s(text: str) -> float | None:
    """Return the seconds of a camera's text for an exposure time, such as 1/250, 0.0100s or 2.5; None for bulb."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)(?:/(\d+(?:\.\d+)?))?\s*s?\s*", text)
    if match is None or float(match[2] or 1) == 0:
        return None
    seconds = float(match[1]) / float(match[2] or 1)
    return seconds if seconds > 0 else None
