"""All colours of a set together, as pinhole cameras of larger pixels see it: what depths are found from."""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.homography import ray_from_surface
from faintfield.pipelines.console import working
from faintfield.pipelines.formats.frames import Lattice
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.channels import ChannelLayout, channel_layouts, lattice_noise, view_electrons
from faintfield.pipelines.reconstruction.operators import plane_grid, principal_shift, response_of
from faintfield.recon.surface.pinhole_views import UNKNOWN, PinholeViews
from faintfield.recon.threads import map_in_threads

# Most pixels of a view, and the fewest pixels along a side that are still added up in twos.
_MAX_PIXELS, _MIN_SIDE_PX = 80_000, 120


def default_bins(elemental_set: ElementalSet) -> int:
    """Return the width in detector pixels of the bins: two, or more if views are large; whole periods of a mosaic."""
    width, height = elemental_set.settings.camera.size_px
    period = int(np.lcm(*channel_layouts(elemental_set)[0].lattices[0].step))
    needed = int(np.ceil(np.sqrt(width * height / _MAX_PIXELS)))
    smallest = 2 if min(width, height) >= _MIN_SIDE_PX else 1
    return -(-max(needed, smallest) // period) * period


def luminance(elemental_set: ElementalSet, bins: int) -> PinholeViews:
    """Return the light of all views, in bins of `bins` by `bins` detector pixels, with distortion undone.

    Each view is read by one thread.

    Raises
    ------
    WrongSize, WrongBitDepth, UnreadableImage
        A frame does not match the set; the message names it.
    """
    layouts = channel_layouts(elemental_set)
    parts = [(layout, lattice) for layout in layouts for lattice in layout.lattices]
    responses = [_response(elemental_set, lattice, bins) for _, lattice in parts]
    backgrounds, variances = zip(*(_known(elemental_set, lattice) for _, lattice in parts), strict=True)
    grid = plane_grid(elemental_set, 1.0).binned(bins)
    views = len(elemental_set.settings.view)
    width, height = elemental_set.settings.camera.size_px
    shape = (height // bins, width // bins)
    light = np.empty((views, *shape), np.float32)
    undistorted = _undistorted_places(elemental_set, bins, shape)

    def read(view: int) -> None:
        total = np.zeros(shape, np.float32)
        for response, background, (lattice, sum_e, over) in zip(
            responses, backgrounds, _electrons(elemental_set, layouts, view), strict=True
        ):
            usable = (response > 0) & (_summed(over, lattice, bins) == 0)
            light_e = _summed(sum_e - np.asarray(background, np.float32), lattice, bins)
            total += np.where(usable, light_e / np.where(response > 0, response, 1), UNKNOWN)
        light[view] = _resampled(total, undistorted)

    with working("reading views"):
        map_in_threads(read, range(views))
    camera = elemental_set.settings.camera
    return PinholeViews(
        light,
        float(np.sum(variances)) * _pixels(parts[0][1], bins),
        ray_from_surface(elemental_set.poses_rt_cam_ref, principal_shift(elemental_set)),
        (camera.fx_px / bins, camera.fy_px / bins),
        ((camera.cx_px + 0.5) / bins - 0.5, (camera.cy_px + 0.5) / bins - 0.5),
        grid,
    )


def _response(elemental_set: ElementalSet, lattice: Lattice, bins: int) -> NDArray[np.float32]:
    """Return the response of bins of a lattice (row, column), zero where one of their pixels is unusable."""
    response, pixels = response_of(elemental_set, lattice), _pixels(lattice, bins)
    whole = _summed(response > 0, lattice, bins) == pixels
    return np.where(whole, _summed(response, lattice, bins) / np.float32(pixels), np.float32(0))


def _pixels(lattice: Lattice, bins: int) -> int:
    """Return the number of a lattice's pixels in a bin."""
    return (bins // lattice.step[0]) * (bins // lattice.step[1])


def _summed(values: NDArray[Any], lattice: Lattice, bins: int) -> NDArray[Any]:
    """Return values of a lattice (row, column) added up in bins of `bins` by `bins` detector pixels."""
    down, right = (bins // step for step in lattice.step)
    rows, columns = values.shape[0] // down, values.shape[1] // right
    whole = values[: rows * down, : columns * right].reshape(rows, down, columns, right)
    return np.asarray(whole.sum(axis=(1, 3)))


def _electrons(
    elemental_set: ElementalSet, layouts: list[ChannelLayout], view: int
) -> Iterator[tuple[Lattice, NDArray[np.float32], NDArray[np.bool_]]]:
    """Yield the electrons of a view on each lattice of each colour, and where they are saturated."""
    for layout in layouts:
        found = view_electrons(elemental_set, layout, elemental_set.frame_paths(view))
        for lattice, (sum_e, over) in zip(layout.lattices, found, strict=True):
            yield lattice, sum_e, over


def _known(elemental_set: ElementalSet, lattice: Lattice) -> tuple[float | NDArray[np.floating], float]:
    """Return the background of a lattice (row, column), and the mean variance that is not of the light."""
    noise = lattice_noise(elemental_set, lattice, None)
    background_e = elemental_set.background_e(noise)
    return background_e, float(np.mean(background_e)) + float(np.mean(elemental_set.read_variance_e2(noise)))


def _undistorted_places(
    elemental_set: ElementalSet, bins: int, shape: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """Return column and row (row, column) of the bin that a pinhole camera's bin shows; None without distortion."""
    camera = elemental_set.settings.camera
    if not any(camera.distortion):
        return None
    rows, columns = np.indices(shape, np.float64)
    pixel_x, pixel_y = (columns + 0.5) * bins - 0.5, (rows + 0.5) * bins - 0.5
    directions = [(pixel_x - camera.cx_px) / camera.fx_px, (pixel_y - camera.cy_px) / camera.fy_px, np.ones(shape)]
    seen = elemental_set.lens.project(np.stack(directions, -1).reshape(-1, 3)).reshape(*shape, 2)
    places = ((seen + 0.5) / bins - 0.5).astype(np.float32)
    return np.ascontiguousarray(places[:, :, 0]), np.ascontiguousarray(places[:, :, 1])


def _resampled(
    light: NDArray[np.float32], places: tuple[NDArray[np.float32], NDArray[np.float32]] | None
) -> NDArray[np.float32]:
    """Return light at places between bins; unknown where a bin that it needs is."""
    unknown = light < UNKNOWN / 2
    if places is None:
        return np.where(unknown, UNKNOWN, light)
    values = cv2.remap(np.where(unknown, 0, light), *places, cv2.INTER_LINEAR)
    known = cv2.remap((~unknown).astype(np.float32), *places, cv2.INTER_LINEAR)
    return np.where(known > 0.999, values, UNKNOWN).astype(np.float32)
