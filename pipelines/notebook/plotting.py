"""Drawings of views, planes and surfaces on matplotlib axes, with their scales."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.image_files import light_picture, white_level
from faintfield.pipelines.formats.units import StatedUnits

if TYPE_CHECKING:
    from faintfield.pipelines.notebook.results import Planes, Surface

# Width of a small picture among others, in inches.
_SMALL_INCHES = 3.2


def draw_light(
    axes: Any,
    light: NDArray[np.floating],
    units: StatedUnits,
    *,
    title: str,
    x: NDArray[np.float64] | None = None,
    y: NDArray[np.float64] | None = None,
    white: float | None = None,
) -> Any:
    """Draw light (row, column[, colour]) on axes, by default new ones, and return these.

    `x` and `y` are the places of the samples; without them the axes count pixels. The title says what is white.
    """
    import matplotlib.pyplot as plt  # slow to load

    axes = plt.subplots(layout="constrained")[1] if axes is None else axes
    white = white_level(light) if white is None else white
    picture = light_picture(light, white, tone_curve=units.tone_curve)
    extent = None if x is None or y is None else (*_ends(x), *_ends(y)[::-1])
    axes.imshow(picture, cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="nearest")
    unit = "px" if extent is None else units.length or "relative"
    axes.set(xlabel=f"x, {unit}", ylabel=f"y, {unit}", title=f"{title}; white: {white:.3g} {units.light_symbol}")
    return axes


def draw_planes(planes: "Planes", columns: int) -> Any:
    """Draw planes in rows, all on the grey scale of the brightest, and return the figure."""
    import matplotlib.pyplot as plt

    columns = min(columns, len(planes))
    rows = -(-len(planes) // columns)
    height, width = planes.records[0][0].shape
    size = (_SMALL_INCHES * columns, rows * (_SMALL_INCHES * height / width + 0.6))
    figure, grid = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    white = max(white_level(plane.image) for plane in planes)
    for axes in grid.flat[len(planes) :]:
        axes.set_axis_off()
    for axes, plane in zip(grid.flat, planes, strict=False):
        plane.plot(axes, white=white)
        axes.set_title(plane.units.depths_text([plane.depth]))
    figure.suptitle(f"white: {white:.3g} {planes.units.light_symbol}")
    return figure


def draw_surface(surface: "Surface") -> Any:
    """Draw the picture of a surface beside its sure depths, and return the figure."""
    import matplotlib.pyplot as plt

    height, width = surface.depth.shape
    size = (2 * 1.5 * _SMALL_INCHES, 1.5 * _SMALL_INCHES * height / width + 0.6)
    figure, (left, right) = plt.subplots(1, 2, figsize=size, layout="constrained")
    draw_light(left, surface.picture, surface.units, title="picture")
    depth = right.imshow(np.where(surface.sure, surface.depth, np.nan), interpolation="nearest")
    right.set(title=f"sure depths: {surface.sure.mean():.0%} of the samples", xlabel="x, px", facecolor="0.5")
    figure.colorbar(depth, ax=right, label=f"depth, {surface.result.surface.unit}", fraction=0.036, pad=0.02)
    return figure


def _ends(places: NDArray[np.float64]) -> tuple[float, float]:
    """Return the outer edges of the first and last sample."""
    half = (places[1] - places[0]) / 2
    return float(places[0] - half), float(places[-1] + half)
