"""The curves of a report: focus against depth, and how well each penalty weight predicts the held-out views."""

from collections.abc import Sequence
from itertools import cycle

import numpy as np

from faintfield.pipelines.formats.results.records import JOINT_METHODS, FocusCurve
from faintfield.pipelines.formats.units import StatedUnits
from faintfield.pipelines.pages.page import INK, ink, svg, words_of_depths
from faintfield.pipelines.pages.report_planes import Plane

# Colour and mark of the curves of several planes.
_LINES = (("#0072b2", "o"), ("#e69f00", "s"), ("#009e73", "^"), ("#cc79a7", "D"))

# Largest number of curves in the legend: one of many planes would leave no room for the curves.
_MAX_LABELLED = 8


def focus_curve(focus: FocusCurve, units: StatedUnits) -> str:
    """Return the focus curve as SVG that takes its colour from the page."""
    from matplotlib.figure import Figure  # loading it costs most of a second

    figure = Figure(figsize=(6.0, 2.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(focus.depth_mm, focus.detail_e2, "o-", color="#2b8cbe", markersize=3, linewidth=1.5)
    top = max(focus.detail_e2)
    for depth in focus.sharp_mm:
        axes.axvline(depth, color="#d95f02", linewidth=1, linestyle="--")
        axes.annotate(
            f"{depth:.0f} mm" if units.depth == "mm" else units.numbers_text([depth]).replace("-", "−"),
            (depth, top),
            xytext=(4, -2),
            textcoords="offset points",
            color="#d95f02",
            va="top",
        )
    squared = {"electrons": "e⁻²", "dn": "DN²", "relative": "white²"}[units.light]
    axes.set(
        xlabel=f"{units.quantity} ({units.length or 'relative'})",
        ylabel=f"detail both halves\nof the views agree on ({squared})",
    )
    axes.ticklabel_format(axis="y", scilimits=(-3, 3))
    ink(axes)
    return svg(figure)


def weight_curves(planes: Sequence[Plane]) -> str | None:
    """Return how well each penalty weight predicts the held-out views, as SVG; None if none were held out.

    Parameters
    ----------
    planes : sequence of Plane
        Planes of one column.
    """
    known = {
        (_line_name(plane), record.channel): record
        for plane in planes
        for record in plane.records
        if record.penalty_weight_curve
    }
    if not known:
        return None
    from matplotlib.figure import Figure  # loading it costs most of a second

    figure = Figure(figsize=(5.6, 3.0), layout="constrained")
    axes = figure.subplots()
    for index, (((name, channel), record), (colour, marker)) in enumerate(zip(known.items(), cycle(_LINES))):
        curve = sorted(record.penalty_weight_curve or [], key=lambda score: score.weight)
        held_out = np.array([score.held_out for score in curve])
        label = name if channel == "grey" else f"{name}, {channel}"
        if index == _MAX_LABELLED:
            label = f"and {len(known) - _MAX_LABELLED} more"
        weights = [score.weight for score in curve]
        axes.plot(
            weights,
            held_out - held_out.min(),
            marker=marker,
            markersize=4,
            color=colour,
            label=label if index <= _MAX_LABELLED else None,
        )
        if record.penalty_weight is not None:
            axes.axvline(record.penalty_weight, color=colour, linewidth=1, linestyle="--")
    axes.set_xscale("log")
    for axis_format in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
        axis_format("{x:g}")
    axes.set(xlabel="penalty weight β", ylabel="held-out views: −log likelihood\nabove their minimum")
    axes.legend(frameon=False, labelcolor=INK)
    ink(axes)
    return svg(figure)


def _line_name(plane: Plane) -> str:
    """Return the name of a plane in the legend; planes that were solved together share one curve."""
    if plane.method in JOINT_METHODS:
        return "all planes"
    return plane.name or words_of_depths(plane.units, plane.depth_mm)
