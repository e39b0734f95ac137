"""Figures 2, 3 and 4 as pictures for print."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from faintfield.pipelines.formats.results.records import PlaneRecord
from faintfield.pipelines.paper.figure4 import METHODS, OURS, PAPERS_AXIS, SNRS, CurvePoint

# The colours of Okabe and Ito, which colour-blind readers can tell apart; marks and dashes tell curves without colour.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#7f7f7f")
_MARKS = "os^Dv<>P"
_DASHES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)), (0, (8, 1, 1, 1)))
_STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "savefig.dpi": 200,
    "axes.axisbelow": True,
}


# Pixels (row, column) in electrons, and the record.
type DrawnPlane = tuple[NDArray[Any], PlaneRecord]


def draw_figure2(integral: NDArray[Any], planes: Sequence[DrawnPlane]) -> bytes:
    """Return figure 2 as PNG: the bright integral image, and back-projections on one grey scale."""
    with rc_context(_STYLE):
        figure = Figure(figsize=(10.5, 3.1), layout="constrained")
        first, *panels = figure.subplots(1, 1 + len(planes))
        first.imshow(integral, cmap="gray", vmin=0, vmax=255, interpolation="none")
        first.set_title("(a) integral image, one view per node")
        first.set_axis_off()
        _draw_planes(figure, panels, planes, "bc", "back-projection")
        return _png(figure)


def draw_figure3(
    dark: NDArray[Any], reference: NDArray[Any], scale_dn: tuple[float, float], snr: float, planes: Sequence[DrawnPlane]
) -> bytes:
    """Return figure 3 as PNG: one dark view and the noise reference on one scale, and the planes on another."""
    with rc_context(_STYLE):
        figure = Figure(figsize=(10.5, 7.4), layout="constrained")
        above, below = figure.subplots(2, 2)
        for axes, frame, title in (
            (above[0], dark, f"(a) one elemental image, SNR {snr:.2f}"),
            (above[1], reference, "(b) noise reference"),
        ):
            image = axes.imshow(frame, cmap="gray", vmin=scale_dn[0], vmax=scale_dn[1], interpolation="none")
            axes.set(title=title, xlabel="column (px)", ylabel="row (px)")
        figure.colorbar(image, ax=above.tolist(), shrink=0.85, label="DN")
        _draw_planes(figure, below.tolist(), planes, "cd", "PMLEM, prior auto,")
        return _png(figure)


def _draw_planes(figure: Figure, axes: Sequence[Axes], planes: Sequence[DrawnPlane], letters: str, what: str) -> None:
    white = max(float(np.quantile(pixels, 0.998)) for pixels, _ in planes)
    for panel, (pixels, plane), letter in zip(axes, planes, letters, strict=True):
        rows, columns = pixels.shape[:2]
        left, top = (start - plane.pitch_mm / 2 for start in plane.origin_mm)
        extent = (left, left + columns * plane.pitch_mm, top + rows * plane.pitch_mm, top)
        image = panel.imshow(pixels, cmap="gray", vmin=0, vmax=white, extent=extent, interpolation="none")
        panel.set(title=f"({letter}) {what} at {plane.depth_mm:g} mm", xlabel="x (mm)", ylabel="y, downwards (mm)")
    figure.colorbar(image, ax=list(axes), shrink=0.85, label="expected e⁻ per pixel")


def draw_figure4(points: Sequence[CurvePoint]) -> bytes:
    """Return figure 4 as PNG: above, our method as in the paper; below, all methods for each object."""
    objects = list(dict.fromkeys(point.object for point in points))
    with rc_context(_STYLE):
        figure = Figure(figsize=(10.5, 7.6), layout="constrained")
        above, below = np.asarray(figure.subfigures(2, 1, height_ratios=(1.1, 1))).flat
        papers, ours = above.subplots(1, 2)
        our_title = next(method.title for method in METHODS if method.name == OURS)
        for axes, title in ((papers, f"(a) on the paper's axis: {our_title}"), (ours, "(b) the same, nearer")):
            for index, name in enumerate(objects):
                _draw_curve(axes, points, (name, OURS), index, name)
            axes.set_title(title)
            _name_axes(axes)
            axes.set_ylim(0, None)
        papers.set_ylim(*PAPERS_AXIS)
        papers.legend(frameon=False, title="object", loc="upper right")
        panels = below.subplots(1, len(objects), sharey=True)
        for axes, name, letter in zip(np.atleast_1d(panels), objects, "cdefgh", strict=False):
            measured = {point.method for point in points}
            for index, method in enumerate(METHODS):
                if method.name in measured:
                    _draw_curve(axes, points, (name, method.name), index, method.title)
            axes.axhspan(*PAPERS_AXIS, color="0.93", zorder=0)
            axes.set(yscale="log", title=f"({letter}) {name}: all methods")
            _name_axes(axes)
            axes.label_outer()
        handles, labels = np.atleast_1d(panels)[0].get_legend_handles_labels()
        below.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
        return _png(figure)


def _draw_curve(axes: Axes, points: Sequence[CurvePoint], key: tuple[str, str], index: int, label: str) -> None:
    index %= len(_COLOURS)
    look: dict[str, Any] = {"color": _COLOURS[index], "marker": _MARKS[index], "linestyle": _DASHES[index]}
    curve = sorted(
        (point.snr, point.mse, point.standard_error or 0.0) for point in points if (point.object, point.method) == key
    )
    snr, mse, error = zip(*curve, strict=True)
    bars = 2 * np.array(error)
    axes.errorbar(snr, mse, bars, label=label, markersize=4, linewidth=1.3, capsize=2, **look)


def _name_axes(axes: Axes) -> None:
    axes.set(xlabel="SNR, eq. (4)", ylabel="mean square error, object 0…1")
    axes.set_xticks(SNRS[::2] if axes.get_position().width < 0.3 else SNRS)
    axes.grid(alpha=0.3, linewidth=0.5)


def _png(figure: Figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", metadata={"Software": None})
    return content.getvalue()
