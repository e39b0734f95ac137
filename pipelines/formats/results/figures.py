"""Records of figures: a set at a glance (`overview.json`), and the errors of planes (`metrics.json`)."""

from typing import Literal

from msgspec import UNSET, Struct, UnsetType

from faintfield.pipelines.formats.results.records import Method, Poses
from faintfield.pipelines.formats.units import StatedUnits

OVERVIEW_FILE = "overview.json"
METRICS_FILE = "metrics.json"


class Brightness(Struct, frozen=True):
    """The SNR and photon figures of a set's reference view; light is in the units of the overview.

    `snr` is that of eq. (4), a ratio of powers; `electrons_linear` and `electrons_from_moments` are electrons per pixel
    by eq. (7), and of a uniform object with this SNR. None stands for what is not known, or has no meaning.
    """

    region: str
    noise_from: str
    snr: float | None
    electrons_linear: float | None
    electrons_from_moments: float | None
    mean_signal_e: float
    photons_linear: float | None = None
    photons_from_moments: float | None = None


class Overview(Struct, frozen=True, kw_only=True):
    """`overview.json`: a set at a glance, beside its pictures, which are linear in light unless they have a `tone`.

    `grey_scale_dn` are black and white of these; the pixels of the reference view are integers if `whole_dn`.
    """

    units: StatedUnits | UnsetType = UNSET
    set: str
    views: int
    grid: tuple[int, int] | UnsetType | None = UNSET
    poses: Poses = "stated"
    size_px: tuple[int, int]
    exposure_s: float | None
    frames_per_view: int = 1
    read_noise_e: float
    has_noise_reference: bool = False
    quantum_efficiency: float | None = None
    dark_e: float | UnsetType = UNSET
    grey_scale_dn: tuple[float, float] | UnsetType = UNSET
    whole_dn: bool | UnsetType = UNSET
    tone: Literal["srgb"] | UnsetType = UNSET
    brightness: Brightness


class PlaneErrors(Struct, frozen=True, kw_only=True):
    """The errors of one plane against the truth, the object scaled to 0…1.

    `prior` is that of a penalised plane; unset by versions that did not write it.
    """

    depth_mm: float
    method: Method
    prior: str | UnsetType = UNSET
    poses: Poses
    object: str
    mse_bright: float
    mse_texture: float
    mse_plane: float | None = None
    psnr_db: float | None


class SnrRecord(Struct, frozen=True):
    """The SNR of eq. (4): asked of the simulator, and measured."""

    asked: float
    measured: float | None


class PhotonsRecord(Struct, frozen=True):
    """Photons per pixel of the reference view, by three definitions."""

    linear: float
    from_moments: float
    on_object: float


class GeometryErrors(Struct, frozen=True):
    """Errors of the measured poses."""

    nodes: int
    centre_rms_mm: float
    centre_rms_axes_mm: tuple[float, float, float]
    rotation_rms_mdeg: float


class KnownValue(Struct, frozen=True):
    """A measured number, its standard error, and the truth."""

    value: float | None
    se: float | None
    truth: float


class Metrics(Struct, frozen=True, kw_only=True):
    """`metrics.json`: the errors of planes whose truth is known; a demo adds those of its calibration."""

    geometry: GeometryErrors | UnsetType = UNSET
    noise: dict[str, KnownValue] | UnsetType = UNSET
    planes: list[PlaneErrors]
    units: StatedUnits | UnsetType = UNSET
    snr: SnrRecord | UnsetType = UNSET
    photons_per_px: PhotonsRecord | UnsetType = UNSET
