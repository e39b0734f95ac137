"""The depth of a surface from the views of a set: the range that is asked for or found, and the depths in it."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.console import inform
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.autofocus import overlap, searched_range_mm
from faintfield.pipelines.reconstruction.luminance import luminance
from faintfield.pipelines.reconstruction.surface_request import SurfaceRequest
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.surface.estimate import SurfaceEstimate, estimate_surface
from faintfield.recon.surface.pinhole_views import PinholeViews
from faintfield.recon.surface.sweep import equal_steps, found_range

# Least that the other views see of the reference view's part of the scene at some depth of a given range, on average,
# and the number of depths in it that are tried.
_MIN_OVERLAP, _TRIED = 0.1, 8

# Movement in samples of the outermost view from one depth to the next above which the user is warned, and refused.
_COARSE, _TOO_COARSE = 3.5, 16.0


def limits_mm(loaded: ElementalSet, request: SurfaceRequest) -> tuple[float, float]:
    """Return the nearest and farthest depth to consider: those given, or where the views overlap.

    Raises
    ------
    GeometryMismatch
        The views share too little at the depths of a given range.
    NothingInFocus
        The views overlap nowhere.
    """
    if request.depth_range_mm is None:
        return searched_range_mm(loaded)
    near_mm, far_mm = request.depth_range_mm
    depths = 1 / np.linspace(1 / near_mm, 1 / far_mm, _TRIED)
    own = 1 / len(loaded.settings.view)  # the share of the reference view itself
    shared = (max(overlap(loaded, depth) for depth in depths.tolist()) - own) / (1 - own)
    if shared < _MIN_OVERLAP:
        raise GeometryMismatch(
            f"between {near_mm:g} and {far_mm:g} mm the other views see {shared:.0%} of what the reference view sees, "
            f"on average, and {_MIN_OVERLAP:.0%} are needed; correct the range, or the poses and their signs"
        )
    return near_mm, far_mm


def depths_of_set(
    loaded: ElementalSet, bins: int, range_mm: tuple[float, float], *, find_range: bool
) -> tuple[NDArray[np.float64], SurfaceEstimate]:
    """Return the 1/depths that are compared, ascending, and the depth of each bin by them.

    Parameters
    ----------
    loaded : ElementalSet
        The set.
    bins : int
        Width of the bins in detector pixels.
    range_mm : (float, float)
        Nearest and farthest depth.
    find_range : bool
        Search this range for that of the scene first.

    Raises
    ------
    GeometryMismatch
        The range is too wide, or views, poses and range do not fit together.
    NothingInFocus
        Nothing is found in the range.
    """
    views, nodes = luminance(loaded, bins), nodes_of(loaded)
    near, far = 1 / range_mm[0], 1 / range_mm[1]
    with naming_range(far, near):
        if find_range:
            far, near = found_range(views, nodes, far, near)
        depths = equal_steps(views, far, near)
        _check_steps(views, depths)
        inform(f"surface between {1 / near:.4g} and {1 / far:.4g} mm: comparing {len(depths)} depths")
        return depths, estimate_surface(views, depths, nodes)


@contextmanager
def naming_range(far: float, near: float) -> Iterator[None]:
    """Name the range of 1/depth in which views, poses and surface do not fit together."""
    try:
        yield
    except GeometryMismatch as failure:
        raise GeometryMismatch(f"surface between {1 / near:.4g} and {1 / far:.4g} mm: {failure}") from failure


def nodes_of(loaded: ElementalSet) -> NDArray[np.intp]:
    """Return row and column of the node of each view; a row of views if no nodes are stated."""
    views = loaded.settings.view
    if any(view.node is None for view in views):
        return np.array([(0, index) for index in range(len(views))])
    return np.array([view.node for view in views])


def _check_steps(views: PinholeViews, depths: NDArray[np.float64]) -> None:
    """Refuse a range whose depths are far apart, or warn of it."""
    step = float(depths[1] - depths[0]) * float(views.reach.max())
    apart = (
        f"{len(depths)} depths are compared, and from one to the next a point moves by {step:.1f} bins in the "
        f"outermost view, where {_COARSE:g} are enough to miss objects"
    )
    if step > _TOO_COARSE:
        raise GeometryMismatch(f"{apart}; give a narrower range, above all a farther near end")
    if step > _COARSE:
        inform(f"warning: {apart}; a narrower range would find more")
