"""The page of an alignment: what the new poses change, and how well they are known."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.image_files import encoded, light_picture, shrunk, white_level
from faintfield.pipelines.formats.results.alignment import AlignmentRecord
from faintfield.pipelines.pages.page import INK, blank_drawing, data_uri, ink, svg, template

# Widths of a picture and of its detail on the page, and the share of the picture that the detail shows.
_WIDTH_PX, _DETAIL = 640, 0.3


def alignment_page(
    record: AlignmentRecord, pictures: tuple[NDArray[np.float32], NDArray[np.float32]], tone_curve: bool
) -> str:
    """Return alignment.html, with the light by the old and the new poses."""
    white, window = white_level(pictures[1]), _detail_window(pictures[1])
    return template("alignment.html").render(
        record=record,
        pictures=[_uri(picture, white, tone_curve) for picture in pictures],
        details=[_uri(picture[window], white, tone_curve) for picture in pictures],
        drawing=_drawing(record),
        longest_px=_longest_px(record),
        rms_px=float(np.sqrt(np.mean(np.sum(np.square([view.shift_px for view in record.views]), axis=1)))),
        depths=list(record.transfer_sigma_px),
        options=msgspec.to_builtins(record.options),
        unit=record.units.length if record.units and record.units.depth == "mm" else "",
        turns=[float(np.degrees(view.turn_rad)) for view in record.views],
    )


def _uri(picture: NDArray[np.float32], white: float, tone_curve: bool) -> str:
    levels = light_picture(picture, white, tone_curve=tone_curve)
    larger = max(1, round(_WIDTH_PX / levels.shape[1]))
    levels = np.repeat(np.repeat(levels, larger, axis=0), larger, axis=1)
    return data_uri(encoded(shrunk(levels, _WIDTH_PX), ".webp"), ".webp")


def _detail_window(picture: NDArray[np.float32]) -> tuple[slice, slice]:
    """Return the window of a share of the picture's width and height that has the steepest gradients."""
    energy = np.sum(np.square(np.gradient(picture.astype(np.float64))), axis=0)
    sums = np.pad(energy.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    height, width = (max(2, round(_DETAIL * size)) for size in picture.shape)
    inside = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    row, column = np.unravel_index(int(np.argmax(inside)), inside.shape)
    return slice(int(row), int(row) + height), slice(int(column), int(column) + width)


def _longest_px(record: AlignmentRecord) -> float:
    return max(float(np.hypot(*view.shift_px)) for view in record.views)


def _drawing(record: AlignmentRecord) -> str:
    """Return the shift of each view's picture as an arrow at its node, magnified, as SVG."""
    nodes = np.array([view.node for view in record.views], float)
    shifts = np.array([view.shift_px for view in record.views])
    largest = _longest_px(record) or 1.0
    rows, columns = np.ptp(nodes, axis=0) + 1
    figure, axes = blank_drawing(5.4, float(np.clip(5.0 * rows / columns, 1.6, 7)))
    axes.quiver(
        nodes[:, 1],
        nodes[:, 0],
        *shifts.T,
        angles="xy",
        scale_units="xy",
        scale=largest / 0.9,
        color="#2b8cbe",
        width=0.006,
    )
    axes.plot(nodes[:, 1], nodes[:, 0], "o", color=INK, ms=3)
    axes.set(xlabel="column of the grid", ylabel="row of the grid", aspect="equal")
    axes.set(xlim=(nodes[:, 1].min() - 1, nodes[:, 1].max() + 1), ylim=(nodes[:, 0].max() + 1, nodes[:, 0].min() - 1))
    axes.locator_params(integer=True)
    ink(axes)
    return svg(figure)
