"""One drawing of the report by EMVA 1288."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from faintfield.pipelines.pages.page import INK, ink, svg
from faintfield.pipelines.pages.symbols import mathtext

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Measured, model, and a second series; told apart without colour vision, and on black as on white.
MEASURED, MODEL, SECOND = "#0072b2", "#d55e00", "#009e73"

_SIZE_IN = (5.6, 3.4)

# Logarithmic axes over less than this factor have even ticks, not powers of ten.
_FINE_RANGE = 10.0


@dataclass(frozen=True)
class Drawing:
    """One drawing as SVG, or, in `missing`, the reason why there is none."""

    title: str
    caption: str
    picture: str = ""
    missing: str | None = None


def drawn(title: str, caption: str, draw: "Callable[[Axes], None]") -> Drawing:
    """Return a drawing of one pair of axes."""
    from matplotlib.figure import Figure  # loading it costs most of a second

    figure = Figure(figsize=_SIZE_IN)
    axes = figure.subplots()
    draw(axes)
    _few_ticks(axes)
    ink(axes)
    axes.set(xlabel=mathtext(axes.get_xlabel()), ylabel=mathtext(axes.get_ylabel()))
    if axes.get_legend_handles_labels()[0]:
        legend = axes.legend(frameon=False, labelcolor=INK, fontsize=9)
        for text in legend.get_texts():
            text.set_text(mathtext(text.get_text()))
    return Drawing(title, caption, svg(figure))


def _few_ticks(axes: "Axes") -> None:
    """Give logarithmic axes few ticks, with plain numbers: what takes time in a drawing is its ticks."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    axes.minorticks_off()
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        if axis.get_scale() == "log":
            axis.set_major_locator(MaxNLocator(6) if high < _FINE_RANGE * low else LogLocator())
            axis.set_major_formatter("{x:g}")
