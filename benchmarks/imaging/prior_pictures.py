"""Planes by several methods side by side, with their errors, as a picture for the documents."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image as Pictures

from faintfield.recon.likelihood.images import Image

_WIDTH_IN, _DPI = 8.8, 118
_TITLE_IN = 0.24


@dataclass(frozen=True)
class ShownPlane:
    """A plane (row, column), 1 is white, and what stands above it."""

    plane: Image
    title: str


def draw(path: Path, rows: Sequence[Sequence[ShownPlane]]) -> None:
    """Write a PNG of planes, one object a row, on one linear grey scale from 0 to 1."""
    columns = len(rows[0])
    heights = [_WIDTH_IN / columns * row[0].plane.shape[0] / row[0].plane.shape[1] + _TITLE_IN for row in rows]
    with rc_context({"font.size": 8, "axes.titlepad": 3}):
        layout = ConstrainedLayoutEngine(w_pad=0.01, h_pad=0.01, wspace=0.005, hspace=0.005)
        figure = Figure(figsize=(_WIDTH_IN, sum(heights)), layout=layout, dpi=_DPI)
        every = figure.subplots(len(rows), columns, squeeze=False, gridspec_kw={"height_ratios": heights})
        for of_row, axes in zip(rows, every, strict=True):
            for shown, axis in zip(of_row, axes, strict=True):
                axis.imshow(np.clip(shown.plane, 0, 1), cmap="gray", vmin=0, vmax=1)
                axis.set_title(shown.title)
                axis.set_axis_off()
        content = io.BytesIO()
        figure.savefig(content, format="png")
    with Pictures.open(content) as picture:
        picture.convert("L").save(path, optimize=True)
