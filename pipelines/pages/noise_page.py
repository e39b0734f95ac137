"""The page `noise.html`: quantities of a sensor, the fit that they come from, maps, and the report by EMVA 1288."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from faintfield.calib.noise import Estimate
from faintfield.calib.noise.likelihood.rounding import ROUNDING_DN2
from faintfield.pipelines.calibration.noise import SensorCalibration
from faintfield.pipelines.calibration.noise_emva import EmvaMeasurement
from faintfield.pipelines.formats.results.noise import STANDARD, NoiseRecord
from faintfield.pipelines.pages.calibration_pages import NOISE_QUANTITIES
from faintfield.pipelines.pages.noise_plots import emva_drawings, fit_drawings
from faintfield.pipelines.pages.page import Quantity, Row, estimate_row, html_symbols, template
from faintfield.pipelines.pages.pixel_maps import map_drawings

# Groups of lines by title. First those that matter most and how far the frames keep to the model, then EMVA 1288.
_VALUES: dict[str, tuple[Quantity, ...]] = {
    "The sensor": (
        *NOISE_QUANTITIES[:5],
        Quantity("saturation_e", "saturation capacity (full well, or end of the converter)", "e⁻", symbol="μ_e.sat"),
        *NOISE_QUANTITIES[5:],
        Quantity("frame_jitter_dn", "whole frames jitter by", "DN"),
        Quantity("row_noise_dn", "rows of a frame jitter by", "DN"),
        Quantity("column_noise_dn", "columns of a frame jitter by", "DN"),
    ),
    "Scatter of the series about the model, beyond chance": (
        Quantity("noise_error", "noise of a series, in variance", "%", factor=100.0),
        Quantity("drift_dn", "dark level of a series", "DN"),
        Quantity("light_error", "level of a series of flats", "%", factor=100.0),
    ),
}
_EMVA: dict[str, tuple[Quantity, ...]] = {
    "Sensitivity": (
        Quantity("quantum_efficiency", "quantum efficiency", "%", symbol="η", factor=100.0),
        Quantity("gain_dn_per_e", "system gain", "DN/e⁻", symbol="K"),
        Quantity("gain_e_per_dn", "inverse of the gain", "e⁻/DN", symbol="1/K"),
        Quantity("responsivity_dn_per_photon", "responsivity", "DN/photon", symbol="R"),
    ),
    "Temporal dark noise": (
        Quantity("read_noise_e", "read noise: at zero exposure", "e⁻", symbol="σ_d(0)"),
        Quantity("dark_noise_e", "dark noise: at the exposure stated above", "e⁻", symbol="σ_d"),
        Quantity("read_noise_dn", "read noise, without rounding", "DN", symbol="K σ_d(0)"),
        Quantity("dark_noise_dn", "read noise, with rounding", "DN", symbol="σ_y.dark(0)"),
    ),
    "Range": (
        Quantity("threshold_photons", "absolute sensitivity threshold", "photons", symbol="μ_p.min"),
        Quantity("threshold_e", "absolute sensitivity threshold", "e⁻", symbol="μ_e.min"),
        Quantity("saturation_photons", "saturation capacity", "photons", symbol="μ_p.sat"),
        Quantity("saturation_e", "saturation capacity", "e⁻", symbol="μ_e.sat"),
        Quantity("snr_max", "largest signal-to-noise ratio", "", symbol="SNR_max"),
        Quantity("dynamic_range", "dynamic range", "", symbol="DR"),
    ),
    "Nonuniformity": (
        Quantity("dsnu_total_e", "dark signal, all", "e⁻", symbol="DSNU"),
        Quantity("dsnu_total_dn", "dark signal, all", "DN", symbol="DSNU"),
        Quantity("dsnu_row_e", "its row part", "e⁻", symbol="DSNU.row"),
        Quantity("dsnu_column_e", "its column part", "e⁻", symbol="DSNU.col"),
        Quantity("dsnu_pixel_e", "its pixel part", "e⁻", symbol="DSNU.pixel"),
        Quantity("prnu_total", "response to light, all", "%", symbol="PRNU", factor=100.0),
        Quantity("prnu_row", "its row part", "%", symbol="PRNU.row", factor=100.0),
        Quantity("prnu_column", "its column part", "%", symbol="PRNU.col", factor=100.0),
        Quantity("prnu_pixel", "its pixel part", "%", symbol="PRNU.pixel", factor=100.0),
    ),
    "Linearity": (
        Quantity(
            "linearity_error", "mean deviation of the fitted response from a line", "%", symbol="LE", factor=100.0
        ),
    ),
    "Dark current": (
        Quantity("dark_current_e_per_s", "dark current", "e⁻/s", symbol="μ_I"),
        Quantity("dark_current_doubling_k", "temperature difference that doubles it", "K", symbol="T_d"),
    ),
}

# Ratios are given in decibels and bits, too.
_RATIOS: dict[str, Callable[[float], float]] = {"dB": lambda ratio: 20 * np.log10(ratio), "bit": np.log2}

# Number of pixels along the longer side of a map, at most: of the only one of its kind, and of one of several phases.
_MAP_PX, _MAP_OF_PHASE_PX = 400, 200


def noise_page(name: str, record: NoiseRecord, sensor: SensorCalibration) -> str:
    """Return the page about a sensor: of a mosaic, every table has columns and every drawing a part for each phase."""
    measured = sensor.phases
    known = [_known(phase) for phase in measured]
    side_px = _MAP_PX if len(measured) == 1 else _MAP_OF_PHASE_PX
    return template("noise.html").render(
        name=name,
        record=record,
        measured=measured,
        values=_table(_VALUES, known),
        emva=_table(_EMVA, known),
        fits=[fit_drawings(phase) for phase in measured],
        maps=[
            list(map_drawings(phase.calibration, lattice, side_px))
            for phase, lattice in zip(measured, sensor.readout.lattices, strict=True)
        ],
        emva_drawings=[emva_drawings(phase) for phase in measured],
        standard=STANDARD,
        sub=html_symbols,
    )


def _known(measured: EmvaMeasurement) -> dict[str, Estimate]:
    """Return the quantities of a phase by name, with some in units of other reports."""
    known = {**measured.calibration.estimates, **measured.estimates}
    gain = known["gain_dn_per_e"].value or 0.0
    return known | {
        "gain_e_per_dn": _mapped(known["gain_dn_per_e"], lambda value: 1 / value),
        "dark_noise_dn": _mapped(known["read_noise_dn"], lambda noise_dn: np.sqrt(noise_dn**2 + ROUNDING_DN2)),
        # DSNU in electrons is that in DN over K, whose own error is not in its interval
        "dsnu_total_dn": _mapped(known["dsnu_total_e"], lambda electrons: electrons * gain),
    }


def _mapped(known: Estimate, function: Callable[[float], float]) -> Estimate:
    """Return a monotonic function of an estimate."""
    if known.value is None:
        return known
    ends = sorted(float(function(end)) for end in known.ci95 or ())
    return Estimate(float(function(known.value)), None, (ends[0], ends[1]) if ends else None)


def _table(
    quantities: Mapping[str, Sequence[Quantity]], known: Sequence[Mapping[str, Estimate]]
) -> list[tuple[str, list[list[Row]]]]:
    """Return the lines of a table in groups by title, each with a cell of every phase."""
    explained: list[dict[str, str]] = [{} for _ in known]  # the quantity that each reason was given for
    groups = []
    for title, lines in quantities.items():
        rows = []
        for quantity in lines:
            key = quantity.key
            versions: dict[str, Callable[[float], float]] = {quantity.unit: float}
            if key in ("snr_max", "dynamic_range") and all(of_phase[key].value is not None for of_phase in known):
                versions |= _RATIOS
            for unit, function in versions.items():
                shown = quantity._replace(unit=unit)
                cells = [estimate_row(_mapped(of_phase[key], function), shown) for of_phase in known]
                rows.append([_explained(cell, of_phase) for cell, of_phase in zip(cells, explained, strict=True)])
        groups.append((title, rows))
    return groups


def _explained(cell: Row, explained: dict[str, str]) -> Row:
    """Return a cell that refers to an earlier one of the same phase with the same reason."""
    if not cell.why:
        return cell
    quantity = f"{cell.name}, {cell.symbol}".removesuffix(", ")
    first = explained.setdefault(cell.why, quantity)
    return cell if first == quantity else cell._replace(why=f"as for {first}")
