"""A surface as files: TIFFs with previews, a point cloud, a film, and the record that vouches for them."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from faintfield.pipelines.console import inform
from faintfield.pipelines.formats.exchange.ply import write_points
from faintfield.pipelines.formats.files import remove, sha256, write_record, write_whole
from faintfield.pipelines.formats.image_files import (
    ONE_PIXEL,
    Picture,
    encoded,
    encoded_film,
    light_picture,
    white_level,
    write_plane,
)
from faintfield.pipelines.formats.provenance import Provenance
from faintfield.pipelines.formats.results.records import preview_name
from faintfield.pipelines.formats.results.surface import (
    SURFACE_FILE,
    SurfaceFacts,
    SurfaceFileRecord,
    SurfaceOptions,
    SurfaceRecord,
)
from faintfield.pipelines.formats.units import LightUnit, StatedUnits, units_of
from faintfield.pipelines.reconstruction.depth.depth_map import limits_of_likely, map_picture, robust_limits
from faintfield.pipelines.reconstruction.surface.parallax import FRAME_MS, render_parallax, viewpoints
from faintfield.recon.operator.grid import PlaneGrid

POINTS, FILM = "surface.ply", "parallax.webp"

# What a prior proposed, and how far the data moved the picture from it.
_PROPOSED = ("picture_proposal.tiff", "picture_moved.tiff")

# The depth and its standard deviation, by unit.
_DEPTH_FILES = {
    "mm": ("depth_mm.tiff", "depth_sigma_mm.tiff"),
    "px": ("disparity_px.tiff", "disparity_sigma_px.tiff"),
    "relative": ("depth.tiff", "depth_sigma.tiff"),
}


# Unit of light on the colour bar.
_LIGHT: dict[LightUnit, str] = {"electrons": "electrons", "dn": "DN", "relative": "1 = white"}


@dataclass(frozen=True)
class SurfaceMaps:
    """Maps of a surface, all of one shape (row, column), unless they have colours (row, column, colour).

    `grid` are the samples' directions, x/z and y/z. The picture, its `picture_sigma` and `picture_proposal` are in the
    unit of light of the set, `picture_moved` in standard deviations of the noise. `depth` and `depth_sigma` are in the
    unit of the record, NaN where the depth is not known, and `depth_confidence` is the probability that it is right
    within 2 %. `visibility` counts the pixels that see each sample. The film is rendered from `inverse_depth`, 1/mm
    everywhere, and `aperture_mm`, see `parallax.aperture_of`.
    """

    grid: PlaneGrid
    picture: NDArray[np.floating]
    picture_sigma: NDArray[np.floating]
    depth: NDArray[np.floating]
    depth_sigma: NDArray[np.floating]
    depth_confidence: NDArray[np.floating]
    visibility: NDArray[np.floating] | NDArray[np.integer]
    inverse_depth: NDArray[np.floating]
    aperture_mm: tuple[float, float]
    picture_proposal: NDArray[np.floating] | None = None
    picture_moved: NDArray[np.floating] | None = None


def write_surface(
    folder: Path, maps: SurfaceMaps, facts: SurfaceFacts, origin: Provenance[SurfaceOptions]
) -> SurfaceRecord:
    """Write the files of a surface into a folder, last the record that vouches for them, and return what that says.

    An earlier surface in it is replaced. If a file cannot be written (DiskFull, CannotWrite), there is no record, so
    that nothing vouches for the others.
    """
    remove(folder / SURFACE_FILE)
    depths = [name for of_unit in _DEPTH_FILES.values() for name in of_unit]  # an earlier surface may have another unit
    for name in (POINTS, FILM, *depths, *_PROPOSED, *map(preview_name, (*depths, *_PROPOSED))):
        remove(folder / name)
    levels = light_picture(maps.picture, white_level(maps.picture), tone_curve=units_of(origin).tone_curve)
    points = None if facts.unit == "px" else POINTS
    if points is not None:
        (left, top), pitch, (rows, columns) = maps.grid.origin_mm, maps.grid.pitch_mm, maps.grid.shape
        x, y = left + pitch * np.arange(columns), top + pitch * np.arange(rows)
        write_points(folder / POINTS, maps.depth, x, y, levels, in_mm=facts.unit == "mm")
    record = _record(maps, facts, points, _write_film(folder, maps, levels))
    for name, values, preview in _named_maps(record, maps, levels, units_of(origin)):
        write_plane(folder / name, values, ONE_PIXEL)
        write_whole(folder / preview_name(name), preview)
    hashes = {name: sha256(folder / name) for name in record.files}
    write_record(folder / SURFACE_FILE, SurfaceFileRecord(1, record, hashes, **msgspec.structs.asdict(origin)))
    return record


def _record(maps: SurfaceMaps, facts: SurfaceFacts, points: str | None, film: str | None) -> SurfaceRecord:
    depth, depth_sigma = _DEPTH_FILES[facts.unit]
    proposal, moved = (UNSET, UNSET) if maps.picture_proposal is None else _PROPOSED
    known = np.isfinite(maps.depth)
    return SurfaceRecord(
        **msgspec.structs.asdict(facts),
        picture="picture.tiff",
        picture_sigma="picture_sigma.tiff",
        picture_proposal=proposal,
        picture_moved=moved,
        depth=depth,
        depth_sigma=depth_sigma,
        depth_confidence="depth_confidence.tiff",
        visibility="visibility.tiff",
        points=points,
        film=film,
        shape=maps.grid.shape,
        known_share=float(known.mean()),
        sure_share=float((maps.depth_confidence >= facts.sure_above).mean()),
        median=float(np.median(maps.depth[known])) if known.any() else None,
    )


def _named_maps(
    record: SurfaceRecord, maps: SurfaceMaps, levels: Picture, units: StatedUnits
) -> Iterator[tuple[str, NDArray[np.floating], bytes]]:
    what = "disparity" if record.unit == "px" else "depth"
    yield record.picture, maps.picture, encoded(levels, ".png")
    sigma, proposal, moved = maps.picture_sigma, maps.picture_proposal, maps.picture_moved
    yield record.picture_sigma, sigma, _colour_map(sigma, f"σ of the light ({_LIGHT[units.light]})")
    if proposal is not None and moved is not None:
        yield (
            _PROPOSED[0],
            proposal,
            encoded(light_picture(proposal, white_level(maps.picture), tone_curve=units.tone_curve), ".png"),
        )
        yield _PROPOSED[1], moved, _colour_map(moved, "picture less proposal (σ)")
    confidence = maps.depth_confidence
    sure = confidence >= record.sure_above
    limits = limits_of_likely(maps.depth, confidence)
    yield record.depth, maps.depth, map_picture(maps.depth, f"{what} ({record.unit})", *limits, sure)
    yield record.depth_sigma, maps.depth_sigma, _colour_map(maps.depth_sigma, f"σ of the {what} ({record.unit})")
    yield record.depth_confidence, confidence, map_picture(confidence, f"probability of the {what}", 0.0, 1.0)
    visibility = maps.visibility.astype(np.float32)
    most = max(float(np.nanmax(visibility, initial=1.0)), 1.0)
    yield record.visibility, visibility, map_picture(visibility, "pixels that see it", 0.0, most)


def _colour_map(values: NDArray[np.floating], label: str) -> bytes:
    """Return the preview of a map (row, column[, colour]); one scale for all colours: that of their mean."""
    shown = values if values.ndim == 2 else values.mean(axis=2)
    return map_picture(shown, label, *robust_limits(shown))


def _write_film(folder: Path, maps: SurfaceMaps, levels: Picture) -> str | None:
    if not any(maps.aperture_mm):
        return None
    pitch = maps.grid.pitch_mm
    offsets_mm = viewpoints(maps.inverse_depth, pitch, maps.aperture_mm)
    film = encoded_film(render_parallax(levels, maps.inverse_depth, pitch, offsets_mm), FRAME_MS)
    if film is None:
        inform(f"{FILM} is left out: OpenCV 4.12 or later, built with WebP, is needed to write it")
        return None
    write_whole(folder / FILM, film)
    return FILM
