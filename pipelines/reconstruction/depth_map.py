"""The depth map of a sweep, how sure it is, and the picture that is sharp everywhere: computed, written, recorded."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.console import progress
from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.files import remove, sha256, write_json, write_whole
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import grey_levels, white_level, write_plane, write_png
from faintfield.pipelines.formats.large_arrays import memory_or_file
from faintfield.pipelines.formats.results.plane_files import vouched_for
from faintfield.pipelines.formats.sets.elemental_set import LoadedSet
from faintfield.pipelines.reconstruction.channels import OperatorFactory, channel_layouts, load_channel, plane_grid
from faintfield.pipelines.reconstruction.planes import Method
from faintfield.recon.depth.agreement import Agreement, DepthEstimate, agreement, bins_for, depth_map
from faintfield.recon.depth.best_focus import SURE

LEAST_DEPTHS = 5

# Bins are no larger than leave so many across the detector.
_LEAST_ACROSS = 8

ALL_IN_FOCUS, CONFIDENCE = "all_in_focus", "depth_confidence"
DEPTH_MAP_FILE = "depth_map.json"

_MARK_GREY, _MARK_DARK, _MARK_PERIOD_PX = 0.62, 0.5, 12


def require_sweep(depths: Sequence[float]) -> None:
    """Refuse a depth map from too few depths (WrongUsage)."""
    if len(depths) < LEAST_DEPTHS:
        raise WrongUsage(
            f"--depth-map compares depths, and {len(depths)} are given; give at least {LEAST_DEPTHS}, by --sweep-mm "
            "or --sweep-px"
        )


@dataclass(frozen=True)
class Compared:
    """How the views agree at each depth, all colours together.

    Attributes
    ----------
    planes : list of Agreement
        In the order of the depths.
    depths_mm : sequence of float
        The depths.
    bins_px : int
        So many detector pixels across have been added up.
    """

    planes: list[Agreement]
    depths_mm: Sequence[float]
    bins_px: int

    def depth_map(self) -> DepthEstimate:
        """Return where each sample is sharp."""
        return depth_map(self.planes, np.asarray(self.depths_mm))


def compared_depths(
    loaded: LoadedSet, depths_mm: Sequence[float], out: Path, *, least_bins_px: int = 1, bins_px: int | None = None
) -> Compared:
    """Compare the views at each depth; one colour's images are in memory at a time, or in a file in `out`.

    Pixels are added up in bins of `bins_px`; without, in bins of at least `least_bins_px`, more where the light asks
    for it.
    """
    planes: list[Agreement] = []
    bins = 0
    for layout in channel_layouts(loaded):
        images = load_channel(loaded, layout, memory_or_file(out))
        step = max(layout.lattices[0].step)
        if bins_px is not None:
            bins = bins_px // step
        elif not bins:
            middle_mm = sorted(depths_mm)[len(depths_mm) // 2]
            needed = bins_for(
                OperatorFactory(loaded, layout, images).at_depth(middle_mm, plane_grid(loaded, middle_mm)), images
            )
            bins = min(max(needed, -(-least_bins_px // step)), min(layout.lattices[0].shape) // _LEAST_ACROSS)
        images = images.binned(bins)
        factory = OperatorFactory(loaded, layout, images, bins=bins)
        found = [
            agreement(factory.at_depth(depth, plane_grid(loaded, depth).binned(bins * step)), images)
            for depth in progress(depths_mm, f"comparing views, {layout.name}")
        ]
        planes = [_both(*pair) for pair in zip(planes, found, strict=True)] if planes else found
    return Compared(planes, depths_mm, bins * step)


def _both(one: Agreement, other: Agreement) -> Agreement:
    """Return what two colours say together."""
    return Agreement(*(a + b for a, b in zip(one, other, strict=True)))


def write_depth_map(
    loaded: LoadedSet,
    planes: Mapping[tuple[Method, float], Path],
    disparities_px: Mapping[float, float],
    origins: Mapping[Method, dict[str, Any]],
    out: Path,
) -> dict[str, Any]:
    """Write the maps and the picture into each folder of planes, and return what reconstruction.json says of them.

    Parameters
    ----------
    loaded : LoadedSet
        The set.
    planes : mapping of (method, depth in mm) to Path
        The planes' files; each method has a folder.
    disparities_px : mapping of depth in mm to px
        Of every depth, where disparities were asked for: the map then is in px.
    origins : mapping of Method to dict
        What each method's planes are made of: maps that were made of the same stay.
    out : Path
        Where a file may lie that holds the images while memory is short.
    """
    folders = {method: path.parent for (method, _), path in planes.items()}
    there = [_finished(folder, origins[method]) for method, folder in folders.items()]
    if there and there[0] is not None and all(there):
        return there[0]
    depths = sorted({depth for _, depth in planes})
    compared = compared_depths(loaded, depths, out)
    found, bins = compared.depth_map(), compared.bins_px
    scale = [disparities_px[depth] if disparities_px else depth for depth in depths]
    unit, name = ("px", "disparity_px") if disparities_px else ("mm", "depth_mm")
    shape = plane_grid(loaded, depths[0]).shape
    index, confidence = (_enlarged(part, shape, bins) for part in (found.index, found.confidence))
    values = np.interp(index, np.arange(len(depths)), scale)
    values[confidence < SURE] = np.nan
    known = np.isfinite(values)
    record = {
        "file": f"{name}.tiff",
        "confidence": f"{CONFIDENCE}.tiff",
        "all_in_focus": f"{ALL_IN_FOCUS}.tiff",
        "unit": unit,
        "bins_px": bins,
        "sure_above": SURE,
        "sure_share": float(known.mean()),
        "median": float(np.median(values[known])) if known.any() else None,
    }
    for method, folder in folders.items():
        remove(folder / DEPTH_MAP_FILE)
        _write(folder, name, unit, values, confidence, scale)
        sharp = _all_in_focus([planes[method, depth] for depth in depths], index)
        write_plane(folder / f"{ALL_IN_FOCUS}.tiff", sharp, 1.0)
        write_png(folder / f"{ALL_IN_FOCUS}.png", grey_levels(sharp, white_level(sharp)))
        files = [f"{stem}.{suffix}" for stem in (name, CONFIDENCE, ALL_IN_FOCUS) for suffix in ("tiff", "png")]
        hashes = {file: sha256(folder / file) for file in files}
        write_json(folder / DEPTH_MAP_FILE, {"format": 1, "depth_map": record, "sha256": hashes, **origins[method]})
    return record


def _finished(folder: Path, origin: dict[str, Any]) -> dict[str, Any] | None:
    """Return what is known of maps that are there, None unless they are whole and made of what they have to be."""
    content = vouched_for(folder / DEPTH_MAP_FILE, origin)
    return None if content is None else content["depth_map"]


def _write(
    folder: Path,
    name: str,
    unit: str,
    values: NDArray[np.floating],
    confidence: NDArray[np.floating],
    scale: Sequence[float],
) -> None:
    """Write both maps with their previews."""
    words = "disparity (px)" if unit == "px" else "depth (mm)"
    write_plane(folder / f"{name}.tiff", values, 1.0)
    write_plane(folder / f"{CONFIDENCE}.tiff", confidence, 1.0)
    write_whole(folder / f"{name}.png", _picture(values, words, min(scale), max(scale)))
    write_whole(folder / f"{CONFIDENCE}.png", _picture(confidence, "probability of the depth", 0.0, 1.0))


def _picture(values: NDArray[np.floating], words: str, low: float, high: float) -> bytes:
    """Return a map as PNG, in colours with its scale; where it is not known it is hatched grey."""
    from matplotlib.figure import Figure  # loading it costs most of a second

    rows, columns = np.indices(values.shape)
    hatch = np.where((rows + columns) % _MARK_PERIOD_PX < 2, _MARK_DARK, _MARK_GREY)
    figure = Figure(figsize=(8.6, 0.6 + 7.2 * values.shape[0] / values.shape[1]), layout="constrained")
    axes = figure.subplots()
    axes.imshow(hatch, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    shown = axes.imshow(values, cmap="viridis", vmin=low, vmax=high, interpolation="nearest")
    axes.set_axis_off()
    figure.colorbar(shown, label=words)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110, metadata={"Software": None})
    return content.getvalue()


def _enlarged(part: NDArray[np.floating], shape: tuple[int, int], bins: int) -> NDArray[np.float64]:
    """Return a map of bins on the samples of the planes; what is left at the far edges takes its neighbours' values."""
    whole = np.kron(part, np.ones((bins, bins), part.dtype))[: shape[0], : shape[1]]
    missing = [(0, size - known) for size, known in zip(shape, whole.shape, strict=True)]
    return np.asarray(np.pad(whole, missing, "edge"), np.float64)


def _all_in_focus(paths: Sequence[Path], index: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return of each sample what the two planes around its depth say, (row, column[, colour]), one plane in memory.

    Samples are those of the farthest plane, which has the most where all planes have one pitch.
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
        part = plane * (share if plane.ndim == 2 else share[:, :, np.newaxis])
        sharp = part if sharp is None else sharp + part
    assert sharp is not None
    return sharp
