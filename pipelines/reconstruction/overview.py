"""A set at a glance, beside its reconstruction: all views small, one view large, and how dark it is."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.files import write_json
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import Picture, contact_sheet, grey_levels, white_level, write_png
from faintfield.pipelines.formats.results.records import OVERVIEW_FILE, Brightness, Overview
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.brightness import brightness_within
from faintfield.pipelines.reconstruction.object_region import Region, bright_electrons, object_region

INTEGRAL_IMAGE = "integral_image.png"
REFERENCE_VIEW = "reference_view.png"
NOISE_REFERENCE_VIEW = "noise_reference.png"
BRIGHT_VIEW = "bright_view.png"
REGION_OUTLINED = "object_region_outlined.png"

# Width of the sheet of all views, about as wide as the report.
_SHEET_WIDTH_PX = 1260

# Visible on white, grey and black.
_OUTLINE_RGB = (240, 120, 0)


def write_overview(loaded: ElementalSet, out: Path) -> None:
    """Write the pictures of a set and `overview.json` into `out`; all views share one grey scale."""
    reference = read_frame(loaded.image_paths[loaded.reference_view]).pixels_dn
    black, white = grey_scale_dn(reference)
    columns = _columns(loaded)
    small_px = max(_SHEET_WIDTH_PX // columns, 24)
    small = [_as_seen(_every_nth(read_frame(path).pixels_dn, small_px), white, black) for path in loaded.image_paths]
    write_png(out / INTEGRAL_IMAGE, contact_sheet(small, columns))
    write_png(out / REFERENCE_VIEW, _as_seen(reference, white, black))
    if loaded.noise_reference:
        no_light = read_frame(loaded.noise_reference[0]).pixels_dn
        write_png(out / NOISE_REFERENCE_VIEW, _as_seen(no_light, white, black))
    region, name = object_region(loaded)
    _write_bright_view(loaded, region, out)
    write_json(out / OVERVIEW_FILE, _overview(loaded, (black, white), brightness_within(loaded, region, name)))


def _overview(loaded: ElementalSet, grey_scale_dn: tuple[float, float], brightness: Brightness) -> Overview:
    """Return what overview.json records of a set."""
    noise, exposure_s = loaded.noise, loaded.settings.exposure_s
    return Overview(
        set=loaded.folder.resolve().name,
        views=len(loaded.settings.view),
        grid=_grid(loaded),
        poses=loaded.poses,
        size_px=loaded.settings.camera.size_px,
        exposure_s=exposure_s,
        frames_per_view=loaded.frames_per_view,
        read_noise_e=float(np.sqrt(np.mean(np.square(noise.read_noise_e)))),
        has_noise_reference=bool(loaded.noise_reference),
        quantum_efficiency=noise.quantum_efficiency,
        dark_e=float(np.mean(noise.background_e(exposure_s))),
        grey_scale_dn=grey_scale_dn,
        brightness=brightness,
    )


def _write_bright_view(loaded: ElementalSet, region: Region | None, out: Path) -> None:
    """Write the reference view in plenty of light if there is one, and again with the object region outlined."""
    light_e = bright_electrons(loaded)
    if light_e is None:
        return
    picture = grey_levels(light_e, white_level(light_e))
    write_png(out / BRIGHT_VIEW, picture)
    if region is not None:
        outlined = np.ascontiguousarray(np.dstack([picture] * 3))
        around, _ = cv2.findContours(region.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(outlined, around, -1, _OUTLINE_RGB, max(max(region.shape) // 400, 1))
        write_png(out / REGION_OUTLINED, outlined)


def grey_scale_dn(reference_dn: NDArray[Any]) -> tuple[float, float]:
    """Return black and white of the grey scale of a set, which spans nearly all values of its reference view."""
    black, white = np.quantile(reference_dn, (0.001, 0.999))
    return float(black), float(max(white, black + 1))


def _every_nth(pixels: NDArray[Any], width_px: int) -> NDArray[Any]:
    """Return a frame reduced to about a width by leaving pixels out: averaging would reduce the noise."""
    step = max(round(pixels.shape[1] / width_px), 1)
    return pixels[step // 2 :: step, step // 2 :: step]


def _as_seen(pixels_dn: NDArray[Any], white: float, black: float) -> Picture:
    """Return a frame as 8-bit levels."""
    return grey_levels(pixels_dn, white=white, black=black)


def _columns(loaded: ElementalSet) -> int:
    """Return the number of views in a row of the sheet: the columns of the grid if the nodes are stated."""
    grid = _grid(loaded)
    return int(np.ceil(np.sqrt(len(loaded.settings.view)))) if grid is None else grid[1]


def _grid(loaded: ElementalSet) -> tuple[int, int] | None:
    """Return rows and columns of the grid, None unless every view states its node."""
    nodes = [view.node for view in loaded.settings.view if view.node is not None]
    if len(nodes) < len(loaded.settings.view):
        return None
    rows, columns = (np.ptp(places) + 1 for places in zip(*nodes, strict=True))
    return int(rows), int(columns)
