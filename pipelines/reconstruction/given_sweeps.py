"""Sweeps as the options of `reconstruct` give them: FIRST:LAST:COUNT."""

import re

import numpy as np

from faintfield.pipelines.errors import WrongUsage

# Largest sweep: more planes are a typing error, and would fill any disk.
_MAX_PLANES = 10_000


def swept_depths(sweep_mm: str) -> list[float]:
    """Return the depths of FIRST:LAST:COUNT."""
    depths = swept("--sweep-mm", sweep_mm, "400:900:64")
    if min(depths) <= 0:
        raise WrongUsage(f"--sweep-mm {sweep_mm}: is no sweep; give two different positive depths")
    return depths


def swept(option: str, given: str, example: str) -> list[float]:
    """Return the numbers of FIRST:LAST:COUNT, in equal steps."""
    parts = re.fullmatch(r"(-?\d+(?:\.\d*)?):(-?\d+(?:\.\d*)?):(\d+)", given)
    if parts is None:
        raise WrongUsage(f"{option} {given}: is no sweep; give FIRST:LAST:COUNT, such as {example}")
    first, last, count = float(parts[1]), float(parts[2]), int(parts[3])
    if first == last or not 2 <= count <= _MAX_PLANES:
        raise WrongUsage(f"{option} {given}: is no sweep; give two different ends and 2 to {_MAX_PLANES} planes")
    return [round(float(value), 6) for value in np.linspace(first, last, count)]
