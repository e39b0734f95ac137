"""Maps drawn in colours, with a labelled colour bar; unknown values are hatched."""

import io

import numpy as np
from numpy.typing import NDArray

# Hatching of unknown values: two levels of grey (0 to 1), and their period.
_MARK_GREY, _MARK_DARK, _MARK_PERIOD_PX = 0.62, 0.5, 12

# Widths in inches of the picture and of the map in it, and the height of what is not the map.
_PICTURE_WIDTH_IN, _MAP_WIDTH_IN, _MARGIN_IN = 8.6, 7.2, 0.6

# Size of letters, to be read where a page shows the picture at half its size.
_FONT_PT = 15

# Quantiles of the known values between which a map is drawn if nothing else limits it.
_QUANTILES = (0.01, 0.99)

# Widest range of a map of equal values, as a share of them, so that rounding errors are not drawn as a relief.
_MIN_RANGE = 1e-3


def map_picture(values: NDArray[np.floating], label: str, low: float, high: float) -> bytes:
    """Return a map (row, column) as PNG in colours from `low` to `high`; NaNs are hatched grey.

    The colour bar ends in a point where values lie beyond it.
    """
    from matplotlib.figure import Figure  # loading it costs most of a second

    rows, columns = np.indices(values.shape)
    hatch = np.where((rows + columns) % _MARK_PERIOD_PX < 2, _MARK_DARK, _MARK_GREY)
    figure = Figure(
        figsize=(_PICTURE_WIDTH_IN, _MARGIN_IN + _MAP_WIDTH_IN * values.shape[0] / values.shape[1]),
        layout="constrained",
    )
    axes = figure.subplots()
    axes.imshow(hatch, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    shown = axes.imshow(values, cmap="viridis", vmin=low, vmax=high, interpolation="nearest")
    axes.set_axis_off()
    below, above = bool((values < low).any()), bool((values > high).any())
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, above), "neither")
    bar = figure.colorbar(shown, extend=extend, fraction=0.05, pad=0.02)
    bar.set_label(label, size=_FONT_PT)
    bar.ax.tick_params(labelsize=_FONT_PT)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110, metadata={"Software": None})
    return content.getvalue()


def robust_limits(values: NDArray[np.floating]) -> tuple[float, float]:
    """Return limits between which nearly all known values of a map lie; 0 and 1 if none is known."""
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0, 1.0
    low, high = np.quantile(known, _QUANTILES).tolist()
    room = max(_MIN_RANGE * max(abs(low), abs(high)) - (high - low), 0) / 2 or (0.5 if high == low else 0)
    return low - room, high + room
