"""The record of a set at a glance: `overview.json`, with its SNR and photon figures."""

from msgspec import UNSET, Struct, UnsetType

from faintfield.pipelines.formats.results.records import Poses
from faintfield.pipelines.formats.units import StatedUnits

OVERVIEW_FILE = "overview.json"


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
    """`overview.json`: a set at a glance, beside its pictures."""

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
    brightness: Brightness
