"""Goodness of fit of a sensor's frames: the part of `noise.json` about saturation, response and scatter."""

from typing import Literal

from msgspec import Struct


class Measured(Struct, frozen=True, omit_defaults=True):
    """A measured number with its standard error and 95 % interval, or the reason why there is none."""

    value: float | None
    se: float | None = None
    ci95: tuple[float, float] | None = None
    why: str | None = None


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
