"""A surface made by hand, a slanted floor and a ball before it, written as `reconstruct --surface` does."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.records import Certificate, WeightScore
from faintfield.pipelines.formats.results.surface import (
    HeldOutRecord,
    SurfaceChannel,
    SurfaceFacts,
    SurfaceOptions,
    SurfaceRecord,
)
from faintfield.pipelines.reconstruction.surface.files import SurfaceMaps, write_surface
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.surface.estimate import SurfaceEstimate
from faintfield.recon.surface.pinhole_views import PinholeViews

# What a search for depths is given: the views, and the 1/depths to compare.
type Searches = list[tuple[PinholeViews, NDArray[np.float64]]]

# What the search that stands in for the slow one finds everywhere.
FOUND_MM, FOUND_CONFIDENCE, FOUND_SPACING = 600.0, 0.5, 1.0

SHAPE, PITCH = (90, 120), 1 / 150
GRID = PlaneGrid(SHAPE, PITCH, (-59.5 * PITCH, -44.5 * PITCH))

OPTIONS = SurfaceOptions(
    depth_range_mm=None, penalty_weight="auto", penalty="tv", likelihood="poisson-gaussian", poses="measured"
)


def surface_maps(*, colours: int = 1) -> SurfaceMaps:
    """Return maps of a floor from 800 mm (above) to 500 mm (below) and a ball, unknown in the lower right corner."""
    generator = np.random.default_rng(16)
    rows, columns = np.indices(SHAPE)
    ball = (rows - 40) ** 2 + (columns - 50) ** 2 < 20**2
    inverse_depth = np.where(ball, 1 / 450, 1 / 800 + (1 / 500 - 1 / 800) * rows / SHAPE[0])
    texture = generator.uniform(0.2, 1, (*SHAPE, colours))
    picture = np.where(ball[:, :, np.newaxis], 2 + texture, texture)
    unknown = (rows > 80) & (columns > 100)
    depth = np.where(unknown, np.nan, 1 / inverse_depth)
    if colours == 1:
        picture = picture[:, :, 0]
    return SurfaceMaps(
        grid=GRID,
        picture=picture,
        picture_sigma=0.1 * np.sqrt(picture),
        depth=depth,
        depth_sigma=0.004 * depth,
        depth_confidence=np.where(unknown, 0.2, np.where(ball, 0.99, 0.85)),
        visibility=np.where(ball, 49, 30),
        inverse_depth=inverse_depth,
        aperture_mm=(300.0, 240.0),
    )


def surface_facts(unit: str = "mm", channels: tuple[str, ...] = ("grey",)) -> SurfaceFacts:
    """Return what an estimation could say of these maps."""
    solved = [
        SurfaceChannel(
            channel=channel,
            penalty_weight=0.05,
            penalty_weight_chosen="cross-validation",
            penalty_weight_curve=[WeightScore(0.02, 1.1), WeightScore(0.05, 1.0), WeightScore(0.1, 1.2)],
            certificate=Certificate(kind="relative distance", value=0.004, tolerance=0.01, reached=True),
            passes=31,
            likelihood="exact",
            mean_e=0.61,
        )
        for channel in channels
    ]
    return SurfaceFacts(
        unit="mm" if unit == "mm" else "px",
        searched=(400.0, 900.0) if unit == "mm" else (-14.0, -6.0),
        range_found=True,
        depths=64,
        bins_px=2,
        rounds=3,
        sure_above=0.9,
        held_out=HeldOutRecord(views=[3, 24, 40], pixels=30_000, surface=1.012, planes=1.34, neighbours=1.18),
        channels=solved,
        wall_time_s=12.5,
    )


def write_example(folder: Path, *, unit: str = "mm", colours: int = 1) -> SurfaceRecord:
    """Write a surface into a folder, and return its record."""
    folder.mkdir(parents=True, exist_ok=True)
    channels = ("grey",) if colours == 1 else ("red", "green", "blue")
    origin = provenance("reconstruct", OPTIONS, {"elemental.toml": "0" * 64})
    return write_surface(folder, surface_maps(colours=colours), surface_facts(unit, channels), origin)


def found_at_once(views: PinholeViews) -> SurfaceEstimate:
    """Return one depth everywhere, with one probability."""
    shape = views.grid.shape
    depths, confidence = np.full(shape, 1 / FOUND_MM), np.full(shape, FOUND_CONFIDENCE, np.float32)
    return SurfaceEstimate(depths, confidence, rounds=2, prediction=None, lit_share=1.0, spacing_needed=FOUND_SPACING)
