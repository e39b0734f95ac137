"""Call libaravis 0.8 through ctypes: errors become exceptions, and every reference is given back exactly once."""

import ctypes
import weakref
from collections.abc import Callable
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint64, c_void_p
from typing import Any

from faintfield.rig.errors import MissingExtra

LIBRARY = "libaravis-0.8.so.0"
# The first version with every function below.
_VERSION = "0.8.23"

# Result and arguments of the functions that can fail; a GError ** follows the arguments.
_FAILING: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_camera_new": (c_void_p, (c_char_p,)),
    "arv_camera_create_stream": (c_void_p, (c_void_p, c_void_p, c_void_p)),
    "arv_camera_is_feature_available": (c_int, (c_void_p, c_char_p)),
    "arv_camera_is_exposure_auto_available": (c_int, (c_void_p,)),
    "arv_camera_is_gain_available": (c_int, (c_void_p,)),
    "arv_camera_is_gain_auto_available": (c_int, (c_void_p,)),
    "arv_camera_get_vendor_name": (c_char_p, (c_void_p,)),
    "arv_camera_get_model_name": (c_char_p, (c_void_p,)),
    "arv_camera_get_device_id": (c_char_p, (c_void_p,)),
    "arv_camera_get_string": (c_char_p, (c_void_p, c_char_p)),
    "arv_camera_get_float": (c_double, (c_void_p, c_char_p)),
    "arv_camera_get_exposure_time": (c_double, (c_void_p,)),
    "arv_camera_get_exposure_time_bounds": (None, (c_void_p, POINTER(c_double), POINTER(c_double))),
    "arv_camera_get_gain": (c_double, (c_void_p,)),
    "arv_camera_get_pixel_format": (c_uint, (c_void_p,)),
    "arv_camera_get_pixel_format_as_string": (c_char_p, (c_void_p,)),
    "arv_camera_get_region": (None, (c_void_p, *(POINTER(c_int),) * 4)),
    "arv_camera_get_sensor_size": (None, (c_void_p, POINTER(c_int), POINTER(c_int))),
    "arv_camera_get_payload": (c_uint, (c_void_p,)),
    "arv_camera_set_exposure_time": (None, (c_void_p, c_double)),
    "arv_camera_set_exposure_time_auto": (None, (c_void_p, c_int)),
    "arv_camera_set_gain": (None, (c_void_p, c_double)),
    "arv_camera_set_gain_auto": (None, (c_void_p, c_int)),
    "arv_camera_set_pixel_format_from_string": (None, (c_void_p, c_char_p)),
    "arv_camera_set_region": (None, (c_void_p, c_int, c_int, c_int, c_int)),
    "arv_camera_set_trigger": (None, (c_void_p, c_char_p)),
    "arv_camera_gv_set_packet_size": (None, (c_void_p, c_int)),
    "arv_camera_start_acquisition": (None, (c_void_p,)),
    "arv_camera_software_trigger": (None, (c_void_p,)),
    "arv_camera_stop_acquisition": (None, (c_void_p,)),
    "arv_device_set_features_from_string": (c_int, (c_void_p, c_char_p)),
}

# Result and arguments of those that cannot.
_PLAIN: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_enable_interface": (None, (c_char_p,)),
    "arv_camera_get_device": (c_void_p, (c_void_p,)),
    "arv_camera_is_gv_device": (c_int, (c_void_p,)),
    "arv_camera_gv_set_stream_options": (None, (c_void_p, c_int)),
    "arv_buffer_new_allocate": (c_void_p, (c_size_t,)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_buffer_get_image_width": (c_int, (c_void_p,)),
    "arv_buffer_get_image_height": (c_int, (c_void_p,)),
    "arv_buffer_get_image_padding": (None, (c_void_p, POINTER(c_int), POINTER(c_int))),
    "arv_buffer_get_image_pixel_format": (c_uint, (c_void_p,)),
    "arv_buffer_get_frame_id": (c_uint64, (c_void_p,)),
    "arv_buffer_get_timestamp": (c_uint64, (c_void_p,)),
    "arv_buffer_get_system_timestamp": (c_uint64, (c_void_p,)),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
}


class AravisError(Exception):
    """libaravis reported an error."""


class _GError(ctypes.Structure):
    """GLib's error: domain, code, message."""

    _fields_ = (("domain", ctypes.c_uint32), ("code", c_int), ("message", c_char_p))


class Reference:
    """The only reference that we hold to an object of the library; `release` is called once, with its address."""

    def __init__(self, pointer: int, release: Callable[[int], None]) -> None:
        self.pointer = pointer
        self._release = weakref.finalize(self, release, pointer)
        # At its end the interpreter has no threads left that the library may wait for; the system frees everything
        self._release.atexit = False

    def release(self) -> None:
        """Give the reference back; later calls do nothing."""
        self._release()

    def transfer(self) -> int:
        """Return the pointer to a function that takes over the reference."""
        self._release.detach()
        return self.pointer


class AravisLibrary:
    """The functions of libaravis that the driver uses, by their names in C; `MissingExtra` if it lacks one."""

    def __init__(self) -> None:
        try:
            self._aravis = ctypes.CDLL(LIBRARY)
            self._gobject = ctypes.CDLL("libgobject-2.0.so.0")
            self._glib = ctypes.CDLL("libglib-2.0.so.0")
        except OSError as failure:
            raise MissingExtra(f"backend 'aravis' needs {LIBRARY}; run: apt-get install libaravis-0.8-0") from failure
        self._gobject.g_object_unref.restype, self._gobject.g_object_unref.argtypes = None, (c_void_p,)
        self._glib.g_error_free.restype, self._glib.g_error_free.argtypes = None, (c_void_p,)
        for name, (result, arguments) in (_PLAIN | _FAILING).items():
            try:
                function = getattr(self._aravis, name)
            except AttributeError as failure:
                raise MissingExtra(f"backend 'aravis' needs {LIBRARY} {_VERSION} or newer; install it") from failure
            error = (POINTER(POINTER(_GError)),) if name in _FAILING else ()
            function.restype, function.argtypes = result, (*arguments, *error)

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function by name; raises `AravisError` with the library's message if the function reports an error.

        A text that is returned belongs to the library and is copied.
        """
        function = getattr(self._aravis, name)
        if name in _PLAIN:
            return function(*arguments)
        error = POINTER(_GError)()
        result = function(*arguments, byref(error))
        if error:
            message = error.contents.message.decode(errors="replace")
            self._glib.g_error_free(error)
            raise AravisError(message)
        return result

    def text(self, name: str, *arguments: Any) -> str:
        """Call a function that returns a text; nothing becomes an empty text."""
        found: bytes | None = self.call(name, *arguments)
        return "" if found is None else found.decode(errors="replace")

    def numbers(self, name: str, kind: type[c_int | c_double], count: int, *arguments: Any) -> tuple[Any, ...]:
        """Call a function that fills in `count` numbers, and return these."""
        values = [kind() for _ in range(count)]
        self.call(name, *arguments, *map(byref, values))
        return tuple(value.value for value in values)

    def reference(self, name: str, *arguments: Any) -> Reference | None:
        """Call a function that returns a new reference; None if it returns nothing."""
        pointer: int | None = self.call(name, *arguments)
        return None if pointer is None else Reference(pointer, self._gobject.g_object_unref)

    def bytes_of(self, buffer: int) -> bytes:
        """Return a copy of a buffer's data."""
        size = c_size_t()
        data = self.call("arv_buffer_get_data", buffer, byref(size))
        return ctypes.string_at(data, size.value) if data else b""
