"""The errors of the planes of a simulated set, against the truth that the simulator knows."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.records import Method, Metrics, PhotonsRecord, PlaneErrors, Poses, SnrRecord
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from faintfield.pipelines.formats.sets.ground_truth import Truth, read_truth, texture_and_region, true_plane
from faintfield.pipelines.formats.sets.stated import in_units
from faintfield.pipelines.reconstruction.channels import channel_layouts, load_channel
from faintfield.pipelines.reconstruction.operators import OperatorFactory, plane_grid
from faintfield.pipelines.reconstruction.overview import OBJECT_REGION, brightness
from faintfield.recon.metrics import mean_square_error, peak_snr_db
from faintfield.recon.solver.initialization import back_projection


def assess(
    elemental_set: ElementalSet, planes: Mapping[tuple[Method, float], Path], truth_in: Path | None = None
) -> Metrics | None:
    """Return the errors of planes; None for a set without ground truth, or without planes at its objects.

    Each plane of each method has three mean square errors, with the object scaled to 0…1:

    - `mse_bright`, over the region where the object is visible, against the back-projection of the noise-free set
      (what more light would have shown);
    - `mse_texture`, over the same region, against the true texture of the object (which also counts the blur of
      other objects there);
    - `mse_plane`, over the whole plane, against the texture, which is zero beside the object, where most of that
      blur is.

    Parameters
    ----------
    elemental_set : ElementalSet
        The set that was reconstructed.
    planes : mapping of (method, depth in mm) to Path
        Files of the planes.
    truth_in : Path, optional
        Folder of the truth; the set's own if None.
    """
    folder = truth_in or elemental_set.folder
    truth = read_truth(folder)
    depths = [depth for depth in dict.fromkeys(depth for _, depth in planes) if true_plane(truth, depth)]
    if truth is None or not depths:
        return None
    noise_free = load_set(folder / truth.noise_free)
    bright = _back_projections(noise_free, depths)
    rows = [
        _errors(folder, elemental_set.poses, truth, method, depth, read_frame(path).pixels_dn, bright[depth])
        for (method, depth), path in planes.items()
        if depth in depths
    ]
    return Metrics(
        planes=[in_units(elemental_set, row) for row in rows if row is not None],
        units=elemental_set.units,
        snr=SnrRecord(truth.snr, brightness(elemental_set, folder / OBJECT_REGION).snr),
        photons_per_px=PhotonsRecord(truth.photons_linear, truth.photons_from_moments, truth.photons_on_object),
    )


def _errors(
    folder: Path, poses: Poses, truth: Truth, method: Method, depth: float, plane: NDArray[Any], bright: NDArray[Any]
) -> PlaneErrors | None:
    """Return the errors of one plane, None if its samples are not those of the truth."""
    at_depth = true_plane(truth, depth)
    assert at_depth is not None
    texture, region = texture_and_region(folder, at_depth)
    if not plane.shape == texture.shape == bright.shape:
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
    """Return the back-projection of the noise-free set at each depth, (row, column[, colour])."""
    colours: dict[float, list[NDArray[np.floating]]] = {depth: [] for depth in depths}
    for layout in channel_layouts(noise_free):
        images = load_channel(noise_free, layout)
        factory = OperatorFactory(noise_free, layout, images)
        for depth in depths:
            operator = factory.at(depth, plane_grid(noise_free, depth))
            colours[depth].append(back_projection(operator, images))
    return {depth: parts[0] if len(parts) == 1 else np.dstack(parts) for depth, parts in colours.items()}
