"""Drawings that stay empty: their text takes most of the time of a page."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from faintfield.pipelines.formats.image_files import encoded


def save_empty(_: Figure, file: Any, format: str, **__: object) -> None:
    """Save nothing of a drawing, in the place of `Figure.savefig`."""
    file.write("<svg></svg>" if format == "svg" else encoded(np.zeros((4, 4), np.uint8), ".png"))
