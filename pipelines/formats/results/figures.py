"""Records of figures: a set at a glance (`overview.json`), and the errors of planes (`metrics.json`)."""

from typing import Literal

from msgspec import UNSET, Struct, UnsetType

from faintfield.pipelines.formats.results.records import Method, Poses
from faintfield.pipelines.formats.units import StatedUnits

OVERVIEW_FILE = "overview.json"
METRICS_FILE = "metrics.json"


class Brightness(Struct, frozen=True):
    """The SNR and photon figures of a set's reference view; light is in the units of the overview.

    Null stands for what is not known, or has no meaning.

    Attributes
    ----------
    region : str
        Region of the view that was measured.
    noise_from : str
        Source of the noise power: the noise reference, or the noise model.
    snr : float, optional
        Signal-to-noise ratio of eq. (4), a ratio of powers.
    electrons_linear, electrons_from_moments : float, optional
        Electrons per pixel by eq. (7), linear in the SNR; electrons per pixel of a uniform object with this SNR.
    mean_signal_e : float
        Mean signal per pixel of the region, above the dark signal.
    photons_linear, photons_from_moments : float, optional
        Photons per pixel by eq. (7), linear in the SNR; photons per pixel of a uniform object with this SNR.
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
    """`overview.json`: a set at a glance, beside its pictures.

    Attributes
    ----------
    units : StatedUnits, optional
        Units of the set.
    set : str
        Name of the folder of the set.
    views : int
        Number of views.
    grid : (int, int), optional
        Rows and columns of the nodes; null if the views are in no grid.
    poses : {"stated", "measured", "aligned", "nominal", "true"}
        Source of the poses.
    size_px : (int, int)
        Width and height of a view.
    exposure_s : float, optional
        Exposure time of a view, all its frames together; null if it is not known.
    frames_per_view : int
        Number of frames of a view.
    read_noise_e : float
        Read noise of a frame, rms over the pixels.
    has_noise_reference : bool
        True if the set has frames without light.
    quantum_efficiency : float, optional
        Quantum efficiency, electrons per photon; null if it is not known.
    dark_e : float
        Mean dark signal of a view per pixel.
    grey_scale_dn : (float, float)
        Values of a pixel that the pictures show as black and as white.
    whole_dn : bool
        True if the pixels of the reference view are whole numbers.
    tone : {"srgb"}, optional
        Tone curve of the pictures; absent if they are linear in light.
    brightness : Brightness
        Light of the reference view.
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

    Attributes
    ----------
    depth_mm : float
        Depth of the plane.
    method : str
        Method of the reconstruction.
    prior : str, optional
        Prior, or penalty, of the plane; absent if nothing is penalised.
    poses : {"stated", "measured", "aligned", "nominal", "true"}
        Source of the poses.
    object : str
        Name of the object at this depth.
    mse_bright : float
        Mean square error in the object region, against the back-projection of the views without noise.
    mse_texture : float
        Mean square error in the object region, against the true texture.
    mse_plane : float, optional
        Mean square error over the whole plane, against the true texture.
    psnr_db : float, optional
        Peak signal-to-noise ratio that follows from `mse_bright`.
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
    """Signal-to-noise ratio of eq. (4), a ratio of powers.

    Attributes
    ----------
    asked, measured : float, optional
        Expected SNR of the true light; measured SNR of the reference view.
    """

    asked: float
    measured: float | None


class PhotonsRecord(Struct, frozen=True):
    """True photons per pixel of the reference view, by three definitions.

    Attributes
    ----------
    linear, from_moments : float
        Photons by eq. (7), linear in the SNR; photons of a uniform object with the same SNR.
    on_object : float
        Mean number of photons over the object region.
    """

    linear: float
    from_moments: float
    on_object: float


class GeometryErrors(Struct, frozen=True):
    """Errors of the measured poses.

    Attributes
    ----------
    nodes : int
        Number of nodes that were compared.
    centre_rms_mm, centre_rms_axes_mm : float, tuple of float
        Distance of the measured from the true centres of the cameras, rms; rms along x, y and z.
    rotation_rms_mdeg : float
        Angle between measured and true orientation in thousandths of a degree, rms.
    """

    nodes: int
    centre_rms_mm: float
    centre_rms_axes_mm: tuple[float, float, float]
    rotation_rms_mdeg: float


class KnownValue(Struct, frozen=True):
    """A measured number with its truth.

    Attributes
    ----------
    value, se : float, optional
        Measured value; standard error of `value`.
    truth : float
        True value.
    """

    value: float | None
    se: float | None
    truth: float


class Metrics(Struct, frozen=True, kw_only=True):
    """`metrics.json`: the errors of planes whose truth is known; a demo adds those of its calibration.

    Attributes
    ----------
    geometry : GeometryErrors, optional
        Errors of the measured poses.
    noise : dict of KnownValue, optional
        Measured and true numbers of the sensor, by name.
    planes : list of PlaneErrors
        Errors of each plane.
    units : StatedUnits, optional
        Units of the set.
    snr : SnrRecord, optional
        Signal-to-noise ratio of the set.
    photons_per_px : PhotonsRecord, optional
        Photons per pixel of the set.
    """

    geometry: GeometryErrors | UnsetType = UNSET
    noise: dict[str, KnownValue] | UnsetType = UNSET
    planes: list[PlaneErrors]
    units: StatedUnits | UnsetType = UNSET
    snr: SnrRecord | UnsetType = UNSET
    photons_per_px: PhotonsRecord | UnsetType = UNSET
