"""Parts of `noise.json`: the goodness of fit (saturation, response, scatter), and figures of merit of EMVA 1288."""

from typing import Literal

from msgspec import Struct

from faintfield.calib.estimate import Estimate

# A number as the file has it: with its standard error and 95 % interval, or the reason why there is none.
Measured = Estimate


class ResponseRecord(Struct, frozen=True):
    """The bend of the response: a signal of s DN is the charge (s/g)(1 + κ₁ s + κ₂ s² + …), κ₁ in 1/DN and so on."""

    bends_per_dn: list[float]
    up_to_dn: float


class SaturationRecord(Struct, frozen=True):
    """End of the range of the flats, and its reason."""

    limit: Literal["ADC", "full well", "not reached"]
    level_dn: float | None
    interval_dn: tuple[float, float] | None


class GoodnessRecord(Struct, frozen=True, omit_defaults=True):
    """Goodness of fit of one series, or the reason why it was left out.

    `noise_excess` is its variance over the model's, minus 1, with the error `noise_se` of Gaussian noise; the deviances
    of blocks of pixels, rows, columns and frames are per degree of freedom, 1 where the noise is Gaussian.
    """

    kind: Literal["dark", "flat"]
    exposure_s: float
    level: int
    frames: int
    left_out: str | None = None
    noise_excess: float | None = None
    noise_se: float | None = None
    level_residual_dn: float | None = None
    blocks: float | None = None
    rows: float | None = None
    columns: float | None = None
    by_frame: float | None = None


class FitRecord(Struct, frozen=True):
    """Saturation and response from the flats, how far series scatter about the model, and how well each fits.

    `telegraph_pixels` is how many jump between two levels; `maps_absent` tells why there is no map of the gain per
    pixel, or of the read noise.
    """

    saturation: SaturationRecord
    saturation_e: Measured
    linearity_error: Measured
    response: ResponseRecord | None
    noise_error: Measured
    drift_dn: Measured
    light_error: Measured
    lamp_flicker: Measured
    series: list[GoodnessRecord]
    telegraph_pixels: int = 0
    maps_absent: dict[str, str] = {}


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
