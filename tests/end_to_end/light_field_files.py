"""One rendered scene written to files in the ways of many archives, and in ways that no one should."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from tests.calib.light_fields import CARDS, Views, light_field

ROWS, COLUMNS, WIDTH, HEIGHT = 5, 7, 160, 120

WHITE = 40_000

type Numbers = Callable[[int, int], str]
type Writer = Callable[[Path, dict[str, NDArray[np.float32]]], None]


@cache
def views_of(aligned_px: int, square: bool = False) -> Views:
    """Return the views, 5 x 7 or 7 x 7, in which each point moves by so many px more from node to node."""
    return light_field(CARDS, (7 if square else ROWS, COLUMNS), (WIDTH, HEIGHT), aligned_px=aligned_px)


def other_scene(seed: int) -> NDArray[np.float32]:
    """Return a view of another scene."""
    return light_field(CARDS, grid=(1, 1), size_px=(WIDTH, HEIGHT), seed=seed)[0, 0]


def lettered(row: int, column: int) -> str:
    """Return the name that the documentation recommends."""
    return f"view_r{row}_c{column}"


@dataclass(frozen=True)
class Names:
    """Names of nodes: `text` gives the stem of two numbers, which may be turned before."""

    text: Numbers = lettered
    transpose: bool = False
    flip_rows: bool = False
    flip_columns: bool = False

    def stem(self, node: tuple[int, int], size: tuple[int, int]) -> str:
        """Return the name of a node of a grid of this size, without suffix."""
        row = size[0] - 1 - node[0] if self.flip_rows else node[0]
        column = size[1] - 1 - node[1] if self.flip_columns else node[1]
        return self.text(column, row) if self.transpose else self.text(row, column)


def running(per_line: int, first: int = 0, text: str = "{:04}") -> Numbers:
    """Return names with one number, counted line by line."""
    return lambda line, place: text.format(first + line * per_line + place)


def stanford(row: int, column: int) -> str:
    """Return a name of Stanford's archive: its positions have a unit and directions of their own."""
    return f"out_{row:02}_{column:02}_{-381.909 - 3.5 * row:.3f}_{1124.376 + 3.5 * column:.3f}_"


def positions_only(row: int, column: int) -> str:
    """Return a name that has a position, but neither row nor column."""
    return f"IMG_0412_{50 - 3.5 * row:.3f}_{1124.376 - 3.5 * column:.3f}"


def _sixteen(view: NDArray[np.float32]) -> NDArray[np.uint16]:
    return np.clip(view * WHITE, 0, 65535).astype(np.uint16)


def _eight(view: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return a view with the tone curve of sRGB."""
    light = np.clip(view * WHITE / 65535, 0, 1)
    return np.rint(255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)).astype("u1")


def _coloured(view: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.stack([_eight(view * tint) for tint in (0.7, 1.0, 0.9)], axis=-1)


def written(suffix: str, encode: Callable[[NDArray[np.float32]], NDArray[np.generic]], *options: int) -> Writer:
    """Return a writer of one file for each view."""

    def write(folder: Path, pictures: dict[str, NDArray[np.float32]]) -> None:
        for stem, view in pictures.items():
            assert cv2.imwrite(str(folder / f"{stem}{suffix}"), encode(view), options)

    return write


def _floats(folder: Path, pictures: dict[str, NDArray[np.float32]]) -> None:
    for stem, view in pictures.items():
        tifffile.imwrite(folder / f"{stem}.tif", view)


def _pages(folder: Path, pictures: dict[str, NDArray[np.float32]]) -> None:
    tifffile.imwrite(
        folder / "views.tif", np.stack([_sixteen(view) for view in pictures.values()]), photometric="minisblack"
    )


def _mosaic(folder: Path, pictures: dict[str, NDArray[np.float32]]) -> None:
    views = [_sixteen(view) for view in pictures.values()]
    lines = [np.hstack(views[first : first + COLUMNS]) for first in range(0, len(views), COLUMNS)]
    assert cv2.imwrite(str(folder / "views.png"), np.vstack(lines))


png16 = written(".png", _sixteen)

FILES: dict[str, Writer] = {
    "8-bit PNG": written(".png", _eight),
    "JPEG 95": written(".jpg", _coloured, cv2.IMWRITE_JPEG_QUALITY, 95),
    "16-bit TIFF": written(".tiff", _sixteen),
    "float TIFF": _floats,
    "multi-page TIFF": _pages,
    "mosaic in one file": _mosaic,
}

# parameters.cfg of a scene that is in focus where points move by 2 px from view to view.
HCI_FX_PX, HCI_PITCH_MM, HCI_FOCUS_PX = WIDTH * 100 / 35, 10.0, 2.0
HCI = f"""
[intrinsics]
image_resolution_x_px = {WIDTH}
image_resolution_y_px = {HEIGHT}
focal_length_mm = 100
sensor_size_mm = 35
[extrinsics]
num_cams_x = {COLUMNS}
num_cams_y = {ROWS}
baseline_mm = {HCI_PITCH_MM}
focus_distance_m = {HCI_FX_PX * HCI_PITCH_MM / HCI_FOCUS_PX / 1000}
"""


@dataclass(frozen=True)
class Variant:
    """One way in which the scene comes.

    `aligned_px`: by how much each point moves more from node to node. `square`: 7 x 7 views in place of 5 x 7.
    `change`: what is done to the pictures before they get names. `options`, `sidecars`: of the command; further files.
    `kept`: whether a node is in the set. `ratio`: pitch along columns over that along rows. `words`: what is printed.
    """

    names: Names = field(default_factory=Names)
    aligned_px: int = 0
    square: bool = False
    change: Callable[[Views], Views] | None = None
    write: Writer = png16
    options: tuple[str, ...] = ()
    sidecars: dict[str, str] = field(default_factory=dict)
    kept: Callable[[int, int], bool] = lambda row, column: True
    ratio: float = 1.0
    words: str = ""

    def source(self, folder: Path) -> Path:
        """Write the files; return what is to be imported."""
        folder.mkdir()
        views = views_of(self.aligned_px, self.square)
        if self.change is not None:
            views = self.change(views)
        size = (7 if self.square else ROWS), COLUMNS
        self.write(folder, {self.names.stem(node, size): view for node, view in views.items()})
        for name, text in self.sidecars.items():
            (folder / name).write_text(text)
        files = list(folder.iterdir())
        return files[0] if len(files) == 1 else folder
