"""The `[camera]` table of rig.toml, one type for each backend."""

import math
from pathlib import Path
from typing import Any

from msgspec import Struct

from faintfield.rig.cameras.aravis_frames import PixelFormat

type Mosaic = tuple[str, ...]

# Largest frame that is simulated; rendering takes some hundred bytes of memory for each pixel.
_MAX_SIMULATED_PIXELS = 40_000_000
# Values of `backend` that are built in.
BUILT_IN_BACKENDS = ("gphoto2", "micromanager", "aravis", "folder", "simulated")
# GenICam features that have keys of their own in `[camera]`, or that each frame sets.
_OWN_FEATURES = {"PixelFormat", "Gain", "ExposureTime"}
# Longest time limit of an operation in s.
_MAX_ANSWER_S = 3600.0


class CoolingSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of every `[camera]` table: the temperature at which frames are taken.

    Parameters
    ----------
    settle_temperature_c : float, optional
        Temperature of the sensor that a capture waits for before the first frame of each step; by default it does not
        wait. The camera's own settings make it cool.
    settle_tolerance_c, settle_limit_s : float
        Largest difference from `settle_temperature_c` that counts as reached; time limit of the wait for that
        temperature.
    """

    settle_temperature_c: float | None = None
    settle_tolerance_c: float = 0.5
    settle_limit_s: float = 900.0

    def __post_init__(self) -> None:
        wanted_c = self.settle_temperature_c
        if wanted_c is not None and not -273.15 <= wanted_c < 200.0:
            raise ValueError(f"camera.settle_temperature_c = {wanted_c:g}; give degrees Celsius")
        if not (self.settle_tolerance_c > 0.0 and self.settle_limit_s > 0.0):
            limits = f"{self.settle_tolerance_c:g} and settle_limit_s = {self.settle_limit_s:g}"
            raise ValueError(f"camera.settle_tolerance_c = {limits}; both are positive, correct them")
        if wanted_c is None and (self.settle_tolerance_c, self.settle_limit_s) != (0.5, 900.0):
            raise ValueError(
                "camera.settle_tolerance_c and settle_limit_s need settle_temperature_c; give it, or remove them"
            )


class MosaicSettings(CoolingSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of the `[camera]` tables of cameras whose files do not state their colour filters.

    Parameters
    ----------
    mosaic : tuple of str, optional
        Rows of one period of the colour filters, such as `["RG", "GB"]`; by default there are none.
    """

    mosaic: Mosaic | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mosaic is None:
            return
        widths, letters = set(map(len, self.mosaic)), set("".join(self.mosaic))
        if not letters or len(widths) > 1 or not letters <= set("RGB"):
            raise ValueError(f"camera.mosaic = {list(self.mosaic)}; give rows of one length of the letters R, G and B")


class GPhoto2Settings(CoolingSettings, frozen=True, forbid_unknown_fields=True, tag_field="backend", tag="gphoto2"):
    """A tethered camera that libgphoto2 supports.

    Parameters
    ----------
    port : str
        Port such as `usb:001,004`, if there are several cameras; by default the first that is found.
    settings : dict
        Values by libgphoto2's names, set when the camera is opened, such as `iso = "100"`.
    frame_mb, answer_s : float
        Upper estimate of the size of a raw file; time limit for every operation, in addition to the exposure.
    keep_on_card : bool
        Keep the file on the camera's card as well.
    """

    port: str = ""
    settings: dict[str, str] = {}
    frame_mb: float = 60.0
    answer_s: float = 30.0
    keep_on_card: bool = True


class MicroManagerSettings(
    MosaicSettings, frozen=True, forbid_unknown_fields=True, tag_field="backend", tag="micromanager"
):
    """A camera for which Micro-Manager has a device adapter.

    Parameters
    ----------
    configuration, adapters : str
        Micro-Manager's .cfg file, by default that of the demonstration camera; folder of the device adapters, by
        default the one that pymmcore-plus finds.
    properties : dict
        Properties of the camera, set when it is opened, such as `Binning = "1"`.
    answer_s : float
        Time limit for every operation, in addition to the exposure.
    """

    configuration: str = ""
    adapters: str = ""
    properties: dict[str, str] = {}
    answer_s: float = 20.0


class AravisSettings(CoolingSettings, frozen=True, forbid_unknown_fields=True, tag_field="backend", tag="aravis"):
    """A GenICam camera (GigE Vision or USB3 Vision), through Aravis.

    Parameters
    ----------
    pixel_format : str
        Name by the Pixel Format Naming Convention: Mono or BayerRG, GR, GB or BG, then 8, 10, 12, 14 or 16, or 10p,
        12p, 10Packed or 12Packed. A Bayer format states the mosaic.
    camera : str
        Aravis' name of the camera, its address or its serial number, if there are several; by default the first found.
    region_px : (int, int, int, int), optional
        Left column, upper row, width and height of the part of the sensor that is read; by default all of it. Column
        and row are even for a Bayer format, so that its mosaic stays the same.
    gain : float, optional
        Gain in the camera's unit; by default as it is set in the camera. Automatic gain is switched off.
    features : dict
        Other GenICam features, set when the camera is opened, such as `BlackLevel = "64"`.
    packet_bytes : int, optional
        Size of a network packet; by default as it is set in the camera.
    packet_socket : bool
        True if a network camera may be read through a packet socket, which loses fewer packets and needs special
        rights.
    answer_s : float
        Time limit for every operation, in addition to the exposure.
    """

    pixel_format: str
    camera: str = ""
    region_px: tuple[int, int, int, int] | None = None
    gain: float | None = None
    features: dict[str, str] = {}
    packet_bytes: int | None = None
    packet_socket: bool = True
    answer_s: float = 20.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if own := sorted(_OWN_FEATURES & set(self.features)):
            raise ValueError(f"camera.features has {', '.join(own)}, which other keys or the capture set; remove it")
        if self.packet_bytes is not None and not 576 <= self.packet_bytes <= 65535:
            raise ValueError(f"camera.packet_bytes = {self.packet_bytes}; give 576 to 65535")
        left, upper, width, height = self.region_px or (0, 0, 1, 1)
        odd = self.mosaic is not None and (left % 2 or upper % 2)
        if min(left, upper) < 0 or min(width, height) < 1 or odd:
            raise ValueError(
                f"camera.region_px = {[left, upper, width, height]}; give left column, upper row, width and height in "
                "the sensor, the first two even for a mosaic"
            )
        if not 0.0 < self.answer_s <= _MAX_ANSWER_S:
            raise ValueError(f"camera.answer_s = {self.answer_s:g}; give more than 0 and at most {_MAX_ANSWER_S:g} s")

    @property
    def mosaic(self) -> Mosaic | None:
        """Colour filters, as the pixel format names them."""
        return PixelFormat.named(self.pixel_format).mosaic


class PluginSettings(MosaicSettings, frozen=True, forbid_unknown_fields=True, tag_field="backend", tag="plugin"):
    """A camera that another package drives; docs/tutorials/camera_driver.md.

    Parameters
    ----------
    name, options : str, dict
        Name of the entry point in the group `faintfield.cameras`, which is `backend` in rig.toml; the other keys of the
        table, which the plug-in checks.
    """

    name: str
    options: dict[str, Any] = {}


class FolderSettings(MosaicSettings, frozen=True, forbid_unknown_fields=True, tag_field="backend", tag="folder"):
    """Any vendor's program that saves each frame as a file in a folder.

    Parameters
    ----------
    folder, suffixes : str, tuple of str
        Folder of the files, which stay there, as the session keeps copies; suffixes of files that are frames.
    frame_mb : float
        Upper estimate of the size of a file.
    arrival_s : float
        Time limit from the end of the exposure until the file is complete.
    quiet_s : float
        Time without a change after which a file that cannot be decoded here, or that ends in zeros, is complete.
    silence_s : float
        Time without a new file, in addition to the exposure, for which the capture waits at each node before a frame. A
        program that takes frames by itself, at intervals up to this time, is detected and refused.
    delay_s : float, optional
        For a program that takes frames by itself: longest time from the end of an exposure until its file appears.
        Files that come sooner after a request are ignored, and the capture does not wait for silence. By default the
        program is triggered.
    file_times : bool
        Refuse a file that was last changed before the exposure could end; switch this off for a program that gives its
        files the camera's own time.
    """

    folder: str
    suffixes: tuple[str, ...] = (".tif", ".tiff", ".png", ".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf")
    frame_mb: float = 60.0
    arrival_s: float = 60.0
    quiet_s: float = 5.0
    silence_s: float = 10.0
    delay_s: float | None = None
    file_times: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if not Path(self.folder).name:
            raise ValueError(f"camera.folder = {self.folder!r} names no folder; give the folder of the camera's files")
        if not 0.0 <= self.quiet_s < self.arrival_s:
            raise ValueError(f"camera.quiet_s = {self.quiet_s:g}; give 0 to less than arrival_s = {self.arrival_s:g}")
        if not 0.0 <= min(self.silence_s, self.delay_s or 0.0):
            problem = f"camera.silence_s = {self.silence_s:g} and delay_s = {self.delay_s}"
            raise ValueError(f"{problem}; no time is negative, correct them")


class SimulatedSettings(MosaicSettings, frozen=True, forbid_unknown_fields=True, tag_field="backend", tag="simulated"):
    """The paper's camera and scene, rendered from the true position of the simulated stage.

    Parameters
    ----------
    size_px : (int, int)
        Width and height of a frame.
    lit_photons_per_s, unlit_photons_per_s : float
        Photons per second on a pixel that sees a white object, with the lights on; photons per second on such a pixel
        with the lights almost off.
    read_noise_e, gain_dn_per_e, saturation_dn : float, float, int
        Read noise of the sensor, by default that of the paper; gain of the sensor, by default that of the paper;
        highest value of a pixel, by default that of the paper.
    position_error_mm, rotation_error_mrad : float
        Standard deviation per axis of the camera's position about that of the motors; standard deviation per axis of
        the camera's rotation.
    scale_error, squareness_mrad : float
        Relative error of distances along x; angle between the axes less a right angle.
    start_temperature_c : float, optional
        Temperature of the sensor when the camera is switched on, from which it cools; by default it is cool already.
    cooling_s : float
        Time in which the distance to the set point falls to 1/e. The set point is `settle_temperature_c`, or −20 °C.
    seed : int
        Seed of the random generator.
    """

    size_px: tuple[int, int] = (640, 480)
    lit_photons_per_s: float = 400_000.0
    unlit_photons_per_s: float = 40.0
    read_noise_e: float = 12.0**0.5
    gain_dn_per_e: float = 2.0
    saturation_dn: int = 65535
    position_error_mm: float = 0.0
    rotation_error_mrad: float = 0.0
    scale_error: float = 0.0
    squareness_mrad: float = 0.0
    start_temperature_c: float | None = None
    cooling_s: float = 120.0
    seed: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.size_px) < 8:
            raise ValueError(f"camera.size_px = {list(self.size_px)} is too small; give at least 8 x 8")
        if (pixels := math.prod(self.size_px)) > _MAX_SIMULATED_PIXELS:
            size = f"{pixels} pixels, at most {_MAX_SIMULATED_PIXELS} are simulated"
            raise ValueError(f"camera.size_px = {list(self.size_px)} has {size}; give a smaller frame")
        if self.gain_dn_per_e <= 0 or min(self.read_noise_e, self.position_error_mm, self.rotation_error_mrad) < 0:
            raise ValueError("camera: a gain is positive, and read noise and errors are not negative; correct them")
        if min(self.lit_photons_per_s, self.unlit_photons_per_s, self.seed) < 0 or not 0 < self.saturation_dn < 2**16:
            raise ValueError("camera: light and seed are not negative, and saturation_dn is 1 to 65535; correct them")
        if not self.cooling_s > 0.0:
            raise ValueError(f"camera.cooling_s = {self.cooling_s:g}; give a positive time")


type CameraSettings = (
    GPhoto2Settings | MicroManagerSettings | AravisSettings | FolderSettings | SimulatedSettings | PluginSettings
)
