"""The page `emva1288_report.html`: the report of a sensor by EMVA 1288 release 4.0."""

from collections.abc import Callable, Sequence

import numpy as np

from faintfield.calib.noise import Estimate
from faintfield.calib.noise.likelihood.rounding import ROUNDING_DN2
from faintfield.pipelines.calibration.noise_emva import EmvaMeasurement
from faintfield.pipelines.formats.results.noise import STANDARD, NoiseRecord
from faintfield.pipelines.pages.emva_plots import drawings
from faintfield.pipelines.pages.page import Row, fixed, html_symbols, template

EMVA_PAGE = "emva1288_report.html"

_LINEARITY = "mean absolute deviation of the fitted response, 5 to 95 % of saturation"

# Groups of rows by title: name, symbol, words, unit, factor to it.
_TABLE: dict[str, tuple[tuple[str, str, str, str, float], ...]] = {
    "Sensitivity": (
        ("quantum_efficiency", "η", "quantum efficiency", "%", 100.0),
        ("gain_dn_per_e", "K", "system gain", "DN/e⁻", 1.0),
        ("gain_e_per_dn", "1/K", "inverse of it", "e⁻/DN", 1.0),
        ("responsivity_dn_per_photon", "R", "responsivity", "DN/photon", 1.0),
    ),
    "Temporal dark noise": (
        ("read_noise_e", "σ_d(0)", "at zero exposure", "e⁻", 1.0),
        ("dark_noise_e", "σ_d", "at the exposure stated above", "e⁻", 1.0),
        ("read_noise_dn", "K σ_d(0)", "at zero exposure, without rounding", "DN", 1.0),
        ("dark_noise_dn", "σ_y.dark(0)", "at zero exposure, with rounding", "DN", 1.0),
    ),
    "Range": (
        ("threshold_photons", "μ_p.min", "absolute sensitivity threshold", "photons", 1.0),
        ("threshold_e", "μ_e.min", "absolute sensitivity threshold", "e⁻", 1.0),
        ("saturation_photons", "μ_p.sat", "saturation capacity", "photons", 1.0),
        ("saturation_e", "μ_e.sat", "saturation capacity", "e⁻", 1.0),
        ("snr_max", "SNR_max", "largest signal-to-noise ratio", "", 1.0),
        ("dynamic_range", "DR", "dynamic range", "", 1.0),
    ),
    "Nonuniformity": (
        ("dsnu_total_e", "DSNU", "dark signal, all", "e⁻", 1.0),
        ("dsnu_total_dn", "DSNU", "dark signal, all", "DN", 1.0),
        ("dsnu_row_e", "DSNU.row", "its row part", "e⁻", 1.0),
        ("dsnu_column_e", "DSNU.col", "its column part", "e⁻", 1.0),
        ("dsnu_pixel_e", "DSNU.pixel", "its pixel part", "e⁻", 1.0),
        ("prnu_total", "PRNU", "response to light, all", "%", 100.0),
        ("prnu_row", "PRNU.row", "its row part", "%", 100.0),
        ("prnu_column", "PRNU.col", "its column part", "%", 100.0),
        ("prnu_pixel", "PRNU.pixel", "its pixel part", "%", 100.0),
    ),
    "Linearity": (("linearity_error", "LE", _LINEARITY, "%", 100.0),),
    "Dark current": (
        ("dark_current_e_per_s", "μ_I", "dark current", "e⁻/s", 1.0),
        ("dark_current_doubling_k", "T_d", "temperature difference that doubles it", "K", 1.0),
    ),
}

# Ratios are given in decibels and bits, too.
_RATIOS = ("snr_max", "dynamic_range")


def emva_page(name: str, record: NoiseRecord, measured: Sequence[EmvaMeasurement]) -> str:
    """Return the page about a sensor, with one part for each phase of its mosaic."""
    parts = [
        {"name": phase.name, "measured": phase, "groups": _table_of(phase), "drawings": list(drawings(phase))}
        for phase in measured
    ]
    return template("emva1288.html").render(name=name, record=record, parts=parts, standard=STANDARD, sub=html_symbols)


def _table_of(measured: EmvaMeasurement) -> list[tuple[str, list[Row]]]:
    """Return the table in groups; a reason that holds for several quantities is given once."""
    known = {**measured.calibration.estimates, **measured.estimates}
    gain = known["gain_dn_per_e"].value or 0.0
    known |= {
        "gain_e_per_dn": _mapped(known["gain_dn_per_e"], lambda value: 1 / value),
        "dark_noise_dn": _mapped(known["read_noise_dn"], lambda noise_dn: np.sqrt(noise_dn**2 + ROUNDING_DN2)),
        # DSNU in electrons is that in DN over K, whose own error is not in its interval
        "dsnu_total_dn": _mapped(known["dsnu_total_e"], lambda electrons: electrons * gain),
    }
    explained: dict[str, str] = {}
    groups = []
    for title, quantities in _TABLE.items():
        rows = [_row(known[key], row, factor, explained) for key, *row, factor in quantities]
        for key, symbol, words, _, _ in quantities:
            if key in _RATIOS and known[key].value is not None:
                for unit, scale in (("dB", lambda ratio: 20 * np.log10(ratio)), ("bit", np.log2)):
                    rows.append(_row(_mapped(known[key], scale), (symbol, words, unit), 1.0, explained))
        groups.append((title, rows))
    return groups


def _mapped(known: Estimate, function: Callable[[float], float]) -> Estimate:
    """Return a monotonic function of an estimate."""
    if known.value is None:
        return known
    ends = sorted(float(function(end)) for end in known.ci95 or ())
    return Estimate(float(function(known.value)), None, (ends[0], ends[1]) if ends else None)


def _row(known: Estimate, row: Sequence[str], factor: float, explained: dict[str, str]) -> Row:
    """Return a line of the table; `explained` holds the symbol that each reason was given for."""
    symbol, words, unit = row
    if known.value is None:
        why = known.why or "no reason stated"
        first = explained.setdefault(why, symbol)
        return Row(words, symbol=symbol, why=why if first == symbol else f"as for {first}")
    value = known.value * factor
    if known.ci95 is None:
        return Row(words, f"{value:.4g}".replace("-", "−"), "", unit, symbol=symbol)
    # Two digits of half the interval's width
    low, high = known.ci95[0] * factor, known.ci95[1] * factor
    half = (high - low) / 2
    scale = half if half > 0 else 1e-4 * abs(value) or 1.0
    digits = int(np.clip(1 - np.floor(np.log10(scale)), -8, 8))
    low_end, middle, high_end = (fixed(round(number, digits), digits) for number in (low, value, high))
    return Row(words, middle, f"{low_end} … {high_end}", unit, symbol=symbol)
