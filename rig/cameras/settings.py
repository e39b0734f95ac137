"""The `[camera]` table of rig.toml: one kind of table for each backend."""

from pathlib import Path

from msgspec import Struct

type Mosaic = tuple[str, ...]


class GPhoto2Settings(Struct, frozen=True, forbid_unknown_fields=True, tag_field="backend", tag="gphoto2"):
    """A tethered camera that libgphoto2 knows.

    Parameters
    ----------
    port : str
        Such as `usb:001,004`, when there are several cameras; without it, the first that is found.
    settings : dict
        libgphoto2's names and values, set when the camera is opened, such as `iso = "100"`.
    frame_mb : float
        Room for one raw file.
    answer_s : float
        How long the camera may take for anything besides exposing.
    keep_on_card : bool
        Leave the file on the camera's card as well.
    """

    port: str = ""
    settings: dict[str, str] = {}
    frame_mb: float = 60.0
    answer_s: float = 30.0
    keep_on_card: bool = True


class MicroManagerSettings(Struct, frozen=True, forbid_unknown_fields=True, tag_field="backend", tag="micromanager"):
    """A camera that Micro-Manager has a device adapter for.

    Parameters
    ----------
    configuration : str
        Micro-Manager's .cfg file; without it, the demonstration camera's.
    adapters : str
        Folder of the device adapters; without it, where pymmcore-plus finds them.
    properties : dict
        Of the camera, set when it is opened, such as `Binning = "1"`.
    answer_s : float
        How long the camera may take for anything besides exposing.
    mosaic : tuple of str, optional
        Rows of one period of the colour filters, such as `["RG", "GB"]`; without it, none.
    """

    configuration: str = ""
    adapters: str = ""
    properties: dict[str, str] = {}
    answer_s: float = 20.0
    mosaic: Mosaic | None = None


class FolderSettings(Struct, frozen=True, forbid_unknown_fields=True, tag_field="backend", tag="folder"):
    """Any vendor's program, which saves a file into a folder for each frame.

    Parameters
    ----------
    folder : str
        Where the files appear. They stay there; the session has copies.
    suffixes : tuple of str
        Which files are frames.
    frame_mb : float
        Room for one file.
    arrival_s : float
        How long after the exposure the file may take to be complete.
    mosaic : tuple of str, optional
        As above; raw files say it themselves.
    """

    folder: str
    suffixes: tuple[str, ...] = (".tif", ".tiff", ".png", ".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf")
    frame_mb: float = 60.0
    arrival_s: float = 60.0
    mosaic: Mosaic | None = None

    def __post_init__(self) -> None:
        if not Path(self.folder).name:
            raise ValueError(f"camera.folder = {self.folder!r} names no folder; give the one that files appear in")


class SimulatedSettings(Struct, frozen=True, forbid_unknown_fields=True, tag_field="backend", tag="simulated"):
    """The paper's camera and scene, rendered where the simulated stage truly is.

    Parameters
    ----------
    size_px : (int, int)
        Width and height of a frame.
    lit_photons_per_s, unlit_photons_per_s : float
        On a pixel that sees a white object, with the lights on and almost off.
    read_noise_e, gain_dn_per_e, saturation_dn : float, float, int
        Of the sensor; the paper's without them.
    mosaic : tuple of str, optional
        Rows of one period of the colour filters, such as `["RG", "GB"]`; without it, none.
    position_error_mm, rotation_error_mrad : float
        By how much the rails have the camera elsewhere than the motors are, on each axis: standard deviation.
    scale_error, squareness_mrad : float
        Of the stage: by which part of itself a way along x is too long, and by how much y is askew.
    seed : int
        Of all chance.
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
        if self.gain_dn_per_e <= 0 or min(self.read_noise_e, self.position_error_mm, self.rotation_error_mrad) < 0:
            raise ValueError("camera: a gain is positive, and read noise and errors are not negative; correct them")
        if self.mosaic is not None and (not self.mosaic or set("".join(self.mosaic)) - set("RGB")):
            raise ValueError(f"camera.mosaic = {list(self.mosaic)}; give rows of the letters R, G and B")


type CameraSettings = GPhoto2Settings | MicroManagerSettings | FolderSettings | SimulatedSettings
