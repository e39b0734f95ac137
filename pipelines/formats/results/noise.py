"""The record of a sensor's noise, `noise.json`, its maps, and both as a reconstruction takes them."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from zipfile import ZipFile

import msgspec
import numpy as np
from msgspec import UNSET, Struct, UnsetType
from numpy.lib.format import write_array
from numpy.typing import NDArray

from faintfield.calib.estimate import Estimate, SeriesGoodness
from faintfield.calib.noise_model import BentResponse, NoiseModel
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.files import (
    exclusive,
    files_named,
    remove,
    sha256,
    write_record,
    write_whole,
    writing,
)
from faintfield.pipelines.formats.frames import at_phase
from faintfield.pipelines.formats.provenance import Provenance
from faintfield.pipelines.formats.reading import is_file, read_arrays, read_json
from faintfield.pipelines.formats.units import sound_mosaic

NOISE_FILE, NOISE_MAPS, NOISE_PAGE = "noise.json", "noise_maps.npz", "noise.html"

# Patterns of the names of its pages; all but the first are of earlier versions.
NOISE_PAGES = (NOISE_PAGE, "emva1288_report.html", "noise_page.png", "noise_page_*_r*c*.png")

STANDARD = "EMVA 1288 release 4.0"

# The quantities that a reconstruction needs.
_NEEDED = ("offset_dn", "gain_dn_per_e", "read_noise_e", "dark_current_e_per_s")

# The maps that it takes, and how many, of 8 bytes a pixel, are written at most.
_MAPS_TAKEN, _MAPS_WRITTEN = (*_NEEDED, "mask", "relative_response"), 12


class ResponseRecord(Struct, frozen=True):
    """Bend of the response: the charge behind a signal of s DN is (s/g)(1 + κ₁ s + κ₂ s² + …).

    Attributes
    ----------
    bends_per_dn : list of float
        Coefficients κ₁ in 1/DN, κ₂ in 1/DN² and so on.
    up_to_dn : float
        Signal up to which the bend was measured.
    """

    bends_per_dn: list[float]
    up_to_dn: float


class SaturationRecord(Struct, frozen=True):
    """End of the range of the flats, and its reason.

    Attributes
    ----------
    limit : {"ADC", "full well", "not reached"}
        Cause of the end: the converter, or the full well of the pixels. "not reached": no flat saturates.
    level_dn : float, optional
        Last value of the converter, or mean of the noisiest series at a full well; null if the end is not reached.
    interval_dn : (float, float), optional
        Lower and upper bound of the level: at a full well, the means of the series next to the noisiest one.
    """

    limit: Literal["ADC", "full well", "not reached"]
    level_dn: float | None
    interval_dn: tuple[float, float] | None


class FitRecord(Struct, frozen=True):
    """Saturation and response from the flats, how far series scatter about the model, and how well each fits.

    Attributes
    ----------
    saturation : SaturationRecord
        End of the range of the flats.
    saturation_e : Estimate
        Saturation capacity μ_e.sat.
    linearity_error : Estimate
        Linearity error LE: mean absolute deviation of the response from a straight line, as a fraction.
    response : ResponseRecord, optional
        Bend of the response; null if it is straight or not known.
    noise_error : Estimate
        Scatter of the noise of the series about the model, as a fraction of the variance.
    drift_dn : Estimate
        Scatter of the mean levels of the darks about a straight line over exposure time.
    light_error : Estimate
        Scatter of the mean levels of the flats about the response, as a fraction of the level.
    lamp_flicker : Estimate
        Scatter of the light from frame to frame within a series, as a fraction.
    series : list of SeriesGoodness
        Goodness of fit of each series, and the reason for each that was left out.
    telegraph_pixels : int
        Number of pixels that jump between two levels.
    maps_absent : dict of str
        Reason why there is no map of the gain or of the read noise, by the name of the map.
    """

    saturation: SaturationRecord
    saturation_e: Estimate
    linearity_error: Estimate
    response: ResponseRecord | None
    noise_error: Estimate
    drift_dn: Estimate
    light_error: Estimate
    lamp_flicker: Estimate
    series: list[SeriesGoodness]
    telegraph_pixels: int = 0
    maps_absent: dict[str, str] = {}


class EmvaImageRecord(Struct, frozen=True):
    """Series whose mean image gives DSNU or PRNU.

    Attributes
    ----------
    exposure_s : float
        Exposure time of the series.
    level : int
        Index of the light level; 0 for darks.
    frames : int
        Number of frames.
    signal_dn : float
        Mean signal: above the offset for a dark, above the dark image for a flat.
    """

    exposure_s: float
    level: int
    frames: int
    signal_dn: float


class EmvaRecord(Struct, frozen=True):
    """Quantities of EMVA 1288 that follow from others, or from one mean image (docs/explanation/noise.md).

    Attributes
    ----------
    dark_noise_exposure_s : float
        Exposure time for which the dark noise and the thresholds hold; 0 is an extrapolation.
    dark_noise_e : Estimate
        Temporal dark noise σ_d, without that of rounding.
    responsivity_dn_per_photon : Estimate
        Responsivity R = K η.
    threshold_e, threshold_photons : Estimate
        Absolute sensitivity threshold μ_e.min, at which SNR = 1; that threshold in photons, μ_p.min.
    saturation_photons : Estimate
        Saturation capacity in photons, μ_p.sat.
    snr_max : Estimate
        Largest signal-to-noise ratio of a pixel, SNR_max = √μ_e.sat.
    dynamic_range : Estimate
        Dynamic range DR = μ_p.sat/μ_p.min.
    dsnu_total_e, dsnu_row_e, dsnu_column_e, dsnu_pixel_e : Estimate
        DSNU of the dark image; row part of DSNU; column part of DSNU; pixel part of DSNU.
    prnu_total, prnu_row, prnu_column, prnu_pixel : Estimate
        PRNU of the bright image, as a fraction; row part of PRNU; column part of PRNU; pixel part of PRNU.
    dark_current_doubling_k : Estimate
        Temperature difference T_d in kelvin that doubles the dark current.
    dark_image, bright_image : EmvaImageRecord, optional
        Series of darks from which DSNU follows; series of flats from which PRNU follows.
    """

    dark_noise_exposure_s: float
    dark_noise_e: Estimate
    responsivity_dn_per_photon: Estimate
    threshold_e: Estimate
    threshold_photons: Estimate
    saturation_photons: Estimate
    snr_max: Estimate
    dynamic_range: Estimate
    dsnu_total_e: Estimate
    dsnu_row_e: Estimate
    dsnu_column_e: Estimate
    dsnu_pixel_e: Estimate
    prnu_total: Estimate
    prnu_row: Estimate
    prnu_column: Estimate
    prnu_pixel: Estimate
    dark_current_doubling_k: Estimate
    dark_image: EmvaImageRecord | None
    bright_image: EmvaImageRecord | None


class NoiseFrame(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """One frame, as noise.toml and noise.json name it.

    Parameters
    ----------
    file : str
        Name of the image.
    kind : {"dark", "flat"}
        Kind of the frame: a dark has the lens covered, a flat is evenly lit.
    exposure_s : float, optional
        Exposure time; that of a raw file may come from its EXIF.
    temperature_c : float, optional
        Temperature of the sensor.
    level : int
        Index of the light level of a flat.
    photons : float, optional
        Mean photons per pixel and exposure, if measured by a radiometer.
    """

    file: str
    kind: Literal["dark", "flat"]
    exposure_s: float | None = None
    temperature_c: float | None = None
    level: int = 0
    photons: float | None = None


_NOT_STATED = Estimate(None, why="not stated")


class Quantities(Struct, frozen=True, kw_only=True):
    """Measurements of a sensor, or of one phase of its colour filter mosaic.

    A reconstruction needs the first four. Only noise.json files that were written by hand lack any of the others.

    Attributes
    ----------
    offset_dn : Estimate
        Mean of a dark frame of zero exposure, μ_y.dark in EMVA 1288.
    gain_dn_per_e : Estimate
        Overall system gain K.
    read_noise_e : Estimate
        Standard deviation of the read noise of a pixel, σ_d at zero exposure, without that of rounding.
    dark_current_e_per_s : Estimate
        Dark current μ_I, mean over the pixels.
    read_noise_dn : Estimate
        The read noise in DN, before the gain is divided out.
    dark_signal_dn_per_s : Estimate
        Growth of the dark level with exposure time, K μ_I.
    dsnu_dn, dsnu_e : Estimate
        Pixel part of DSNU: standard deviation of the offset over the pixels.
    dcnu_e_per_s : Estimate
        Standard deviation of the dark current over the pixels.
    frame_jitter_dn : Estimate
        Standard deviation of the level from frame to frame.
    row_noise_dn, column_noise_dn : Estimate
        Noise that the pixels of a row share in one frame; noise that the pixels of a column share in one frame.
    dsnu_row_dn, dsnu_column_dn : Estimate
        Row part of DSNU, the same in all frames; column part of DSNU, the same in all frames.
    prnu : Estimate
        Pixel part of PRNU: standard deviation of the response to light over the pixels, as a fraction.
    nonlinearity_per_dn : Estimate
        First coefficient κ₁ of the bend of the response: the charge behind a signal s is (s/K)(1 + κ₁ s + …).
    quantum_efficiency : Estimate or float, optional
        Quantum efficiency η, electrons per photon.
    """

    offset_dn: Estimate
    gain_dn_per_e: Estimate
    read_noise_e: Estimate
    dark_current_e_per_s: Estimate
    read_noise_dn: Estimate = _NOT_STATED
    dark_signal_dn_per_s: Estimate = _NOT_STATED
    dsnu_dn: Estimate = _NOT_STATED
    dsnu_e: Estimate = _NOT_STATED
    dcnu_e_per_s: Estimate = _NOT_STATED
    frame_jitter_dn: Estimate = _NOT_STATED
    row_noise_dn: Estimate = _NOT_STATED
    column_noise_dn: Estimate = _NOT_STATED
    dsnu_row_dn: Estimate = _NOT_STATED
    dsnu_column_dn: Estimate = _NOT_STATED
    prnu: Estimate = _NOT_STATED
    nonlinearity_per_dn: Estimate = _NOT_STATED
    quantum_efficiency: Estimate | float | None = _NOT_STATED


class PhaseRecord(Quantities, frozen=True):
    """One phase of the mosaic: its place, its filter, and its quantities.

    Attributes
    ----------
    phase : (int, int)
        Row and column of the first pixel of the phase.
    colour : str
        Letter of the filter, such as "R".
    likelihood : str
        Name of the likelihood that was maximised.
    masked_black_dn : float, optional
        Black level that the files of the darks state, mean over the frames; null if they state none.
    fit, emva1288 : FitRecord, EmvaRecord
        Scatter about the model and goodness of fit; quantities of EMVA 1288 that follow.
    """

    phase: tuple[int, int]
    colour: str
    likelihood: str
    masked_black_dn: float | None
    fit: FitRecord | UnsetType = UNSET
    emva1288: EmvaRecord | UnsetType = UNSET


class CovarianceRecord(Struct, frozen=True):
    """Covariance of estimates.

    Attributes
    ----------
    names : list of str
        Names of the quantities.
    matrix : list of list of float
        Covariance of the quantities (quantity, quantity), in the products of their units.
    """

    names: list[str]
    matrix: list[list[float]]


class TemperatureRange(Struct, frozen=True):
    """Temperature of the sensor over the frames that state it, in °C.

    Attributes
    ----------
    mean, min, max : float
        Mean temperature; lowest temperature; highest temperature.
    """

    mean: float
    min: float
    max: float


# A class of its own because msgspec puts keyword-only fields after all others: these two come before the quantities.
class _StandardQuantities(Quantities, frozen=True):
    format: Literal[1] = 1
    standard: str = STANDARD


class NoiseRecord(_StandardQuantities, frozen=True, kw_only=True):
    """`noise.json`: the sensor's quantities (the mean over phases where there is a mosaic) and how they were measured.

    Pixels are (row, column). `mosaic` and `planes`, one entry per phase, are left out without colour filters; with
    them, each plane has its own `fit` and `emva1288`. Older files have none.

    Attributes
    ----------
    format : 1
        Version of the format.
    standard : str
        Standard whose names, symbols and units are used.
    covariance : CovarianceRecord
        Covariance of offset, gain, read noise and dark current, as far as they have values.
    likelihood : str
        Name of the likelihood that was maximised; with a mosaic, the names of all phases.
    saturation_dn : Estimate or float, optional
        Value from which a pixel is saturated, stated or found; with a mosaic, that of the phase that saturates first.
    size_px : (int, int), optional
        Width and height of the frames.
    mosaic : tuple of str, optional
        Rows of the smallest period of the colour filters, such as ["RG", "GB"].
    planes : list of PhaseRecord
        Measurements of each phase of the mosaic.
    hot_pixels : list of (int, int)
        Pixels [row, column] whose dark signal stands out.
    noisy_pixels : list of (int, int)
        Pixels [row, column] whose noise is far above the usual.
    dead_pixels : list of (int, int)
        Pixels [row, column] that respond to light by less than half of what their neighbours do.
    temperature_c : TemperatureRange, optional
        Temperature of the sensor; null if no frame states it.
    frames : list of NoiseFrame
        Frames of the set.
    warnings : list of str
        Problems of the frames.
    maps, maps_sha256 : str
        Name of the file with the maps per pixel; SHA-256 of that file.
    provenance : Provenance, optional
        Command, options, inputs and versions.
    fit, emva1288 : FitRecord, EmvaRecord
        Scatter about the model and goodness of fit; quantities of EMVA 1288 that follow.
    """

    covariance: CovarianceRecord = CovarianceRecord([], [])
    likelihood: str = ""
    saturation_dn: Estimate | float | None = None
    size_px: tuple[int, int] | None = None
    mosaic: tuple[str, ...] | UnsetType | None = UNSET
    planes: list[PhaseRecord] | UnsetType = UNSET
    hot_pixels: list[tuple[int, int]] = []
    noisy_pixels: list[tuple[int, int]] = []
    dead_pixels: list[tuple[int, int]] = []
    temperature_c: TemperatureRange | None = None
    frames: list[NoiseFrame] = []
    warnings: list[str] = []
    maps: str = NOISE_MAPS
    maps_sha256: str = ""
    provenance: Provenance[dict[str, object]] | None = None
    fit: FitRecord | UnsetType = UNSET
    emva1288: EmvaRecord | UnsetType = UNSET


def read_noise(path: Path) -> NoiseRecord:
    """Read noise.json."""
    return read_json(path, NoiseRecord, what="the result of `faintfield noise`", remedy="run that again")


def write_noise(out: Path, record: NoiseRecord, maps: Iterable[tuple[str, NDArray[Any]]], page: str) -> NoiseRecord:
    """Write noise.json, its maps (row, column) one by one and its page; return it with the maps' hash.

    Pages of an earlier result are removed.

    noise.json is written last: where it stands, everything that it names stands too.
    """
    with exclusive(out):
        remove(out / NOISE_FILE)
        with writing(out / NOISE_MAPS) as file:
            # As numpy.savez does, which takes all at once; noise hardly shrinks, and compression would take minutes
            with ZipFile(file, "w") as members:
                for name, values in maps:
                    with members.open(f"{name}.npy", "w", force_zip64=True) as member:
                        write_array(member, values, allow_pickle=False)
        for earlier in files_named(out, NOISE_PAGES):
            remove(earlier)
        write_whole(out / NOISE_PAGE, page)
        record = msgspec.structs.replace(record, maps_sha256=sha256(out / NOISE_MAPS))
        write_record(out / NOISE_FILE, record)
    return record


@dataclass(frozen=True)
class FittedNoise:
    """Noise model of a sensor from a calibration, with a map (row, column) of each quantity that has one.

    `unusable` are hot, noisy and dead pixels. `response` is the relative photo response, vignetting included; None when
    there were no flats. `mosaic` has the colour filters of the frames that were measured.
    """

    model: NoiseModel
    unusable: NDArray[np.bool_]
    response: NDArray[np.float32] | None
    mosaic: tuple[str, ...] | None = None


def read_fitted_noise(path: Path, size_px: tuple[int, int]) -> FittedNoise:
    """Read `noise.json`, and `noise_maps.npz` when it lies beside it.

    Raises BadValue if one is another camera's or not the one that is named, or if a number that a reconstruction needs
    is not known or out of its range.
    """
    record = read_noise(path)
    numbers: dict[str, Any] = {**_numbers(path, record)}
    shape = size_px[::-1]
    for row, column in record.hot_pixels:
        if not (0 <= row < shape[0] and 0 <= column < shape[1]):
            raise BadValue(
                f"{path}: hot pixel [{row}, {column}] is not one of {shape}, as of another camera; measure this one"
            )
    if record.mosaic and not sound_mosaic(record.mosaic, "RGB"):
        raise BadValue(f"{path}: mosaic = {list(record.mosaic)} is no colour filter; run `faintfield noise` again")
    unusable = np.zeros(shape, bool)
    unusable[tuple(np.array(record.hot_pixels, int).reshape(-1, 2).T)] = True
    maps = read_maps(path.with_name(NOISE_MAPS), record, shape)
    unusable |= maps.pop("mask", np.False_).astype(bool)
    response = maps.pop("relative_response", None)
    if response is not None:
        # Pixels with no response are masked already; the operator takes no negative one
        response = np.where(unusable, 1, np.maximum(response, 0)).astype(np.float32)
        if not np.isfinite(response).all():
            raise BadValue(f"{path}: relative_response of {NOISE_MAPS} is not finite; run `faintfield noise` again")
    numbers |= maps
    for name in ("quantum_efficiency", "saturation_dn"):
        value = getattr(record, name)
        value = value.value if isinstance(value, Estimate) else value  # written with or without its error
        if value is not None:
            numbers[name] = value
    try:
        model = NoiseModel(**numbers, response=_response(record, shape))
    except ValueError as failure:
        raise BadValue(f"{path}: it or its maps: {failure}; run `faintfield noise` again") from failure
    return FittedNoise(model, unusable, response, record.mosaic or None)


def _response(record: NoiseRecord, shape: tuple[int, int]) -> BentResponse | None:
    """Return the bend of the response, as maps (row, column) where there is a mosaic; None for a linear sensor."""
    if record.fit and record.fit.response:
        return BentResponse(tuple(record.fit.response.bends_per_dn), record.fit.response.up_to_dn)
    planes = record.planes or []
    bent = [plane.fit.response for plane in planes if plane.fit and plane.fit.response]
    if not bent or not record.mosaic:
        return None
    period = len(record.mosaic), len(record.mosaic[0])
    bends = [np.zeros(shape) for _ in range(max(len(response.bends_per_dn) for response in bent))]
    up_to_dn = np.full(shape, max(response.up_to_dn for response in bent))
    for plane in planes:
        if plane.fit and plane.fit.response:
            at_phase(up_to_dn, plane.phase, period)[...] = plane.fit.response.up_to_dn
            for bend, value in zip(bends, plane.fit.response.bends_per_dn, strict=False):
                at_phase(bend, plane.phase, period)[...] = value
    return BentResponse(tuple(bends), up_to_dn)


def _numbers(path: Path, record: NoiseRecord) -> dict[str, float]:
    """Return the numbers that a reconstruction needs; an unknown dark current counts as none."""
    values: dict[str, float] = {}
    for name in _NEEDED:
        estimate: Estimate = getattr(record, name)
        values[name], why = estimate.value or 0.0, estimate.why or "no reason stated"
        if estimate.value is None and name != "dark_current_e_per_s":
            raise BadValue(f"{path}: {name} is not known ({why}); record what it names, or state [noise] yourself")
        if estimate.value is None:
            inform(f"{path}: {name} is not known ({why}); 0 is taken, which is right for short exposures only")
    # An estimate near zero may fall below it; a dark current cannot.
    values["dark_current_e_per_s"] = max(values["dark_current_e_per_s"], 0.0)
    return values


def read_maps(
    path: Path, record: NoiseRecord, shape: tuple[int, int], names: Collection[str] = _MAPS_TAKEN
) -> dict[str, Any]:
    """Return the maps (row, column) that the file has, of those named; none without a file."""
    if not is_file(path):
        return {}
    remedy = "run `faintfield noise` again for this camera"
    maps = read_arrays(path, names, shape=shape, max_bytes=_MAPS_WRITTEN * 8 * shape[0] * shape[1], remedy=remedy)
    if record.maps_sha256 and sha256(path) != record.maps_sha256:
        raise BadValue(f"{path}: is not the file that {NOISE_FILE} names by its SHA-256; run `faintfield noise` again")
    return maps
