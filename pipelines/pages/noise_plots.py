"""Drawings of a sensor's noise: photon transfer and dark current with their residuals, and those of EMVA 1288."""

from collections.abc import Callable
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
from faintfield.pipelines.pages.page import INK, blank_drawing, figure, ink, math_symbols, svg

# Measured, model, and a second series; distinct without colour vision, and on black as on white.
MEASURED, MODEL, SECOND = "#0072b2", "#d55e00", "#009e73"

# Logarithmic axes over less than the first factor have even ticks, over less than the second 1, 2, 5, 10, ...
_FINE_RANGE, _SHORT_RANGE = 10.0, 1000.0

_NO_FLATS = "there are no flats"

# Mean of a series above that of a dark of zero exposure.
_SIGNAL = "μ_y − μ_y.dark(0)"


class Plot(NamedTuple):
    """A drawing to be made: its caption, what draws it, and what draws the residuals below it."""

    caption: str
    draw: Callable[[Axes], object]
    residuals: Callable[[Axes], object] | None = None


class Drawing(NamedTuple):
    """One drawing as SVG, or, in `missing`, the reason why there is none."""

    title: str
    caption: str = ""
    picture: str = ""
    missing: str = ""


def fit_drawings(measured: EmvaMeasurement) -> list[Drawing]:
    """Return the drawings that show how well the model describes the frames of one phase."""
    flats = _levels_of_flats(measured)
    plots = {
        "Photon transfer": _photon_transfer(measured, flats),
        "Dark current": _dark_signal(measured),
        "Values of the darks": _histograms(measured),
        "Response to light": _response(measured, flats),
    }
    return [drawn(title, plot) for title, plot in plots.items()]


def emva_drawings(measured: EmvaMeasurement) -> list[Drawing]:
    """Return the other drawings of the standard's report, of one phase."""
    flats = _levels_of_flats(measured)
    plots: dict[str, Plot | str] = {
        "Photon transfer by EMVA 1288": _photon_transfer(measured, flats, excess=True),
        "Signal-to-noise ratio": _snr(measured, flats),
    }
    images = (
        (measured.dark, "Dark pattern (DSNU)", "dsnu_total_e", "DN", 1.0),
        (measured.bright, "Response pattern (PRNU)", "prnu_total", "%", 100.0),
    )
    for kind, plot in (("spectrograms", _spectrograms), ("accumulated histogram", _histogram)):
        for image, pattern, name, unit, factor in images:
            missing = measured.estimates[name].why or "there is no image"
            plots[f"{pattern}: {kind}"] = plot(measured, image, unit, factor) if image else missing
    return [drawn(title, plot) for title, plot in plots.items()]


def drawn(title: str, plot: Plot | str) -> Drawing:
    """Return a drawing; a text instead of a plot is the reason why there is none."""
    if isinstance(plot, str):
        return Drawing(title, missing=plot)
    figure, axes = blank_drawing(5.6, 3.4, None)
    plot.draw(axes)
    panels = [axes]
    if plot.residuals:
        panels.append(axes.inset_axes((0, -0.5, 1, 0.4), sharex=axes))
        plot.residuals(panels[1])
        panels[1].axhline(0, color=MODEL, lw=1)
        panels[1].set_xlabel(axes.get_xlabel())
        axes.set_xlabel("")
        axes.tick_params(labelbottom=False)
    for panel in panels:
        # Logarithmic axes have few ticks, with plain numbers: ticks are what takes time in a drawing
        panel.minorticks_off()
        for axis, (low, high) in ((panel.xaxis, panel.get_xlim()), (panel.yaxis, panel.get_ylim())):
            if axis.get_scale() == "log":
                steps = (1, 2, 5) if high < _SHORT_RANGE * low else (1,)
                axis.set_major_locator(MaxNLocator(6) if high < _FINE_RANGE * low else LogLocator(subs=steps))
                axis.set_major_formatter("{x:g}")
            else:
                axis.set_major_locator(MaxNLocator(6))
        ink(panel)
        panel.set(xlabel=math_symbols(panel.get_xlabel()), ylabel=math_symbols(panel.get_ylabel()))
    if axes.get_legend_handles_labels()[0]:
        # Above the axes, where it hides nothing
        legend = axes.legend(
            loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False, labelcolor=INK, fontsize=9
        )
        for text in legend.get_texts():
            text.set_text(math_symbols(text.get_text()))
    return Drawing(title, plot.caption, svg(figure))


class _Levels(NamedTuple):
    """Flats of a measurement, arrays (series,), dark ones first by brightness.

    `signal_dn` is above the dark of zero exposure; `kept` marks the series within the range of the sensor; the variance
    of a series that has a single frame is NaN.
    """

    signal_dn: NDArray[np.float64]
    variance_dn2: NDArray[np.float64]
    exposure_s: NDArray[np.float64]
    photons: NDArray[np.float64]
    kept: NDArray[np.bool_]


def _levels_of_flats(measured: EmvaMeasurement) -> _Levels:
    flats = sorted(
        (item for item in measured.series if item.conditions.kind == "flat"), key=lambda item: item.levels_dn.mean()
    )
    offset, used = measured.calibration.estimates["offset_dn"].value or 0.0, measured.used
    kept = {id(flat) for flat in measured.calibration.saturation.kept}
    share = 1 - (sum(used.shape) - 1) / max(int(used.sum()), 1)  # of the degrees of freedom of a frame's pixels
    freedom = [(flat.frames - 1) * share or np.nan for flat in flats]
    return _Levels(
        np.array([flat.levels_dn.mean() - offset for flat in flats]),
        np.array([flat.within_dn2.mean(where=used) / times for flat, times in zip(flats, freedom, strict=True)]),
        np.array([flat.conditions.exposure_s for flat in flats]),
        np.array([flat.conditions.photons or np.nan for flat in flats]),
        np.array([id(flat) in kept for flat in flats], bool),
    )


def _photon_transfer(measured: EmvaMeasurement, flats: _Levels, *, excess: bool = False) -> Plot | str:
    """Draw the variance of every series against its signal, with the model, on logarithmic axes if there are flats.

    With `excess`, draw that of the flats beyond the darks', on linear axes, as EMVA 1288 does.
    """
    if excess and not flats.signal_dn.size:
        return _NO_FLATS
    estimates = measured.calibration.estimates
    gain, read_dn, offset = (estimates[name].value for name in ("gain_dn_per_e", "read_noise_dn", "offset_dn"))
    dark_dn2 = None if read_dn is None else read_dn**2 + ROUNDING_DN2
    less = (dark_dn2 or 0.0) if excess else 0.0
    several = [point for point in measured.calibration.points if point.frames > 1]
    signal = np.array([point.mean_dn - (offset or 0.0) for point in several])
    variance, error, model = (
        np.array([getattr(point, f"{name}_dn2") for point in several])
        for name in ("variance", "variance_se", "model_variance")
    )
    is_flat = np.array([point.kind == "flat" for point in several])
    scale = "log" if flats.signal_dn.size and not excess else "linear"
    shown = is_flat if excess else signal > (0 if scale == "log" else -np.inf)
    kinds = ((shown & ~is_flat, SECOND, "s", "darks"), (shown & is_flat, MEASURED, "o", "flats"))
    space, first = (np.geomspace, signal[shown].min(initial=1.0)) if scale == "log" else (np.linspace, 0.0)

    def draw(axes: Axes) -> None:
        for mask, colour, mark, label in kinds:
            if mask.any():
                at, bars = (signal[mask], variance[mask] - less), 2 * error[mask]
                axes.errorbar(*at, bars, fmt=mark, ms=4, color=colour, label=f"{label}, ± 2 s.e.")
        if (left_out := ~flats.kept).any():
            brighter = flats.signal_dn[left_out], flats.variance_dn2[left_out] - less
            axes.plot(*brighter, "x", color=SECOND, label="flats left out")
        if gain is not None and dark_dn2 is not None:
            grid = space(first, signal.max(), 200)
            line = dark_dn2 - less + gain * _charge_dn(measured, grid) * _slope(measured, grid) ** 2
            axes.plot(grid, line, color=MODEL, label="model")
        of_dark = " − σ_y.dark²" if excess else ""
        axes.set(xscale=scale, yscale=scale, xlabel=f"signal {_SIGNAL} (DN)", ylabel=f"variance σ_y²{of_dark} (DN²)")

    def residuals(axes: Axes) -> None:
        for mask, colour, mark, _ in kinds:
            percent, bars = 100 * (variance / model - 1)[mask], 200 * (error / model)[mask]
            axes.errorbar(signal[mask], percent, bars, fmt=mark, ms=4, color=colour)
        axes.set(ylabel="measured less\nmodel (%)")

    if excess:
        return Plot("Its slope at the origin is the gain K. The dark is that of zero exposure.", draw)
    hidden = "" if shown.all() else f" Logarithmic axes have no place for {(~shown).sum()} series without signal."
    caption = "Read noise is the level part. In the rising part, variance over signal is the gain K."
    return Plot(f"{caption}{hidden}", draw, residuals)


def _charge_dn(measured: EmvaMeasurement, signal_dn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return K times the charge behind a signal."""
    response = measured.calibration.response
    return signal_dn if response is None else response.charge_dn(signal_dn)


def _slope(measured: EmvaMeasurement, signal_dn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the growth of the signal with K times the charge, 1 without a bend."""
    response = measured.calibration.response
    return np.ones_like(signal_dn) if response is None else 1 / response.slope(signal_dn)


def _light(measured: EmvaMeasurement, flats: _Levels) -> tuple[NDArray[np.float64], str, str] | None:
    """Return the light of the flats with its name and unit, None if it is not known up to one factor."""
    if flats.photons.size and np.isfinite(flats.photons).all():
        return flats.photons, "light μ_p", "photons/pixel"
    series = [item for item in measured.series if item.conditions.kind == "flat"]
    if series and len({item.conditions.level for item in series}) == 1 and (known_light(series).group >= 0).all():
        return flats.exposure_s, "exposure", "s"
    return None


def _response(measured: EmvaMeasurement, flats: _Levels) -> Plot | str:
    """Draw the signal against the light, and its relative deviation from the straight line of EMVA 1288."""
    light = _light(measured, flats)
    if light is None:
        return "neither photons nor several exposures of one light are stated" if flats.signal_dn.size else _NO_FLATS
    amount, name, unit = light
    slope = measured.estimates["responsivity_dn_per_photon"].value if unit != "s" else None
    inside, percent = _deviation(measured, flats, amount)

    def draw(axes: Axes) -> None:
        axes.plot(amount[flats.kept], flats.signal_dn[flats.kept], "o", ms=4, color=MEASURED, label="flats")
        if not flats.kept.all():
            axes.plot(amount[~flats.kept], flats.signal_dn[~flats.kept], "x", ms=5, color=SECOND, label="left out")
        if slope is not None:
            ends = np.array([0.0, float(amount[flats.kept].max(initial=0.0))])
            axes.plot(ends, slope * ends, color=MODEL, label="R μ_p, R = K η")
        axes.set(xlabel=f"{name} ({unit})", ylabel=f"signal {_SIGNAL} (DN)")
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)

    def deviation(axes: Axes) -> None:
        axes.plot(amount[inside], percent, "o-", ms=4, lw=0.8, color=MEASURED)
        axes.set(ylabel="deviation\nfrom linear (%)")

    caption = "The slope at the origin is the responsivity R."
    if not percent.size:
        return Plot(f"{caption} Deviation not shown: fewer than 3 levels are within 5 to 95 % of saturation.", draw)
    caption += (
        " Deviation: of each measured level, its own error included, from the straight line a₀ + a₁ μ_p that minimizes "
        "the squares of relative deviations, within 5 to 95 % of saturation (of the brightest flat, if none is "
        "saturated). LE in the table is the mean of those of the fitted response, which has no errors of single levels."
    )
    return Plot(caption, draw, deviation)


def _deviation(
    measured: EmvaMeasurement, flats: _Levels, amount: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return the flats within 5 to 95 % of saturation, and their deviations in percent; none for fewer than 3."""
    level = measured.calibration.saturation.level_dn
    offset = measured.calibration.estimates["offset_dn"].value or 0.0
    full = float(flats.signal_dn[flats.kept].max(initial=0.0)) if level is None else level - offset
    current = measured.calibration.estimates["dark_signal_dn_per_s"].value or 0.0
    signal = flats.signal_dn - current * flats.exposure_s
    inside = flats.kept & (signal > 0.05 * full) & (signal < 0.95 * full)
    if inside.sum() < 3:
        return inside, np.empty(0)
    design = np.stack([np.ones(inside.sum()), amount[inside]], axis=1)
    line = design @ np.linalg.lstsq(design / signal[inside, None], np.ones(inside.sum()))[0]
    return inside, 100 * (signal[inside] / line - 1)


def _snr(measured: EmvaMeasurement, flats: _Levels) -> Plot | str:
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

    return Plot(f"Where SNR = 1 is the absolute sensitivity threshold {name[:3]}.min.", draw)


def _dark_signal(measured: EmvaMeasurement) -> Plot | str:
    """Draw the level of the darks against exposure, with the line of the dark current."""
    calibration, pixels = measured.calibration, int(measured.used.sum())
    darks = sorted((point for point in calibration.points if point.kind == "dark"), key=lambda dark: dark.exposure_s)
    exposure, mean, model, variance, frames = (
        np.array([getattr(dark, name) for dark in darks], float)
        for name in ("exposure_s", "mean_dn", "model_mean_dn", "model_variance_dn2", "frames")
    )
    if np.unique(exposure).size < 2:
        return "all darks have one exposure"
    jitter = calibration.estimates["frame_jitter_dn"].value or 0.0
    error = np.sqrt((variance / max(pixels, 1) + jitter**2) / frames)
    offset = calibration.estimates["offset_dn"].value or 0.0
    known = calibration.estimates["dark_current_e_per_s"].value is not None

    def draw(axes: Axes) -> None:
        axes.plot(exposure, mean - offset, "s", ms=4, color=SECOND, label="darks")
        axes.plot(exposure, model - offset, color=MODEL, label="K μ_I t" if known else "line through the darks")
        axes.set(xlabel="exposure t (s)", ylabel="dark signal\nμ_y.dark − μ_y.dark(0) (DN)")

    def residuals(axes: Axes) -> None:
        axes.errorbar(exposure, mean - model, 2 * error, fmt="s", ms=4, color=SECOND)
        axes.set(ylabel="measured less\nmodel (DN)")

    slope = "over the gain K is" if known else "does not determine"
    caption = f"The slope {slope} the dark current μ_I. Bars: ± 2 s.e., noise of pixels and jitter of frames."
    return Plot(caption, draw, residuals)


def _histograms(measured: EmvaMeasurement) -> Plot | str:
    """Draw the values of the shortest and the longest darks, and their law by the fit."""
    histograms = measured.calibration.histograms
    if not histograms:
        return "no gain, or values too wide apart"

    def draw(axes: Axes) -> None:
        inner: list[float] = []  # values between the quantiles 1e-4 and 1 - 1e-4
        for histogram, colour, mark in zip(histograms, (SECOND, MEASURED), "so", strict=False):
            counted, share = histogram.count > 0, np.cumsum(histogram.count) / histogram.count.sum()
            inner += histogram.value_dn[(share > 1e-4) & (share < 1 - 1e-4)].tolist()
            values = histogram.value_dn[counted], histogram.count[counted]
            axes.plot(*values, mark, ms=3, color=colour, label=f"darks of {histogram.exposure_s:g} s")
            axes.semilogy(histogram.value_dn, np.maximum(histogram.expected, 1e-3), color=MODEL, lw=1)
        axes.set(xlabel="value y (DN)", ylabel="number", xlim=(min(inner) - 3, max(inner) + 3))
        axes.set_ylim(bottom=0.5)

    return Plot("Lines: the law that the fitted noise predicts, not fitted to these numbers.", draw)


def _spectrograms(measured: EmvaMeasurement, image: MeanImage, unit: str, factor: float) -> Plot | str:
    spectra = [spectrogram(image.values, measured.used, axis) for axis in (1, 0)]

    def draw(axes: Axes) -> None:
        for spectrum, colour, label in zip(spectra, (MEASURED, SECOND), ("horizontal", "vertical"), strict=True):
            axes.semilogy(spectrum.frequency, factor * np.sqrt(spectrum.power), lw=0.9, color=colour, label=label)
        white = factor * float(np.sqrt(np.mean([spectrum.white for spectrum in spectra])))
        axes.axhline(white, color=MODEL, lw=1, label="white part")
        left = factor * np.sqrt(image.noise.variances[0])
        axes.axhline(left, color=MODEL, lw=1, ls="--", label="temporal noise left in the mean")
        axes.set(xlabel="spatial frequency (cycles/pixel)", ylabel=f"amplitude ({unit})", xlim=(0, 0.5))

    return Plot(_caption(image) + " White noise is level at its standard deviation; a peak is a pattern.", draw)


def _histogram(measured: EmvaMeasurement, image: MeanImage, unit: str, factor: float) -> Plot | str:
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
    return Plot(_caption(image) + filtered + " Unusable pixels are included: they are its tail.", draw)


def _caption(image: MeanImage) -> str:
    conditions = image.series.conditions
    if conditions.kind == "dark":
        return f"Mean of {image.series.frames} darks of {conditions.exposure_s:g} s."
    return f"Mean of {image.series.frames} flats of {figure(image.signal_dn)} DN, dark and vignetting taken out."
