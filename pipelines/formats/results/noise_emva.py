"""The part of `noise.json` that the report by EMVA 1288 adds: figures of merit, and the parts of DSNU and PRNU."""

from msgspec import Struct

from faintfield.pipelines.formats.results.noise_fit import Measured


class EmvaImageRecord(Struct, frozen=True):
    """The series whose mean image shows DSNU or PRNU; levels in DN above the dark of zero exposure."""

    exposure_s: float
    level: int
    frames: int
    signal_dn: float


class EmvaRecord(Struct, frozen=True):
    """Quantities of EMVA 1288 that follow from others, or from one mean image; docs/noise.md has the formulas.

    `dark_noise_e` and the thresholds are those of an exposure of `dark_noise_exposure_s`; 0 is by extrapolation.
    """

    dark_noise_exposure_s: float
    dark_noise_e: Measured
    responsivity_dn_per_photon: Measured
    threshold_e: Measured
    threshold_photons: Measured
    saturation_photons: Measured
    snr_max: Measured
    dynamic_range: Measured
    dsnu_total_e: Measured
    dsnu_row_e: Measured
    dsnu_column_e: Measured
    dsnu_pixel_e: Measured
    prnu_total: Measured
    prnu_row: Measured
    prnu_column: Measured
    prnu_pixel: Measured
    dark_current_doubling_k: Measured
    dark_image: EmvaImageRecord | None
    bright_image: EmvaImageRecord | None
