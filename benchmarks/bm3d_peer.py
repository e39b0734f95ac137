"""BM3D as a peer: the package `bm3d` of another Python environment, its strength found from the truth.

The package is no requirement of the project, and an environment of its own may hold the versions that it needs.
"""

import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from faintfield.recon.likelihood.images import Image

# BM3D with its profile for white noise: picture, result, and σ in electrons.
_PROGRAM = """
import sys
import bm3d, numpy
picture = numpy.load(sys.argv[1], allow_pickle=False).astype(float)
numpy.save(sys.argv[2], bm3d.bm3d(picture, sigma_psd=float(sys.argv[3])))
"""

# Neighbouring σ of the search differ by this factor; it begins near the best σ of most pictures.
_RATIO, _FIRST_SIGMA_E, _MAX_STEPS = 1.08, 0.6, 24


@dataclass(frozen=True)
class Bm3d:
    """BM3D in the environment of another Python."""

    python: Path

    def denoised(self, picture: Image, sigma_e: float) -> Image:
        """Return a picture (row, column) denoised for noise of that standard deviation, clipped at zero."""
        with TemporaryDirectory() as folder:
            given, made = Path(folder) / "given.npy", Path(folder) / "made.npy"
            np.save(given, picture, allow_pickle=False)
            subprocess.run([str(self.python), "-c", _PROGRAM, str(given), str(made), repr(sigma_e)], check=True)
            return np.asarray(np.maximum(np.load(made, allow_pickle=False), 0), np.float32)

    def best_sigma_e(self, picture: Image, error: Callable[[Image], float]) -> float:
        """Return the σ whose result has the least error."""
        step = least(lambda at: error(self.denoised(picture, _sigma_e(at))), 0, _MAX_STEPS)
        return _sigma_e(step)


def _sigma_e(step: int) -> float:
    """Return the σ of a step of the search."""
    return float(_FIRST_SIGMA_E * _RATIO**step)


def least(error: Callable[[int], float], start: int, limit: int) -> int:
    """Return the whole number, from −limit to limit, from which no neighbour has a smaller error."""
    known: dict[int, float] = {}

    def at(step: int) -> float:
        if abs(step) > limit:
            return float("inf")
        if step not in known:
            known[step] = error(step)
        return known[step]

    here = start
    while (better := min(here, here + 1, here - 1, key=at)) != here:
        here = better
    return here
