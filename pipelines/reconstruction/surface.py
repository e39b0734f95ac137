"""One picture, sharp everywhere, with the depth of each of its samples: `reconstruct --surface`."""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfinv

from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.files import remove_leftovers
from faintfield.pipelines.formats.large_arrays import memory_or_file
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.plane_files import read_current
from faintfield.pipelines.formats.results.records import DEPTH_MAP_FILE, SolveRecord
from faintfield.pipelines.formats.results.surface import (
    SURFACE_FILE,
    HeldOutRecord,
    SurfaceChannel,
    SurfaceFacts,
    SurfaceFileRecord,
    SurfaceRecord,
)
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.autofocus import searched_range_mm
from faintfield.pipelines.reconstruction.channels import ChannelLayout, channel_layouts, load_channel
from faintfield.pipelines.reconstruction.luminance import default_bins, luminance
from faintfield.pipelines.reconstruction.operators import OperatorFactory, plane_grid
from faintfield.pipelines.reconstruction.parallax import aperture_of
from faintfield.pipelines.reconstruction.planes import Settings, mean_e, solve
from faintfield.pipelines.reconstruction.surface_files import SurfaceMaps, write_surface
from faintfield.pipelines.reconstruction.surface_request import SurfaceRequest
from faintfield.recon.solver.collaborative import refined
from faintfield.recon.surface.confidence import RIGHT_WITHIN, SURE, UNKNOWN_BELOW
from faintfield.recon.surface.estimate import SurfaceEstimate, estimate_surface
from faintfield.recon.surface.held_out import Prediction
from faintfield.recon.surface.pinhole_views import PinholeViews
from faintfield.recon.surface.sweep import equal_steps, found_range

# Fewest views whose halves can find depths by each other's light.
_MIN_VIEWS = 4


@dataclass(frozen=True)
class _Light:
    """One colour of the picture.

    Attributes
    ----------
    picture, sigma, visibility : float arrays (row, column)
        Light and its standard deviation in electrons; number of views that see each sample.
    record : SolveRecord
        How it was solved.
    """

    picture: NDArray[np.floating]
    sigma: NDArray[np.floating]
    visibility: NDArray[np.floating]
    record: SolveRecord


def reconstruct_surface(loaded: ElementalSet, out: Path, request: SurfaceRequest) -> SurfaceRecord:
    """Reconstruct the surface of a set, and write it with its record; one that is up to date is kept.

    The caller has `out` to itself, see `formats.files.exclusive`.

    Raises
    ------
    WrongUsage
        The set has too few views, or `out` holds a depth map whose files have the same names.
    NothingInFocus
        No range of depths is given, and none is found.
    """
    started = time.monotonic()
    _check(loaded, out)
    origin = provenance("reconstruct", request.options(loaded.poses), dict(loaded.input_hashes()))
    kept = read_current(out / SURFACE_FILE, SurfaceFileRecord, origin)
    if kept is not None:
        return kept.surface
    remove_leftovers(out)
    bins = default_bins(loaded)
    views = luminance(loaded, bins)
    nodes = _nodes(loaded)
    far, near = _range(loaded, views, nodes, request)
    depths = equal_steps(views, far, near)
    inform(f"surface between {1 / near:.4g} and {1 / far:.4g} mm: comparing {len(depths)} depths")
    estimate = estimate_surface(views, depths, nodes)
    del views
    inverse_depth = _enlarged(estimate.inverse_depth, plane_grid(loaded, 1.0).shape, bins)
    lights = {
        layout.name: _light(loaded, layout, inverse_depth, request.settings, out)
        for layout in progress(channel_layouts(loaded), "picture")
    }
    facts = SurfaceFacts(
        unit=request.unit,
        searched=tuple(_in_unit(loaded, np.array([near, far]), request.unit).tolist()),
        range_found=request.depth_range_mm is None,
        depths=len(depths),
        bins_px=bins,
        rounds=estimate.rounds,
        sure_above=SURE,
        held_out=_held_out(estimate.prediction),
        channels=[_channel(name, light) for name, light in lights.items()],
        wall_time_s=time.monotonic() - started,
    )
    maps = _maps(loaded, inverse_depth, estimate, list(lights.values()), request.unit, bins)
    return write_surface(out, maps, facts, origin)


def _check(loaded: ElementalSet, out: Path) -> None:
    """Refuse sets and folders for which no surface can be made."""
    views = len(loaded.settings.view)
    if views < _MIN_VIEWS:
        raise WrongUsage(f"--surface needs at least {_MIN_VIEWS} views, and the set has {views}; capture more nodes")
    if (out / DEPTH_MAP_FILE).exists():
        raise WrongUsage(
            f"{out}: holds the depth map of a sweep, whose files have the names of the surface's; give another --out"
        )


def _nodes(loaded: ElementalSet) -> NDArray[np.intp]:
    """Return row and column of the node of each view; a row of views if no nodes are stated."""
    views = loaded.settings.view
    if any(view.node is None for view in views):
        return np.array([(0, index) for index in range(len(views))])
    return np.array([view.node for view in views])


def _range(
    loaded: ElementalSet, views: PinholeViews, nodes: NDArray[np.intp], request: SurfaceRequest
) -> tuple[float, float]:
    """Return the range of 1/depth, far and near, in 1/mm."""
    if request.depth_range_mm is not None:
        near_mm, far_mm = sorted(request.depth_range_mm)
        return 1 / far_mm, 1 / near_mm
    near_mm, far_mm = searched_range_mm(loaded)
    return found_range(views, nodes, 1 / far_mm, 1 / near_mm)


def _light(
    loaded: ElementalSet, layout: ChannelLayout, inverse_depth: NDArray[np.floating], settings: Settings, out: Path
) -> _Light:
    """Return one colour of the picture on a surface of known depth."""
    images = load_channel(loaded, layout, memory_or_file(out))
    factory = OperatorFactory(loaded, layout, images)
    operator = factory.of_surface(inverse_depth, plane_grid(loaded, 1.0))
    solution = solve(operator, images, "pmlem", replace(settings, uncertainty=True))
    return _Light(
        refined(operator, images, solution.plane),
        solution.sidecars["sigma"],
        operator.coverage(),
        solution.record,
    )


def _channel(name: str, light: _Light) -> SurfaceChannel:
    """Return the record of one colour."""
    record = light.record
    return SurfaceChannel(
        channel=name,
        penalty_weight=record.penalty_weight,
        penalty_weight_chosen=record.penalty_weight_chosen,
        penalty_weight_curve=record.penalty_weight_curve or None,
        certificate=record.certificate,
        passes=record.passes,
        likelihood=record.likelihood or "",
        mean_e=mean_e(light.picture),
    )


def _held_out(prediction: Prediction | None) -> HeldOutRecord | None:
    """Return the record of the views that were left out."""
    if prediction is None:
        return None
    return HeldOutRecord(
        views=prediction.views.tolist(),
        pixels=prediction.pixels,
        surface=prediction.surface,
        planes=prediction.planes,
        neighbours=prediction.neighbours,
    )


def _maps(
    loaded: ElementalSet,
    inverse_depth: NDArray[np.float64],
    estimate: SurfaceEstimate,
    lights: list[_Light],
    unit: Literal["mm", "px"],
    bins: int,
) -> SurfaceMaps:
    """Return what is known of each sample."""
    grid = plane_grid(loaded, 1.0)
    confidence = _enlarged(estimate.confidence, grid.shape, bins).astype(np.float32)
    known = confidence >= UNKNOWN_BELOW
    depth = _in_unit(loaded, inverse_depth, unit)
    # Of a normal distribution that lies within the tolerance with this probability
    sigma = RIGHT_WITHIN / (np.sqrt(2) * erfinv(np.maximum(confidence, UNKNOWN_BELOW)))
    slope = np.abs(_in_unit(loaded, inverse_depth * (1 + 1e-6), unit) - depth) / 1e-6
    colours = len(lights) > 1
    return SurfaceMaps(
        grid=grid,
        picture=np.stack([light.picture for light in lights], -1) if colours else lights[0].picture,
        picture_sigma=np.stack([light.sigma for light in lights], -1) if colours else lights[0].sigma,
        depth=np.where(known, depth, np.nan),
        depth_sigma=np.where(known, sigma * slope, np.nan),
        depth_confidence=confidence,
        visibility=np.mean([light.visibility for light in lights], axis=0),
        inverse_depth=inverse_depth,
        aperture_mm=aperture_of(loaded.poses_rt_cam_ref),
    )


def _in_unit(
    loaded: ElementalSet, inverse_depth: NDArray[np.float64], unit: Literal["mm", "px"]
) -> NDArray[np.float64]:
    """Return depths in mm, or disparities in px from one node to the next."""
    if unit == "mm":
        return 1 / inverse_depth
    zero, one = (1 / loaded.depth_of_disparity(disparity_px) for disparity_px in (-1.0, -2.0))
    return -1 - (inverse_depth - zero) / (one - zero)


def _enlarged(part: NDArray[np.floating], shape: tuple[int, int], bins: int) -> NDArray[np.float64]:
    """Return a map of bins on the samples of the picture; samples beyond the last bin repeat its value."""
    rows, columns = (
        np.minimum(np.arange(size) // bins, count - 1) for size, count in zip(shape, part.shape, strict=True)
    )
    return np.asarray(part[np.ix_(rows, columns)], np.float64)
