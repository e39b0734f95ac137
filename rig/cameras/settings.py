"""The `[camera]` table of rig.toml, one type for each backend."""

from pathlib import Path

from msgspec import Struct

type Mosaic = tuple[str, ...]

# Largest frame that is simulated; rendering takes some hundred bytes of memory for each pixel.
MAX_SIMULATED_PIXELS = 40_000_000


class GPhoto2Settings(Struct, frozen=True, forbid_unknown_fields=True, tag_field="backend", tag="gphoto2"):
    """A tethered camera that libgphoto2 supports.

    Parameters
    ----------
    port : str
        Port such as `usb:001,004`, if there are several cameras; by default the first that is found.
    settings : dict
        Values by libgphoto2's names, set when the camera is opened, such as `iso = "100"`.
    frame_mb : float
        Upper estimate of the size of a raw file.
    answer_s : float
        Time limit for every operation, in addition to the exposure.
    keep_on_card : bool
        Keep the file on the camera's card as well.
    """

    port: str = ""
    settings: dict[str, str] = {}
    frame_mb: float = 60.0
    answer_s: float = 30.0
    keep_on_card: bool = True


class MicroManagerSettings(Struct, frozen=True, forbid_unknown_fields=True, tag_field="backend", tag="micromanager"):
    """A camera for which Micro-Manager has a device adapter.

    Parameters
    ----------
    configuration : str
        Micro-Manager's .cfg file; by default that of the demonstration camera.
    adapters : str
        Folder of the device adapters; by default the one that pymmcore-plus finds.
    properties : dict
        Properties of the camera, set when it is opened, such as `Binning = "1"`.
    answer_s : float
        Time limit for every operation, in addition to the exposure.
    mosaic : tuple of str, optional
        Rows of one period of the colour filters, such as `["RG", "GB"]`; by default there are none.
    """

    configuration: str = ""
    adapters: str = ""
    properties: dict[str, str] = {}
    answer_s: float = 20.0
    mosaic: Mosaic | None = None


class FolderSettings(Struct, frozen=True, forbid_unknown_fields=True, tag_field="backend", tag="folder"):
    """Any vendor's program that saves each frame as a file in a folder.

    Parameters
    ----------
    folder : str
        Folder of the files, which stay there; the session keeps copies.
    suffixes : tuple of str
        Suffixes of files that are frames.
    frame_mb : float
        Upper estimate of the size of a file.
    arrival_s : float
        Time limit from the end of the exposure until the file is complete.
    mosaic : tuple of str, optional
        Rows of one period of the colour filters; raw files contain this themselves.
    """

    folder: str
    suffixes: tuple[str, ...] = (".tif", ".tiff", ".png", ".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf")
    frame_mb: float = 60.0
    arrival_s: float = 60.0
    mosaic: Mosaic | None = None

    def __post_init__(self) -> None:
        if not Path(self.folder).name:
            raise ValueError(f"camera.folder = {self.folder!r} names no folder; give the folder of the camera's files")


class SimulatedSettings(Struct, frozen=True, forbid_unknown_fields=True, tag_field="backend", tag="simulated"):
    """The paper's camera and scene, rendered from the true position of the simulated stage.

    Parameters
    ----------
    size_px : (int, int)
        Width and height of a frame.
    lit_photons_per_s, unlit_photons_per_s : float
        Photons on a pixel that sees a white object, with the lights on and almost off.
    read_noise_e, gain_dn_per_e, saturation_dn : float, float, int
        Read noise, gain and highest value of the sensor; by default those of the paper.
    mosaic : tuple of str, optional
        Rows of one period of the colour filters, such as `["RG", "GB"]`; by default there are none.
    position_error_mm, rotation_error_mrad : float
        Standard deviation, per axis, of the camera's pose from where the motors are.
    scale_error, squareness_mrad : float
        Relative error of distances along x, and the angle by which y deviates from a right angle.
    seed : int
        Seed of the random generator.
    """

    size_px: tuple[int, int] = (640, 480)
    lit_photons_per_s: float = 400_000.0
    unlit_photons_per_s: float = 40.0
    read_noise_e: float = 12.0**0.5
    gain_dn_per_e: float = 2.0
    saturation_dn: int = 65535
    mosaic: Mosaic | None = None
    position_error_mm: float = 0.0
    rotation_error_mrad: float = 0.0
    scale_error: float = 0.0
    squareness_mrad: float = 0.0
    seed: int = 1

    def __post_init__(self) -> None:
        if min(self.size_px) < 8:
            raise ValueError(f"camera.size_px = {list(self.size_px)} is too small; give at least 8 x 8")
        width, height = self.size_px
        if width * height > MAX_SIMULATED_PIXELS:
            raise ValueError(
                f"camera.size_px = {list(self.size_px)} has {width * height} pixels, at most {MAX_SIMULATED_PIXELS} "
                "are simulated; give a smaller frame"
            )
        if self.gain_dn_per_e <= 0 or min(self.read_noise_e, self.position_error_mm, self.rotation_error_mrad) < 0:
            raise ValueError("camera: a gain is positive, and read noise and errors are not negative; correct them")
        if min(self.lit_photons_per_s, self.unlit_photons_per_s, self.seed) < 0 or not 0 < self.saturation_dn < 2**16:
            raise ValueError("camera: light and seed are not negative, and saturation_dn is 1 to 65535; correct them")
        if self.mosaic is not None and (not self.mosaic or set("".join(self.mosaic)) - set("RGB")):
            raise ValueError(f"camera.mosaic = {list(self.mosaic)}; give rows of the letters R, G and B")


type CameraSettings = GPhoto2Settings | MicroManagerSettings | FolderSettings | SimulatedSettings
