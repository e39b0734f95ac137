"""The depth map of a sweep, its confidence, and the all-in-focus picture: computed, written, recorded."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.files import remove, sha256, write_record, write_whole
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import ONE_PIXEL, encoded, light_picture, white_level, write_plane
from faintfield.pipelines.formats.results.plane_files import Origin, read_current
from faintfield.pipelines.formats.results.records import DEPTH_MAP_FILE, DepthMapFileRecord, DepthMapRecord, Method
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, unit_of_maps
from faintfield.pipelines.reconstruction.depth.scene_structure import shares_of_depths
from faintfield.pipelines.reconstruction.depth.search import DepthSearch, in_unit
from faintfield.recon.depth.focus import sure_of_lit
from faintfield.recon.surface.confidence import SURE

# The file of the depths by their unit.
_FILES = {"mm": "depth_mm.tiff", "px": "disparity_px.tiff", "relative": "depth.tiff"}

ALL_IN_FOCUS, CONFIDENCE = "all_in_focus", "depth_confidence"

# Hatching of unknown values: two levels of grey (0 to 1), and their period.
_MARK_GREY, _MARK_DARK, _MARK_PERIOD_PX = 0.62, 0.5, 12

# Opacity of colours over the hatching where a map is not sure.
_UNSURE_ALPHA = 0.3

# Widths in inches of the picture and of the map in it, and the height of what is not the map.
_PICTURE_WIDTH_IN, _MAP_WIDTH_IN, _MARGIN_IN = 8.6, 7.2, 0.6

# Size of letters, to be read where a page shows the picture at half its size, and their colour, to be read on white and
# on dark pages.
_FONT_PT, _INK = 15, "#777777"

# Quantiles of the known values between which a map is drawn if nothing else limits it.
_QUANTILES = (0.01, 0.99)

# Widest range of a map of equal values, as a share of them, so that rounding errors are not drawn as a relief.
_MIN_RANGE = 1e-3


def kept_depth_map(folders: Mapping[Method, Path], origins: Mapping[Method, Origin]) -> DepthMapRecord | None:
    """Return the record of the maps if each method's folder has those of its provenance."""
    kept = [
        read_current(folder / DEPTH_MAP_FILE, DepthMapFileRecord, origins[method]) for method, folder in folders.items()
    ]
    return kept[0].depth_map if kept and kept[0] is not None and all(kept) else None


def write_depth_map(
    elemental_set: ElementalSet,
    search: DepthSearch,
    planes: Mapping[tuple[Method, float], Path],
    disparities_px: Mapping[float, float],
    origins: Mapping[Method, Origin],
) -> DepthMapRecord:
    """Write the maps and the all-in-focus picture into each folder of planes, and return their record.

    The search is that in the range of the sweep; maps are in px if all depths have a disparity.
    """
    depths = sorted({depth for _, depth in planes})
    record, index, pictures = _maps(elemental_set, search, depths, disparities_px)
    for method, folder in {method: path.parent for (method, _), path in planes.items()}.items():
        remove(folder / DEPTH_MAP_FILE)
        sharp = _all_in_focus([planes[method, depth] for depth in depths], index)
        preview = encoded(light_picture(sharp, white_level(sharp), tone_curve=elemental_set.units.tone_curve), ".png")
        hashes: dict[str, str] = {}
        for name, (values, picture) in (pictures | {record.all_in_focus: (sharp, preview)}).items():
            path = folder / name
            write_plane(path, values, ONE_PIXEL)
            write_whole(path.with_suffix(".png"), picture)
            hashes |= {written.name: sha256(written) for written in (path, path.with_suffix(".png"))}
        vouching = DepthMapFileRecord(1, record, hashes, **msgspec.structs.asdict(origins[method]))
        write_record(folder / DEPTH_MAP_FILE, vouching)
    return record


def _maps(
    elemental_set: ElementalSet,
    search: DepthSearch,
    depths_mm: Sequence[float],
    disparities_px: Mapping[float, float],
) -> tuple[DepthMapRecord, NDArray[np.float64], dict[str, tuple[NDArray[np.floating], bytes]]]:
    """Return the record, between which planes each sample (row, column) lies, and depths and confidence by file name.

    Each map has its preview. Depths are NaN where they are not known.
    """
    inverse_depth, confidence = search.estimate.inverse_depth, search.estimate.confidence
    unit = unit_of_maps(elemental_set.units, as_px=bool(disparities_px))
    scale = [
        disparities_px[depth] if disparities_px else in_unit(elemental_set, 1 / depth, unit) for depth in depths_mm
    ]
    known = confidence >= SURE
    values = np.clip(in_unit(elemental_set, inverse_depth, unit), min(scale), max(scale))
    record = DepthMapRecord(
        file=_FILES[unit],
        confidence=f"{CONFIDENCE}.tiff",
        all_in_focus=f"{ALL_IN_FOCUS}.tiff",
        unit=unit,
        bins_px=search.bins_px,
        sure_above=SURE,
        sure_share=float(known.mean()),
        median=float(np.median(values[known])) if known.any() else None,
        share_of_sure=shares_of_depths(search),
        sure_of_lit=sure_of_lit(confidence, search.estimate.lit_share),
    )
    values = np.where(known, values, np.nan)
    label = "disparity (px)" if unit == "px" else f"depth ({unit})"
    pictures: dict[str, tuple[NDArray[np.floating], bytes]] = {
        record.file: (values, map_picture(values, label, min(scale), max(scale))),
        record.confidence: (confidence, map_picture(confidence, "probability of the depth", 0.0, 1.0)),
    }
    return record, np.interp(-inverse_depth, -1 / np.asarray(depths_mm), np.arange(len(depths_mm))), pictures


def _all_in_focus(paths: Sequence[Path], index: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return each sample (row, column[, colour]) interpolated between the two planes around its depth.

    The samples are those of the farthest plane, which has the most if all planes have the same pitch. One plane at a
    time is in memory.
    """
    sharp: NDArray[np.float32] | None = None
    for number, path in reversed(list(enumerate(paths))):
        plane = np.asarray(read_frame(path).pixels_dn, np.float32)
        if sharp is None:
            rows, columns = plane.shape[:2]
            at = cv2.resize(index.astype(np.float32), (columns, rows), interpolation=cv2.INTER_NEAREST)
        elif plane.shape != sharp.shape:
            plane = cv2.resize(plane, (columns, rows), interpolation=cv2.INTER_LINEAR)
        share = np.maximum(1 - np.abs(at - number), 0)
        share = share if plane.ndim == 2 else share[:, :, np.newaxis]
        part = np.where(share > 0, plane * share, 0)  # unknown samples of other planes do not matter
        sharp = part if sharp is None else sharp + part
    assert sharp is not None
    return sharp


def map_picture(
    values: NDArray[np.floating], label: str, low: float, high: float, sure: NDArray[np.bool_] | None = None
) -> bytes:
    """Return a map (row, column) as PNG in colours from `low` to `high`; NaNs are hatched grey.

    Where the map is not `sure`, the hatching shows through. The colour bar ends in a point where values lie beyond it.
    """
    from matplotlib.figure import Figure  # its memory is needed after that of the images

    rows, columns = np.indices(values.shape)
    hatch = np.where((rows + columns) % _MARK_PERIOD_PX < 2, _MARK_DARK, _MARK_GREY)
    figure = Figure(
        figsize=(_PICTURE_WIDTH_IN, _MARGIN_IN + _MAP_WIDTH_IN * values.shape[0] / values.shape[1]),
        layout="constrained",
    )
    axes = figure.subplots()
    axes.imshow(hatch, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    shown = axes.imshow(values, cmap="viridis", vmin=low, vmax=high, interpolation="nearest")
    if sure is not None:
        shown.set_alpha(np.where(sure, 1.0, _UNSURE_ALPHA))
    axes.set_axis_off()
    below, above = bool((values < low).any()), bool((values > high).any())
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, above), "neither")
    bar = figure.colorbar(shown, extend=extend, fraction=0.05, pad=0.02)
    bar.set_label(label, size=_FONT_PT, color=_INK)
    bar.ax.tick_params(labelsize=_FONT_PT, colors=_INK)
    bar.outline.set_edgecolor(_INK)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110, transparent=True, metadata={"Software": None})
    return content.getvalue()


def limits_of_likely(depth: NDArray[np.floating], confidence: NDArray[np.floating]) -> tuple[float, float]:
    """Return limits between which nearly all depths lie that are rather right than wrong; of all, if there are none."""
    likely = confidence >= 0.5
    return robust_limits(depth[likely] if likely.any() else depth)


def robust_limits(values: NDArray[np.floating]) -> tuple[float, float]:
    """Return limits between which nearly all known values of a map lie; 0 and 1 if none is known."""
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0, 1.0
    low, high = np.quantile(known, _QUANTILES).tolist()
    room = max(_MIN_RANGE * max(abs(low), abs(high)) - (high - low), 0) / 2 or (0.5 if high == low else 0)
    return low - room, high + room
