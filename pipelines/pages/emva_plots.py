"""The drawings of the report by EMVA 1288: transfer of light, SNR, dark current, and differences of pixels."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, MaxNLocator
from numpy.typing import NDArray
from scipy.special import erfc

from faintfield.calib.noise.emva.nonuniformity import accumulated_histogram, high_pass, spectrogram
from faintfield.calib.noise.emva.quantities import snr
from faintfield.calib.noise.likelihood.response import known_light
from faintfield.calib.noise.likelihood.rounding import ROUNDING_DN2
from faintfield.pipelines.calibration.noise_emva import EmvaMeasurement, MeanImage
from faintfield.pipelines.pages.page import INK, blank_drawing, ink, math_symbols, svg

# Measured, model, and a second series; distinct without colour vision, and on black as on white.
MEASURED, MODEL, SECOND = "#0072b2", "#d55e00", "#009e73"

# Logarithmic axes over less than this factor have even ticks, not powers of ten.
_FINE_RANGE = 10.0

_NO_FLATS = "there are no flats"

# The caption of a drawing, and the function that draws it; or the reason why there is none.
type _Plot = tuple[str, Callable[[Axes], None]] | str


class Drawing(NamedTuple):
    """One drawing as SVG, or, in `missing`, the reason why there is none."""

    title: str
    caption: str = ""
    picture: str = ""
    missing: str = ""


def drawings(measured: EmvaMeasurement) -> Iterator[Drawing]:
    """Yield the drawings of one phase, in the order of the standard's report."""
    flats = _levels_of(measured, "flat")
    plots: dict[str, _Plot] = {
        "Photon transfer": _photon_transfer(measured, flats),
        "Sensitivity": _sensitivity(measured, flats),
        "Deviation from linearity": _linearity(measured, flats),
        "Signal-to-noise ratio": _snr(measured, flats),
        "Dark current": _dark_signal(measured),
    }
    images = ((measured.dark, "DSNU", "dsnu_total_e", "DN", 1.0), (measured.bright, "PRNU", "prnu_total", "%", 100.0))
    for kind, plot in (("spectrograms", _spectrograms), ("accumulated histogram", _histogram)):
        for image, quantity, name, unit, factor in images:
            missing = measured.estimates[name].why or "there is no image"
            plots[f"{quantity} {kind}"] = plot(measured, image, unit, factor) if image else missing
    for title, plotted in plots.items():
        yield Drawing(title, missing=plotted) if isinstance(plotted, str) else _drawn(title, *plotted)


def _drawn(title: str, caption: str, draw: Callable[[Axes], None]) -> Drawing:
    figure, axes = blank_drawing(5.6, 3.4, None)
    draw(axes)
    # Logarithmic axes have few ticks, with plain numbers: ticks are what takes time in a drawing
    axes.minorticks_off()
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        if axis.get_scale() == "log":
            axis.set_major_locator(MaxNLocator(6) if high < _FINE_RANGE * low else LogLocator())
            axis.set_major_formatter("{x:g}")
    ink(axes)
    axes.set(xlabel=math_symbols(axes.get_xlabel()), ylabel=math_symbols(axes.get_ylabel()))
    if axes.get_legend_handles_labels()[0]:
        legend = axes.legend(frameon=False, labelcolor=INK, fontsize=9)
        for text in legend.get_texts():
            text.set_text(math_symbols(text.get_text()))
    return Drawing(title, caption, svg(figure))


@dataclass(frozen=True)
class _Levels:
    """Mean and variance of the flats or darks of a measurement, arrays (series,), dark ones first by brightness.

    `signal_dn` is above the dark of zero exposure; `kept` marks the series within the range of the sensor.
    """

    signal_dn: NDArray[np.float64]
    variance_dn2: NDArray[np.float64]
    error_dn2: NDArray[np.float64]
    exposure_s: NDArray[np.float64]
    photons: NDArray[np.float64]
    kept: NDArray[np.bool_]


def _levels_of(measured: EmvaMeasurement, kind: str) -> _Levels:
    """Return the levels of all series of a kind; the variance of one that has a single frame is NaN."""
    series = sorted(
        (item for item in measured.series if item.conditions.kind == kind), key=lambda item: item.levels_dn.mean()
    )
    calibration, used = measured.calibration, measured.used
    offset = calibration.estimates["offset_dn"].value or 0.0
    kept = {id(flat) for flat in calibration.saturation.kept}
    pixels = int(used.sum())
    share = max(pixels - sum(used.shape) + 1, 1) / max(pixels, 1)
    freedom = np.array([max((item.frames - 1) * pixels * share, 1) for item in series])
    variance = np.array(
        [
            float(item.within_dn2.mean(where=used)) / ((item.frames - 1) * share) if item.frames > 1 else np.nan
            for item in series
        ]
    )
    return _Levels(
        signal_dn=np.array([item.levels_dn.mean() - offset for item in series]),
        variance_dn2=variance,
        error_dn2=variance * np.sqrt(2 / freedom),
        exposure_s=np.array([item.conditions.exposure_s for item in series]),
        photons=np.array([item.conditions.photons or np.nan for item in series]),
        kept=np.array([kind == "dark" or id(item) in kept for item in series], bool),
    )


def _photon_transfer(measured: EmvaMeasurement, flats: _Levels) -> _Plot:
    """Draw the variance less that of the dark against the signal, with the line of the gain."""
    if not flats.signal_dn.size:
        return _NO_FLATS
    estimates = measured.calibration.estimates
    gain, read_dn = estimates["gain_dn_per_e"].value, estimates["read_noise_dn"].value or 0.0

    def draw(axes: Axes) -> None:
        series = (flats.kept, MEASURED, "o", "flats, ± 2 s.e."), (~flats.kept, SECOND, "x", "left out")
        for mask, colour, mark, label in series:
            if mask.any():
                excess = flats.variance_dn2[mask] - read_dn**2 - ROUNDING_DN2
                error = 2 * flats.error_dn2[mask]
                axes.errorbar(flats.signal_dn[mask], excess, error, fmt=mark, ms=4, color=colour, label=label)
        if gain is not None:  # the variance that the gain and the bend of the response predict
            level, offset = measured.calibration.saturation.level_dn, estimates["offset_dn"].value or 0.0
            brightest = float(np.max(flats.signal_dn, initial=1.0))
            signal = np.linspace(0, brightest if level is None else min(brightest, level - offset), 200)
            variance = gain * _charge_dn(measured, signal) * _slope(measured, signal) ** 2
            axes.plot(signal, variance, color=MODEL, label="model")
        axes.set(xlabel="μ_y − μ_y.dark (DN)", ylabel="σ_y² − σ_y.dark² (DN²)")
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)

    return "Its slope at the origin is the gain K. The dark is that of zero exposure.", draw


def _charge_dn(measured: EmvaMeasurement, signal_dn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return K times the charge behind a signal."""
    response = measured.calibration.response
    return signal_dn if response is None else response.charge_dn(signal_dn)


def _slope(measured: EmvaMeasurement, signal_dn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the growth of the signal with K times the charge, 1 without a bend."""
    step = 1e-3 * float(np.abs(signal_dn).max(initial=1.0))
    grown = _charge_dn(measured, signal_dn + step) - _charge_dn(measured, signal_dn - step)
    return np.asarray(2 * step / np.maximum(grown, 1e-9))


def _light(measured: EmvaMeasurement, flats: _Levels) -> tuple[NDArray[np.float64], str, str] | None:
    """Return the light of the flats with its name and unit, None if it is not known up to one factor."""
    if flats.photons.size and np.isfinite(flats.photons).all():
        return flats.photons, "μ_p", "photons/pixel"
    series = [item for item in measured.series if item.conditions.kind == "flat"]
    if series and len({item.conditions.level for item in series}) == 1 and (known_light(series).group >= 0).all():
        return flats.exposure_s, "exposure", "s"
    return None


def _sensitivity(measured: EmvaMeasurement, flats: _Levels) -> _Plot:
    light = _light(measured, flats)
    if light is None:
        return "neither photons nor several exposures of one light are stated" if flats.signal_dn.size else _NO_FLATS
    amount, name, unit = light
    slope = measured.estimates["responsivity_dn_per_photon"].value if unit != "s" else None

    def draw(axes: Axes) -> None:
        axes.plot(amount[flats.kept], flats.signal_dn[flats.kept], "o", ms=4, color=MEASURED, label="flats")
        if not flats.kept.all():
            axes.plot(amount[~flats.kept], flats.signal_dn[~flats.kept], "x", ms=5, color=SECOND, label="left out")
        if slope is not None:
            ends = np.array([0.0, float(amount[flats.kept].max(initial=0.0))])
            axes.plot(ends, slope * ends, color=MODEL, label="R μ_p, R = K η")
        axes.set(xlabel=f"{name} ({unit})", ylabel="μ_y − μ_y.dark (DN)")
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)

    return "The slope at the origin is the responsivity R.", draw


def _linearity(measured: EmvaMeasurement, flats: _Levels) -> _Plot:
    """Draw the relative deviation of the signal from the straight line of EMVA 1288."""
    light = _light(measured, flats)
    level = measured.calibration.saturation.level_dn
    if light is None or not flats.kept.any():
        return "the light of the flats is not known" if flats.signal_dn.size else _NO_FLATS
    offset = measured.calibration.estimates["offset_dn"].value or 0.0
    full = float(flats.signal_dn[flats.kept].max()) if level is None else level - offset
    current = measured.calibration.estimates["dark_signal_dn_per_s"].value or 0.0
    signal = flats.signal_dn - current * flats.exposure_s
    inside = flats.kept & (signal > 0.05 * full) & (signal < 0.95 * full)
    if inside.sum() < 3:
        return "fewer than 3 levels are within 5 to 95 % of saturation"
    design = np.stack([np.ones(inside.sum()), light[0][inside]], axis=1)
    line = design @ np.linalg.lstsq(design / signal[inside, None], np.ones(inside.sum()))[0]

    def draw(axes: Axes) -> None:
        axes.axhline(0, color=MODEL, lw=1)
        axes.plot(light[0][inside], 100 * (signal[inside] / line - 1), "o-", ms=4, lw=0.8, color=MEASURED)
        axes.set(xlabel=f"{light[1]} ({light[2]})", ylabel="deviation (%)")

    caption = (
        "Of each measured level, its own error included, from the straight line a₀ + a₁ μ_p that minimizes the squares "
        "of relative deviations, within 5 to 95 % of saturation (of the brightest flat, if none is saturated). LE in "
        "the table is the mean of those of the fitted response, which has no errors of single levels."
    )
    return caption, draw


def _snr(measured: EmvaMeasurement, flats: _Levels) -> _Plot:
    """Draw the SNR against photons, or electrons where the photons are not known."""
    gain, noise = measured.calibration.estimates["gain_dn_per_e"], measured.estimates["dark_noise_e"]
    if gain.value is None or noise.value is None:
        return gain.why or noise.why or "no reason stated"
    k, sigma_e = gain.value, noise.value
    efficiency = measured.calibration.estimates["quantum_efficiency"].value
    name, per_e = ("μ_p (photons/pixel)", 1 / efficiency) if efficiency else ("μ_e (e⁻/pixel)", 1.0)
    capacity = measured.calibration.estimates["saturation_e"].value
    measurable = flats.kept & np.isfinite(flats.variance_dn2) & (flats.signal_dn > 0)
    signal = flats.signal_dn[measurable]
    charge = _charge_dn(measured, signal) / k
    top = capacity or 2 * float(charge.max(initial=1e3))

    def draw(axes: Axes) -> None:
        grid = np.geomspace(0.5, top, 300)
        dsnu, prnu = (measured.estimates[key].value for key in ("dsnu_total_e", "prnu_total"))
        axes.plot(grid * per_e, snr(grid, k, sigma_e), color=MODEL, label="linear model")
        if dsnu is not None and prnu is not None:
            total = snr(grid, k, sigma_e, dsnu, prnu)
            axes.plot(grid * per_e, total, color=MODEL, ls="--", label="total, DSNU and PRNU included")
        axes.plot(grid * per_e, np.sqrt(grid * per_e), color=SECOND, ls=":", label="ideal sensor")
        # Errors of the signal are those of the light behind it: the slope of the response carries them over.
        ratio = charge * k * _slope(measured, signal) / np.sqrt(flats.variance_dn2[measurable])
        axes.plot(charge * per_e, ratio, "o", ms=4, color=MEASURED, label="flats")
        axes.axhline(1, color=INK, lw=0.6)
        for limit_e, label in ((measured.estimates["threshold_e"].value, "min"), (capacity, "sat")):
            if limit_e is not None:
                axes.axvline(limit_e * per_e, color=INK, lw=0.6, ls="-.")
                side = {"ha": "right", "xytext": (-3, 3)} if label == "sat" else {"ha": "left", "xytext": (3, 3)}
                text, place = math_symbols(f"{name[:3]}.{label}"), (limit_e * per_e, 0.3)
                axes.annotate(text, place, textcoords="offset points", color=INK, fontsize=9, **side)
        axes.set(xscale="log", yscale="log", xlabel=name, ylabel="SNR")
        axes.set_ylim(bottom=0.3)

    return "Where SNR = 1 is the absolute sensitivity threshold μ_p.min.", draw


def _dark_signal(measured: EmvaMeasurement) -> _Plot:
    darks = _levels_of(measured, "dark")
    if np.unique(darks.exposure_s).size < 2:
        return "all darks have one exposure"
    slope = measured.calibration.estimates["dark_signal_dn_per_s"].value

    def draw(axes: Axes) -> None:
        axes.plot(darks.exposure_s, darks.signal_dn, "o", ms=4, color=MEASURED, label="darks")
        if slope is not None:
            ends = np.array([0.0, darks.exposure_s.max()])
            axes.plot(ends, slope * ends, color=MODEL, label="K μ_I t")
        axes.set(xlabel="exposure (s)", ylabel="μ_y.dark − μ_y.dark(0) (DN)")

    return "The slope over K is the dark current μ_I.", draw


def _spectrograms(measured: EmvaMeasurement, image: MeanImage, unit: str, factor: float) -> _Plot:
    spectra = [spectrogram(image.values, measured.used, axis) for axis in (1, 0)]

    def draw(axes: Axes) -> None:
        for spectrum, colour, label in zip(spectra, (MEASURED, SECOND), ("horizontal", "vertical"), strict=True):
            axes.semilogy(spectrum.frequency, factor * np.sqrt(spectrum.power), lw=0.9, color=colour, label=label)
        white = factor * float(np.sqrt(np.mean([spectrum.white for spectrum in spectra])))
        axes.axhline(white, color=MODEL, lw=1, label="white part")
        left = factor * np.sqrt(image.noise.variances[0])
        axes.axhline(left, color=MODEL, lw=1, ls="--", label="temporal noise left in the mean")
        axes.set(xlabel="spatial frequency (cycles/pixel)", ylabel=f"amplitude ({unit})", xlim=(0, 0.5))
        low, high = axes.get_ylim()
        axes.set_ylim(low, high * (high / low) ** 0.5)  # room for the legend

    return _caption(image) + " White noise is level at its standard deviation; a peak is a pattern.", draw


def _histogram(measured: EmvaMeasurement, image: MeanImage, unit: str, factor: float) -> _Plot:
    """Draw one accumulated histogram, of all pixels: here outliers are what counts."""
    every, is_flat = np.ones_like(measured.used), image.series.conditions.kind == "flat"
    histogram = accumulated_histogram(high_pass(image.values, every) if is_flat else image.values, every)

    def draw(axes: Axes) -> None:
        deviation = factor * histogram.deviation
        percent = 100 * erfc(histogram.deviation / (np.sqrt(2) * max(histogram.sigma, 1e-12)))
        axes.semilogy(deviation, histogram.percent, color=MEASURED, drawstyle="steps-pre", label="all pixels")
        axes.semilogy(deviation, percent, color=MODEL, ls="--", label="normal law")
        axes.set(xlabel=f"absolute deviation from the mean ({unit})", ylabel="pixels beyond (%)")
        axes.set_ylim(50 / measured.used.size, 200)
        axes.set_xlim(left=0)

    filtered = " Less its mean over 5 × 5 pixels." if is_flat else ""
    return _caption(image) + filtered + " Unusable pixels are included: they are its tail.", draw


def _caption(image: MeanImage) -> str:
    conditions = image.series.conditions
    if conditions.kind == "dark":
        return f"Mean of {image.series.frames} darks of {conditions.exposure_s:g} s."
    return f"Mean of {image.series.frames} flats of {image.signal_dn:.4g} DN, dark and vignetting taken out."
