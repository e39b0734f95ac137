"""Errors of planes, depth maps and surfaces, where a set brings its truth."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from faintfield.pipelines.console import inform
from faintfield.pipelines.formats.files import remove, write_record
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.figures import Metrics, PhotonsRecord, PlaneErrors, SnrRecord
from faintfield.pipelines.formats.results.records import Method, PlaneRecord, Poses
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, in_units, load_set
from faintfield.pipelines.formats.sets.ground_truth import (
    Truth,
    read_true_depth_mm,
    read_truth,
    texture_and_region,
    true_plane,
)
from faintfield.pipelines.reconstruction.channels import load_channel
from faintfield.pipelines.reconstruction.operators import OperatorFactory, plane_grid
from faintfield.pipelines.reconstruction.overview import OBJECT_REGION, brightness
from faintfield.recon.metrics import mean_square_error, peak_snr_db
from faintfield.recon.solver.initialization import back_projection

DEPTH_ERRORS_FILE = "depth_errors.json"

# An error of this share of the depth counts as right, as in the confidence.
_RIGHT = 0.02


def assess(
    elemental_set: ElementalSet,
    planes: Mapping[tuple[Method, float], Path],
    records: Iterable[PlaneRecord],
    truth_in: Path | None = None,
) -> Metrics | None:
    """Return the errors of planes, by method and depth in mm; None without truth, or without planes at its objects.

    The object is scaled to 0…1. `mse_texture` compares with the true texture, and `mse_bright` with the back-projection
    of the noise-free set (what more light would have shown), both where the object is visible. `mse_plane` compares
    with the texture over the whole plane, zero beside the object, and so counts most of the blur of others. `truth_in`
    is the folder of the truth, by default that of the set. The `records` of the planes say which prior they have.
    """
    folder = truth_in or elemental_set.folder
    truth = read_truth(folder)
    depths = [depth for depth in dict.fromkeys(depth for _, depth in planes) if true_plane(truth, depth)]
    if truth is None or not depths:
        return None
    noise_free = load_set(folder / truth.noise_free)
    bright = _back_projections(noise_free, depths)
    rows = [
        _plane_errors(folder, elemental_set.poses, truth, method, depth, read_frame(path).pixels_dn, bright[depth])
        for (method, depth), path in planes.items()
        if depth in depths
    ]
    in_own = [in_units(elemental_set, row) for row in rows if row is not None]
    # Of a plane in colour, the first one counts
    priors = {(record.method, record.depth_mm): record.prior_name for record in reversed(list(records))}
    return Metrics(
        planes=[msgspec.structs.replace(row, prior=priors.get((row.method, row.depth_mm), UNSET)) for row in in_own],
        units=elemental_set.units,
        snr=SnrRecord(truth.snr, brightness(elemental_set, folder / OBJECT_REGION).snr),
        photons_per_px=PhotonsRecord(truth.photons_linear, truth.photons_from_moments, truth.photons_on_object),
    )


def _plane_errors(
    folder: Path, poses: Poses, truth: Truth, method: Method, depth: float, plane: NDArray[Any], bright: NDArray[Any]
) -> PlaneErrors | None:
    at_depth = true_plane(truth, depth)
    assert at_depth is not None
    texture, region = texture_and_region(folder, at_depth)
    if not plane.shape == texture.shape == bright.shape or not np.isfinite(plane[region]).any():
        return None
    error = mean_square_error(plane, bright, region)
    return PlaneErrors(
        depth_mm=depth,
        method=method,
        poses=truth.poses if poses == "stated" else poses,
        object=at_depth.name,
        mse_bright=error,
        mse_texture=mean_square_error(plane, texture, region),
        mse_plane=mean_square_error(plane, texture),
        psnr_db=peak_snr_db(error),
    )


def _back_projections(noise_free: ElementalSet, depths: list[float]) -> dict[float, NDArray[np.floating]]:
    colours: dict[float, list[NDArray[np.floating]]] = {depth: [] for depth in depths}
    for layout in noise_free.layouts:
        images = load_channel(noise_free, layout)
        factory = OperatorFactory(noise_free, layout, images)
        for depth in depths:
            operator = factory.at(depth, plane_grid(noise_free, depth))
            colours[depth].append(back_projection(operator, images))
    return {depth: parts[0] if len(parts) == 1 else np.dstack(parts) for depth, parts in colours.items()}


class DepthErrors(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Errors of the depths that are known, at the samples where the truth is known, too.

    Attributes
    ----------
    file : str
        Name of the TIFF with the depths that were compared.
    samples : int
        Number of samples that were compared.
    share : float
        Share of the samples with a true depth that were compared.
    median_error_mm, median_relative_error : float
        Median of the absolute errors; the same relative to the true depth.
    within_2_percent : float
        Share of the compared samples whose error is at most 2 % of the true depth.
    """

    file: str
    samples: int
    share: float
    median_error_mm: float
    median_relative_error: float
    within_2_percent: float


def write_depth_errors(
    elemental_set: ElementalSet, folder: Path, file: str, unit: Literal["mm", "px", "relative"]
) -> DepthErrors | None:
    """Compare a map in a folder of results with the set's true depth, and write its errors beside it.

    The map has depths or disparities in `unit` on the pixels of the reference view, NaN where nothing is known. An
    earlier comparison is removed. The result is None if the set brings no truth, or none for any sample of the map.
    """
    remove(folder / DEPTH_ERRORS_FILE)
    true_mm = read_true_depth_mm(elemental_set.folder)
    if true_mm is None or elemental_set.units.depth != "mm":
        return None
    found_mm = np.asarray(read_frame(folder / file).pixels_dn, np.float64)
    if unit == "px":
        found_mm = _depth_of(elemental_set, found_mm)
    if found_mm.shape != true_mm.shape:
        inform(f"{file}: is of shape {found_mm.shape}, the true depth {true_mm.shape} (rows, columns): not compared")
        return None
    errors = _depth_errors(file, found_mm, true_mm)
    if errors is not None:
        write_record(folder / DEPTH_ERRORS_FILE, errors)
        inform(
            f"{file}: median error {errors.median_error_mm:.3g} mm ({errors.median_relative_error:.2%}) at the "
            f"{errors.share:.0%} of samples whose depth is known, {errors.within_2_percent:.0%} of these within 2 %"
        )
    return errors


def _depth_errors(file: str, found_mm: NDArray[np.float64], true_mm: NDArray[np.float64]) -> DepthErrors | None:
    known = np.isfinite(true_mm) & (true_mm > 0)
    both = known & np.isfinite(found_mm)
    if not both.any():
        return None
    error_mm = np.abs(found_mm - true_mm)[both]
    relative = error_mm / true_mm[both]
    return DepthErrors(
        file=file,
        samples=int(both.sum()),
        share=float(both.sum() / known.sum()),
        median_error_mm=float(np.median(error_mm)),
        median_relative_error=float(np.median(relative)),
        within_2_percent=float(np.mean(relative <= _RIGHT)),
    )


def _depth_of(elemental_set: ElementalSet, disparity_px: NDArray[np.float64]) -> NDArray[np.float64]:
    at_zero, slope = elemental_set.inverse_depth_of_disparity()
    inverse = at_zero + slope * disparity_px
    return np.where(inverse > 0, 1 / np.where(inverse > 0, inverse, 1.0), np.nan)
