"""A page of plots to judge a noise calibration by, in the names and units of EMVA 1288."""

import io
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from faintfield.calib.noise import Estimate, NoiseCalibration, TransferPoint
from faintfield.calib.noise.emva.nonuniformity import spectrogram
from faintfield.calib.noise.strips import over_strips, thinned, variance_over
from faintfield.pipelines.formats.results.noise import STANDARD

_INK, _MODEL, _SECOND = "#1b1b1b", "#c23b22", "#2b6ca3"

_ROWS = (
    ("gain_dn_per_e", "$K$", "DN/e⁻"),
    ("offset_dn", r"$\mu_{y.\mathrm{dark}}(0)$", "DN"),
    ("read_noise_e", r"$\sigma_d$", "e⁻"),
    ("read_noise_dn", r"$K\sigma_d$", "DN"),
    ("dark_current_e_per_s", r"$\mu_I$", "e⁻/s"),
    ("dsnu_e", "DSNU (pixel)", "e⁻"),
    ("dcnu_e_per_s", "DCNU", "e⁻/s"),
    ("prnu", "PRNU (pixel)", ""),
    ("quantum_efficiency", r"$\eta$", "e⁻/photon"),
    ("frame_jitter_dn", "frame jitter", "DN"),
    ("row_noise_dn", "row noise", "DN"),
    ("column_noise_dn", "column noise", "DN"),
)

_PLOTS_PER_ROW = 3

# Largest number of pixels along the longer side of a map.
_MAX_SHOWN_PX = 2000


class _Plot(NamedTuple):
    """One plot of the page; `missing` is the reason for leaving it out, None where it has something to show."""

    title: str
    draw: Callable[[Axes, NoiseCalibration], None]
    missing: str | None = None


def draw_page(calibration: NoiseCalibration, title: str) -> bytes:
    """Return the page as a PNG: the plots, and below them the names of those left out, with the reason."""
    plots = _plots(calibration)
    shown = [plot for plot in plots if plot.missing is None]
    down = -(-len(shown) // _PLOTS_PER_ROW)
    figure = Figure(figsize=(15.5, 0.4 + 4.7 * down), layout="constrained")
    FigureCanvasAgg(figure)
    # The grid is in half plots, so that a shorter last row can be centred
    grid = figure.add_gridspec(down, 2 * _PLOTS_PER_ROW)
    for index, plot in enumerate(shown):
        row, column = divmod(index, _PLOTS_PER_ROW)
        first = 2 * column + (down * _PLOTS_PER_ROW - len(shown) if row == down - 1 else 0)
        axes = figure.add_subplot(grid[row, first : first + 2])
        axes.set_title(plot.title)
        plot.draw(axes, calibration)
    how = f"{STANDARD}; likelihood: {calibration.likelihood}"
    figure.suptitle(f"Noise calibration: {title.strip()}    ({how})", fontsize=13)
    left_out = "; ".join(f"{plot.title} ({plot.missing})" for plot in plots if plot.missing)
    if left_out:
        figure.supxlabel(f"Not shown: {left_out}", fontsize=9, color="0.4")
    page = io.BytesIO()
    figure.savefig(page, format="png", dpi=110)
    return page.getvalue()


def _plots(calibration: NoiseCalibration) -> tuple[_Plot, ...]:
    maps = calibration.maps
    offset = calibration.estimates["offset_dn"].value or 0.0
    cut_off = " (moments as they are, cut off)" if calibration.likelihood.startswith("censored") else ""
    no_mass = None if calibration.histograms else "no gain, or values too wide apart"
    return (
        _Plot("Photon transfer" + cut_off, _photon_transfer),
        _Plot("Dark signal against exposure time", _dark_signal),
        _Plot("Results, 95 % intervals", _table),
        _map("Offset less its mean (DSNU) [DN]", maps.offset_dn, maps.unusable, offset),
        _map("Dark current [e⁻/s]", maps.dark_current_e_per_s, maps.unusable),
        # Uniform if the model is complete.
        _map("Temporal variance, measured / model", calibration.pixels.variance_ratio, maps.unusable),
        _Plot("Dark values and the fitted mass function", _histograms, no_mass),
        _Plot("Spectrogram of the offset (DSNU)", _spectrogram, _why_empty(maps.offset_dn, maps.unusable)),
        _map("Relative response to light", maps.relative_response, maps.unusable),
    )


def _photon_transfer(axes: Axes, calibration: NoiseCalibration) -> None:
    offset = calibration.estimates["offset_dn"].value or 0.0
    measured = [point for point in calibration.points if point.frames > 1]
    for kind, colour in (("dark", _SECOND), ("flat", _INK)):
        points = [point for point in measured if point.kind == kind]
        if not points:
            continue
        mean = np.array([point.mean_dn - offset for point in points])
        variance, error = _column(points, "variance_dn2"), _column(points, "variance_se_dn2")
        axes.errorbar(mean, variance, 2 * error, fmt="o", ms=4, color=colour, capsize=2, label=f"{kind}s, ±2 s.e.")
    order = sorted(measured, key=lambda point: point.model_mean_dn)
    at = np.array([point.model_mean_dn - offset for point in order])
    x = np.unique(np.concatenate([np.linspace(at[0], at[-1], 200), np.geomspace(0.1, max(at[-1], 1), 200)]))
    axes.plot(x, np.interp(x, at, _column(order, "model_variance_dn2")), color=_MODEL, lw=1, label="model, eq. (1)")
    if any(point.kind == "flat" for point in measured):
        axes.set_xscale("symlog", linthresh=10)
        axes.set_yscale("log")
    axes.set(xlabel=r"$\mu_y - \mu_{y.\mathrm{dark}}(0)$ [DN]", ylabel=r"$\sigma_y^2$ [DN²]")
    axes.legend(fontsize=8)


def _dark_signal(axes: Axes, calibration: NoiseCalibration) -> None:
    points = [point for point in calibration.points if point.kind == "dark"]
    t = _column(points, "exposure_s")
    axes.plot(t, _column(points, "mean_dn"), "o", ms=4, color=_SECOND, label="mean of a series")
    order = np.argsort(t)
    model = _column(points, "model_mean_dn")
    axes.plot(t[order], model[order], color=_MODEL, lw=1, label="model")
    axes.set(xlabel="exposure time [s]", ylabel=r"$\mu_{y.\mathrm{dark}}$ [DN]")
    # Legend and inset are placed beside the line, whether it rises or falls.
    falls = model[order[-1]] < model[order[0]]
    axes.legend(fontsize=8, loc="upper right" if falls else "upper left")
    below = axes.inset_axes((0.1, 0.1, 0.34, 0.26) if falls else (0.56, 0.12, 0.42, 0.3))
    below.axhline(0, color=_MODEL, lw=1)
    below.plot(t, _column(points, "mean_dn") - model, "o", ms=3, color=_SECOND)
    below.set_title("measured − model [DN]", fontsize=7)
    below.tick_params(labelsize=7)


def _table(axes: Axes, calibration: NoiseCalibration) -> None:
    axes.axis("off")
    cells = [[label, *_value_and_interval(calibration.estimates[name]), unit] for name, label, unit in _ROWS]
    widths = [0.26, 0.18, 0.34, 0.22]
    table = axes.table(cells, colWidths=widths, loc="upper center", cellLoc="left", edges="horizontal")
    table.auto_set_font_size(False)
    table.set_fontsize(8.5)
    table.scale(1, 1.35)
    counts = {kind: int(getattr(calibration.pixels, kind).sum()) for kind in ("hot", "noisy", "dead")}
    summary = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    axes.text(0.5, 0.0, f"{summary} pixels", ha="center", fontsize=9, transform=axes.transAxes)


def _value_and_interval(estimate: Estimate) -> tuple[str, str]:
    if estimate.value is None or estimate.ci95 is None:
        return "—", "not identifiable"
    digits = int(np.clip(np.ceil(-np.log10(estimate.se)), 0, 6)) if estimate.se else 3
    low, high = estimate.ci95
    return f"{estimate.value:.{digits}f}", f"{low:.{digits}f} … {high:.{digits}f}"


def _map(title: str, values: NDArray[np.floating] | None, unusable: NDArray[np.bool_], less: float = 0.0) -> _Plot:
    """Return the plot of one map less a number; its scale spans the usable pixels."""

    def draw(axes: Axes, _: NoiseCalibration) -> None:
        assert values is not None
        low, high = np.quantile(thinned(values, ~unusable), [0.005, 0.995]) - less
        height, width = values.shape
        step = max(max(height, width) // _MAX_SHOWN_PX, 1)  # more pixels than the page has take seconds to draw
        look: dict[str, Any] = {"extent": (-0.5, width - 0.5, height - 0.5, -0.5), "interpolation": "nearest"}
        shown = values[::step, ::step] - less
        image = axes.imshow(shown, vmin=low, vmax=max(high, low + 1e-6), cmap="viridis", **look)
        axes.set(xlabel="column [px]", ylabel="row [px]")
        axes.figure.colorbar(image, ax=axes, shrink=0.8)

    return _Plot(title, draw, _why_empty(values, unusable))


def _why_empty(values: NDArray[np.floating] | None, unusable: NDArray[np.bool_]) -> str | None:
    if values is None:
        return "not identifiable from these frames"
    if unusable.all():
        return "no usable pixel"

    def ends(rows: slice) -> tuple[float, float]:
        usable = values[rows][~unusable[rows]]
        return float(usable.min(initial=np.inf)), float(usable.max(initial=-np.inf))

    lows, highs = zip(*over_strips(ends, values.shape), strict=True)
    return None if min(lows) < max(highs) else "the same for all pixels"


def _histograms(axes: Axes, calibration: NoiseCalibration) -> None:
    for histogram, colour in zip(calibration.histograms, (_SECOND, _INK), strict=False):
        counted = histogram.count > 0
        label = f"{histogram.exposure_s:g} s, {histogram.count.sum():,} values"
        axes.plot(histogram.value_dn[counted], histogram.count[counted], ".", ms=4, color=colour, label=label)
        axes.plot(histogram.value_dn, np.maximum(histogram.expected, 1e-3), color=_MODEL, lw=1)
    axes.plot([], [], color=_MODEL, lw=1, label="fitted")
    axes.set(xlabel="$y$ [DN]", ylabel="count", xlim=_value_range(calibration), yscale="log")
    axes.set_ylim(bottom=0.5)
    axes.locator_params(axis="x", nbins=6)
    axes.legend(fontsize=8)


def _value_range(calibration: NoiseCalibration) -> tuple[float, float]:
    """Return the range of values between the quantiles 1e-4 and 1 - 1e-4."""
    inner: list[float] = []
    for histogram in calibration.histograms:
        share = np.cumsum(histogram.count) / histogram.count.sum()
        inner += histogram.value_dn[(share > 1e-4) & (share < 1 - 1e-4)].tolist()
    return min(inner) - 3, max(inner) + 3


def _spectrogram(axes: Axes, calibration: NoiseCalibration) -> None:
    """Draw the amplitude spectra of the offset map; a peak is a fixed pattern with a period."""
    offset, usable = calibration.maps.offset_dn, ~calibration.maps.unusable
    share = float(usable.mean())
    for axis, label, colour in ((1, "along rows (horizontal)", _SECOND), (0, "along columns (vertical)", _INK)):
        spectrum = spectrogram(offset, usable, axis)
        axes.plot(spectrum.frequency, np.sqrt(share * spectrum.power), lw=0.8, color=colour, label=label)
    white = np.sqrt(share * variance_over(lambda rows: offset[rows], usable))
    axes.axhline(white, color=_MODEL, lw=1, ls="--", label="same variance, no pattern")
    axes.set_ylim(bottom=0)
    axes.set(xlabel="spatial frequency [cycles/px]", ylabel="amplitude [DN]")
    axes.legend(fontsize=8)


def _column(points: list[TransferPoint], name: str) -> NDArray[np.float64]:
    return np.array([getattr(point, name) for point in points], np.float64)
