"""The depth map of a sweep, its confidence, and the all-in-focus picture: computed, written, recorded."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.console import progress
from faintfield.pipelines.formats.files import remove, sha256, write_record, write_whole
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import encoded, grey_levels, white_level, write_plane
from faintfield.pipelines.formats.large_arrays import memory_or_file
from faintfield.pipelines.formats.results.plane_files import Origin, read_current
from faintfield.pipelines.formats.results.records import DEPTH_MAP_FILE, DepthMapFileRecord, DepthMapRecord, Method
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.channels import channel_layouts, load_channel
from faintfield.pipelines.reconstruction.map_pictures import map_picture
from faintfield.pipelines.reconstruction.operators import OperatorFactory, plane_grid
from faintfield.recon.depth.agreement import Agreement, DepthEstimate, agreement, bins_for, depth_map
from faintfield.recon.depth.focus import SURE

# Fewest bins across the detector: limits the size of a bin.
_MIN_BINS_ACROSS = 8

ALL_IN_FOCUS, CONFIDENCE = "all_in_focus", "depth_confidence"


@dataclass(frozen=True)
class Compared:
    """The agreement of the views at each depth, all colours together.

    Attributes
    ----------
    planes : list of Agreement
        In the order of the depths.
    depths_mm : sequence of float
        The depths.
    bins_px : int
        Width of the bins in which pixels were added up, in detector pixels.
    """

    planes: list[Agreement]
    depths_mm: Sequence[float]
    bins_px: int

    def depth_map(self) -> DepthEstimate:
        """Return where each sample is sharp."""
        return depth_map(self.planes, np.asarray(self.depths_mm))


def compared_depths(
    loaded: ElementalSet, depths_mm: Sequence[float], out: Path, *, min_bins_px: int = 1, bins_px: int | None = None
) -> Compared:
    """Compare the views at each depth; the images of one colour at a time are in memory, or in a file in `out`.

    Pixels are added up in bins of `bins_px`; by default in bins of at least `min_bins_px`, larger ones in low light.
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
                OperatorFactory(loaded, layout, images).at(middle_mm, plane_grid(loaded, middle_mm)), images
            )
            bins = min(max(needed, -(-min_bins_px // step)), min(layout.lattices[0].shape) // _MIN_BINS_ACROSS)
        images = images.binned(bins)
        factory = OperatorFactory(loaded, layout, images, bins=bins)
        found = [
            agreement(factory.at(depth, plane_grid(loaded, depth).binned(bins * step)), images)
            for depth in progress(depths_mm, f"comparing views, {layout.name}")
        ]
        planes = [_sum(*pair) for pair in zip(planes, found, strict=True)] if planes else found
    return Compared(planes, depths_mm, bins * step)


def _sum(one: Agreement, other: Agreement) -> Agreement:
    """Return the agreement of two colours together."""
    return Agreement(*(a + b for a, b in zip(one, other, strict=True)))


@dataclass(frozen=True)
class _Map:
    """A depth map on the samples of the planes.

    Attributes
    ----------
    record : DepthMapRecord
        What reconstruction.json records of it.
    scale : list of float
        Depth in mm, or disparity in px, of each plane.
    index : float array (row, column)
        Between which planes each sample is sharp.
    values, confidence : float array (row, column)
        In the unit of the scale, NaN where not known; and the probability that this is right.
    """

    record: DepthMapRecord
    scale: list[float]
    index: NDArray[np.float64]
    values: NDArray[np.float64]
    confidence: NDArray[np.float64]


def write_depth_map(
    loaded: ElementalSet,
    planes: Mapping[tuple[Method, float], Path],
    disparities_px: Mapping[float, float],
    origins: Mapping[Method, Origin],
    out: Path,
) -> DepthMapRecord:
    """Write the maps and the all-in-focus picture into each folder of planes, and return their record.

    Parameters
    ----------
    loaded : ElementalSet
        The set.
    planes : mapping of (method, depth in mm) to Path
        Files of the planes; each method has a folder.
    disparities_px : mapping of depth in mm to px
        Disparity of every depth if disparities were asked for: the map then is in px.
    origins : mapping of Method to Provenance
        Provenance of each method's planes: maps with the same are kept.
    out : Path
        Folder of a temporary file for the images if memory is short.
    """
    folders = {method: path.parent for (method, _), path in planes.items()}
    kept = [
        read_current(folder / DEPTH_MAP_FILE, DepthMapFileRecord, origins[method]) for method, folder in folders.items()
    ]
    if kept and kept[0] is not None and all(kept):
        return kept[0].depth_map
    depths = sorted({depth for _, depth in planes})
    compared = compared_depths(loaded, depths, out)
    found = _map_of(loaded, compared, disparities_px)
    for method, folder in folders.items():
        remove(folder / DEPTH_MAP_FILE)
        sharp = _all_in_focus([planes[method, depth] for depth in depths], found.index)
        hashes = _write_maps(folder, found, sharp)
        vouching = DepthMapFileRecord(1, found.record, hashes, **msgspec.structs.asdict(origins[method]))
        write_record(folder / DEPTH_MAP_FILE, vouching)
    return found.record


def _map_of(loaded: ElementalSet, compared: Compared, disparities_px: Mapping[float, float]) -> _Map:
    """Return the depth map of compared depths on the samples of the planes, in px if there are disparities."""
    depths = compared.depths_mm
    scale = [disparities_px[depth] if disparities_px else depth for depth in depths]
    found = compared.depth_map()
    shape = plane_grid(loaded, depths[0]).shape
    index, confidence = (_enlarged(part, shape, compared.bins_px) for part in (found.index, found.confidence))
    values = np.interp(index, np.arange(len(depths)), scale)
    values[confidence < SURE] = np.nan
    known = np.isfinite(values)
    record = DepthMapRecord(
        file="disparity_px.tiff" if disparities_px else "depth_mm.tiff",
        confidence=f"{CONFIDENCE}.tiff",
        all_in_focus=f"{ALL_IN_FOCUS}.tiff",
        unit="px" if disparities_px else "mm",
        bins_px=compared.bins_px,
        sure_above=SURE,
        sure_share=float(known.mean()),
        median=float(np.median(values[known])) if known.any() else None,
    )
    return _Map(record, scale, index, values, confidence)


def _write_maps(folder: Path, found: _Map, sharp: NDArray[np.float32]) -> dict[str, str]:
    """Write the maps and the all-in-focus picture with their previews; return their hashes by file name."""
    record = found.record
    label = "disparity (px)" if record.unit == "px" else "depth (mm)"
    pictures: dict[str, tuple[NDArray[np.floating], bytes]] = {
        record.file: (found.values, map_picture(found.values, label, min(found.scale), max(found.scale))),
        record.confidence: (found.confidence, map_picture(found.confidence, "probability of the depth", 0.0, 1.0)),
        record.all_in_focus: (sharp, encoded(grey_levels(sharp, white_level(sharp)), ".png")),
    }
    for name, (values, picture) in pictures.items():
        write_plane(folder / name, values, 1.0)
        write_whole((folder / name).with_suffix(".png"), picture)
    files = [path for name in pictures for path in (folder / name, (folder / name).with_suffix(".png"))]
    return {path.name: sha256(path) for path in files}


def _enlarged(part: NDArray[np.floating], shape: tuple[int, int], bins: int) -> NDArray[np.float64]:
    """Return a map of bins on the samples of the planes; samples beyond the last bin repeat its value."""
    whole = np.kron(part, np.ones((bins, bins), part.dtype))[: shape[0], : shape[1]]
    missing = [(0, size - known) for size, known in zip(shape, whole.shape, strict=True)]
    return np.asarray(np.pad(whole, missing, "edge"), np.float64)


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
        part = plane * (share if plane.ndim == 2 else share[:, :, np.newaxis])
        sharp = part if sharp is None else sharp + part
    assert sharp is not None
    return sharp
