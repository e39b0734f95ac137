"""One picture, sharp everywhere, with the depth of each of its samples: `reconstruct --surface`."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray
from scipy.special import erfinv

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import OutputExists
from faintfield.pipelines.formats.files import remove, remove_leftovers, require_room
from faintfield.pipelines.formats.frames import ChannelLayout
from faintfield.pipelines.formats.large_arrays import memory_or_file
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.figures import OVERVIEW_FILE
from faintfield.pipelines.formats.results.plane_files import read_current
from faintfield.pipelines.formats.results.records import DEPTH_MAP_FILE
from faintfield.pipelines.formats.results.surface import (
    SURFACE_FILE,
    HeldOutRecord,
    SurfaceChannel,
    SurfaceFacts,
    SurfaceFileRecord,
    SurfaceRecord,
)
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, in_units, light_per_e, unit_of_maps
from faintfield.pipelines.reconstruction.accuracy import write_depth_errors
from faintfield.pipelines.reconstruction.channels import SHARE_OF_DISK, load_channel
from faintfield.pipelines.reconstruction.depth.scene_structure import shares_of_depths
from faintfield.pipelines.reconstruction.depth.search import (
    DepthSearch,
    check_overlap,
    check_views,
    depths_of_set,
    in_unit,
    naming_range,
)
from faintfield.pipelines.reconstruction.operators import OperatorFactory, blind_views, plane_grid
from faintfield.pipelines.reconstruction.overview import inspect_set, write_overview
from faintfield.pipelines.reconstruction.planes.penalised import Objective, Solution, solve_then_sigma
from faintfield.pipelines.reconstruction.planes.prior import with_prior
from faintfield.pipelines.reconstruction.planes.saturation import PixelSelection, saturation_text
from faintfield.pipelines.reconstruction.surface.files import SurfaceMaps, write_surface
from faintfield.pipelines.reconstruction.surface.parallax import aperture_of
from faintfield.pipelines.reconstruction.surface.request import SurfaceRequest
from faintfield.recon.depth.focus import sure_of_lit
from faintfield.recon.operator.surface_operator import SurfaceOperator
from faintfield.recon.prior.collaborative import refined
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.surface.confidence import RIGHT_WITHIN, SURE, UNKNOWN_BELOW

# Bytes of a sample in the files: TIFFs of one number and of one per colour, a point, and the picture on the page; and
# bytes of previews, film and page, which do not grow with the picture.
_NUMBERS, _NUMBERS_PER_COLOUR, _POINT_BYTES, _FIXED_BYTES = 4, 2, 27, 30_000_000


class _Light(NamedTuple):
    """One colour of the picture, and which of its pixels count if some are saturated."""

    solution: Solution
    selected: PixelSelection | None


def reconstruct_surface(
    elemental_set: ElementalSet, out: Path, request: SurfaceRequest, pages: Sequence[Path] = ()
) -> SurfaceRecord:
    """Reconstruct the surface of a set, and write it with its record and an overview of the set; keep one up to date.

    The caller has `out` to itself, see `formats.files.exclusive`. Earlier `pages` are removed before the files that
    they show are. Raises BadValue for too few or too small views, OutputExists if `out` holds a depth map, whose files
    have the same names, GeometryMismatch if the views share too little in a given range, or that is too wide, and
    NothingInFocus if the views tell no depths, or agree no better than shuffled ones.
    """
    started = time.monotonic()
    check_views(elemental_set, "a surface")
    if (out / DEPTH_MAP_FILE).exists():
        raise OutputExists(
            f"{out}: holds the depth map of a sweep, whose files have the names of the surface's; give another --out"
        )
    unit = unit_of_maps(elemental_set.units, as_px=request.unit == "px")
    options = in_units(elemental_set, request.options(elemental_set))
    origin = provenance("reconstruct", options, elemental_set.input_hashes(), elemental_set.units)
    kept = read_current(out / SURFACE_FILE, SurfaceFileRecord, origin)
    if kept is not None:
        if not (out / OVERVIEW_FILE).is_file():  # of a version that wrote none
            write_overview(*inspect_set(elemental_set), out)
        return kept.surface
    layouts = elemental_set.layouts
    grid = plane_grid(elemental_set, 1.0)
    needed_bytes = _needed_bytes(grid.shape, len(layouts), proposal=request.solver.proposal)
    require_room(out, int(needed_bytes / (1 - SHARE_OF_DISK)))  # decoded frames take the rest
    range_mm = request.range_mm(elemental_set)
    if range_mm is not None:
        check_overlap(elemental_set, range_mm)
    remove_leftovers(out)
    overview, pictures = inspect_set(elemental_set)
    search = depths_of_set(elemental_set, range_mm, out)
    far, near = float(search.compared[0]), float(search.compared[-1])
    with naming_range(elemental_set, far, near):
        lights = {
            layout.name: _light(elemental_set, layout, search, request.solver, out)
            for layout in progress(layouts, "picture")
        }
    held_out, prediction = None, search.estimate.prediction
    if prediction is not None and prediction.pixels:
        held_out = HeldOutRecord(**vars(prediction) | {"views": prediction.views.tolist()})
    facts = SurfaceFacts(
        unit=unit,
        searched=(in_unit(elemental_set, near, unit), in_unit(elemental_set, far, unit)),
        range_found=request.ends is None,
        depths=len(search.compared),
        bins_px=search.bins_px,
        rounds=search.estimate.rounds,
        sure_above=SURE,
        held_out=held_out,
        share_of_sure=shares_of_depths(search),
        sure_of_lit=sure_of_lit(search.estimate.confidence, search.estimate.lit_share),
        spacing_needed=search.estimate.spacing_needed or UNSET,
        channels=[in_units(elemental_set, _channel(name, light)) for name, light in lights.items()],
        wall_time_s=time.monotonic() - started,
    )
    maps = _maps(elemental_set, search, [light.solution for light in lights.values()], unit)
    if text := saturation_text(facts.channels):
        inform(text)
    for page in pages:
        remove(page)
    record = write_surface(out, maps, facts, origin)
    write_overview(overview, pictures, out)
    write_depth_errors(elemental_set, out, record.depth, record.unit)
    return record


def _needed_bytes(shape: tuple[int, int], colours: int, *, proposal: bool) -> int:
    """Return about how much disk the results take, with the page that shows them again."""
    numbers = _NUMBERS + (1 + proposal) * _NUMBERS_PER_COLOUR * colours
    of_sample = numbers * np.dtype(np.float32).itemsize + _POINT_BYTES + 3 * colours
    return shape[0] * shape[1] * of_sample + _FIXED_BYTES


def _light(
    elemental_set: ElementalSet,
    layout: ChannelLayout,
    search: DepthSearch,
    options: SolverOptions,
    out: Path,
) -> _Light:
    """Return one colour of the picture on a surface of known depth, with `sigma` and `visibility` beside it.

    `sigma` is that of total variation's picture; it is computed when the images are gone.
    """
    images = load_channel(elemental_set, layout, memory_or_file(out))
    factory = OperatorFactory(elemental_set, layout, images)
    operator = factory.of_surface(search.estimate.inverse_depth, search.grid)
    if message := blind_views(elemental_set, operator, "the surface"):
        inform(message)
    objective = Objective.of(SceneProblem(operator, images), options)
    solution, sigma = solve_then_sigma(objective)
    if options.prior is None:
        solution = replace(solution, plane=refined(operator, images, solution.plane))
    else:
        (solution,) = with_prior(objective, [solution])
    visibility = _visibility(operator, layout)
    selected = None
    if images.valid is not None:
        whole = factory.of_surface(search.estimate.inverse_depth, search.grid, masked=False)
        selected = PixelSelection.of(operator, whole, images)
        del whole
    known_e2 = float(np.mean(images.known_variance_e2()))
    del images, factory, operator, objective
    arrays = {"plane": solution.plane, **solution.sidecars, "sigma": sigma(), "visibility": visibility}
    if selected is not None:
        arrays = selected.applied(arrays, known_e2)
    return _Light(replace(solution, plane=arrays.pop("plane"), sidecars=arrays), selected)


def _visibility(operator: SurfaceOperator, layout: ChannelLayout) -> NDArray[np.floating]:
    """Return the sum of the weights of all pixels that see each sample, whatever their response.

    It is about one for each view that sees the sample, and more where the pixels of a view lie closer than the samples.
    A view has fewer pixels than samples in a colour of a mosaic.
    """
    response = operator.response()
    inverse = np.divide(1, response, out=np.zeros_like(response), where=response > 0)
    samples_per_px = np.prod(layout.lattices[0].step) / len(layout.lattices)
    return operator.adjoint_of_map(inverse) * operator.dtype.type(samples_per_px)


def _channel(name: str, light: _Light) -> SurfaceChannel:
    record, selected = light.solution.record, light.selected
    return SurfaceChannel(
        channel=name,
        penalty_weight=record.penalty_weight,
        penalty_weight_chosen=record.penalty_weight_chosen,
        penalty_weight_curve=record.penalty_weight_curve or None,
        certificate=record.certificate,
        passes=record.passes,
        likelihood=record.likelihood or "",
        mean_e=float(np.nanmean(light.solution.plane, dtype=np.float64)),
        saturated_share=selected.saturated_share if selected else UNSET,
        unknown_share=selected.unknown_share if selected else UNSET,
        prior=record.prior,
    )


def _maps(
    elemental_set: ElementalSet,
    search: DepthSearch,
    lights: list[Solution],
    unit: Literal["mm", "px", "relative"],
) -> SurfaceMaps:
    inverse_depth, confidence = search.estimate.inverse_depth, search.estimate.confidence
    known = confidence >= UNKNOWN_BELOW
    depth = in_unit(elemental_set, inverse_depth, unit)
    # Of a normal distribution that lies within the tolerance with this probability
    sigma = RIGHT_WITHIN / (np.sqrt(2) * erfinv(np.maximum(confidence, UNKNOWN_BELOW)))
    slope = np.abs(in_unit(elemental_set, inverse_depth * (1 + 1e-6), unit) - depth) / 1e-6
    light = light_per_e(elemental_set)
    proposed = all("proposal" in solution.sidecars for solution in lights)
    return SurfaceMaps(
        grid=search.grid,
        picture=_colours([light * solution.plane for solution in lights]),
        picture_sigma=_colours([light * solution.sidecars["sigma"] for solution in lights]),
        picture_proposal=_colours([light * solution.sidecars["proposal"] for solution in lights]) if proposed else None,
        picture_moved=_colours([solution.sidecars["moved"] for solution in lights]) if proposed else None,
        depth=np.where(known, depth, np.nan),
        depth_sigma=np.where(known, sigma * slope, np.nan),
        depth_confidence=confidence,
        visibility=np.mean([solution.sidecars["visibility"] for solution in lights], axis=0),
        inverse_depth=inverse_depth,
        aperture_mm=aperture_of(elemental_set.poses_rt_cam_ref),
    )


def _colours(parts: list[NDArray[np.floating]]) -> NDArray[np.floating]:
    return parts[0] if len(parts) == 1 else np.stack(parts, -1)
