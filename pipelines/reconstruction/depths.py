"""Depths as the options state them: one by one, in sweeps, or by disparity."""

import re

import numpy as np

from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.results.plane_files import plane_name
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.grids import check_in_front

# Largest sweep: more planes are a typing error, and would fill any disk.
_MAX_PLANES = 10_000


def distinct_depths(depths: list[float]) -> list[float]:
    """Return each depth once; refuse those behind the camera, and two different ones that would share a file name."""
    by_name: dict[str, float] = {}
    for depth in depths:
        check_in_front(depth)
        other = by_name.setdefault(plane_name(depth), depth)
        if other != depth:
            raise WrongUsage(f"planes at {other:g} and {depth:g} mm would share a file name; keep them 0.1 mm apart")
    return list(by_name.values())


def swept_depths(sweep_mm: str) -> list[float]:
    """Return the depths of FIRST:LAST:COUNT."""
    depths = _swept("--sweep-mm", sweep_mm, "400:900:64")
    if min(depths) <= 0:
        raise WrongUsage(f"--sweep-mm {sweep_mm}: is no sweep; give two different positive depths")
    return depths


def swept_disparities(sweep_px: str) -> list[float]:
    """Return the disparities of FIRST:LAST:COUNT."""
    return _swept("--sweep-px", sweep_px, "-3.5:0.8:40")


def depths_by_disparity(loaded: ElementalSet, disparities_px: list[float]) -> dict[float, float]:
    """Return a mapping from depth in mm to disparity in px."""
    return {loaded.depth_of_disparity(disparity): disparity for disparity in disparities_px}


def _swept(option: str, given: str, example: str) -> list[float]:
    """Return the numbers of FIRST:LAST:COUNT, in equal steps."""
    parts = re.fullmatch(r"(-?\d+(?:\.\d*)?):(-?\d+(?:\.\d*)?):(\d+)", given)
    if parts is None:
        raise WrongUsage(f"{option} {given}: is no sweep; give FIRST:LAST:COUNT, such as {example}")
    first, last, count = float(parts[1]), float(parts[2]), int(parts[3])
    if first == last or not 2 <= count <= _MAX_PLANES:
        raise WrongUsage(f"{option} {given}: is no sweep; give two different ends and 2 to {_MAX_PLANES} planes")
    return [round(float(value), 6) for value in np.linspace(first, last, count)]
