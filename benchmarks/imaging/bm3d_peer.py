"""BM3D as a peer: the package `bm3d` of another Python environment, its strength found from the truth.

The package is no requirement of the project, and an environment of its own may hold the versions that it needs.
`python -m benchmarks.imaging.bm3d_peer PYTHON` measures it on the exposures of figure 4 and writes the table that
`faintfield figures` reads.
"""

import argparse
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from faintfield.pipelines.formats.files import write_json
from faintfield.pipelines.paper.figure4 import (
    BACK_PROJECTION,
    OBJECTS,
    PEER,
    PEER_FILE,
    ErrorPoint,
    PeerTable,
    StagedObject,
    stage_object,
)
from faintfield.recon.likelihood.images import Image
from faintfield.recon.solver.initialization import back_projection

# BM3D with its profile for white noise: picture, result, and σ in electrons.
_PROGRAM = """
import sys, time
import bm3d, numpy
picture = numpy.load(sys.argv[1], allow_pickle=False).astype(float)
started = time.perf_counter()
made = bm3d.bm3d(picture, sigma_psd=float(sys.argv[3]))
print(time.perf_counter() - started)
numpy.save(sys.argv[2], made)
"""

_VERSION = "from importlib.metadata import version; print('bm3d', version('bm3d'))"

# Size of the detector, depth of the objects, and draws of the noise, as in figure 4.
_SIZE_PX, _DEPTH_MM, _SEEDS = (640, 480), 600.0, 2

# Neighbouring σ of the search differ by this factor; it begins near the best σ of most pictures.
_RATIO, _FIRST_SIGMA_E, _MAX_STEPS = 1.08, 0.6, 24


@dataclass(frozen=True)
class Bm3d:
    """BM3D in the environment of another Python."""

    python: Path

    def denoised(self, picture: Image, sigma_e: float) -> Image:
        """Return a picture (row, column) denoised for noise of that standard deviation, clipped at zero."""
        return self.timed(picture, sigma_e)[0]

    def timed(self, picture: Image, sigma_e: float) -> tuple[Image, float]:
        """Return the same, and the seconds that BM3D took."""
        with TemporaryDirectory() as folder:
            given, made = Path(folder) / "given.npy", Path(folder) / "made.npy"
            np.save(given, picture, allow_pickle=False)
            command = [str(self.python), "-c", _PROGRAM, str(given), str(made), repr(sigma_e)]
            shown = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
            plane = np.asarray(np.maximum(np.load(made, allow_pickle=False), 0), np.float32)
            return plane, float(shown.split()[-1])

    def best_sigma_e(self, picture: Image, error: Callable[[Image], float], start_e: float = _FIRST_SIGMA_E) -> float:
        """Return the σ whose result has the least error, found from `start_e` in steps of 8 %."""
        step = least(lambda at: error(self.denoised(picture, start_e * _RATIO**at)), 0, _MAX_STEPS)
        return float(start_e * _RATIO**step)


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


def measure(bm3d: Bm3d) -> list[ErrorPoint]:
    """Return the errors of the back-projections of figure 4, and of BM3D with the best σ of the first draw."""
    errors = []
    for make in OBJECTS:
        stage = stage_object(make(0.0, 0.0, _DEPTH_MM).grey(), _SIZE_PX)
        sigmas_e: dict[float, float] = {}
        sigma_e = _FIRST_SIGMA_E
        for seed in range(1, _SEEDS + 1):
            for snr, images, scale_e in stage.exposures(seed):
                picture = back_projection(stage.operator, images)
                if snr not in sigmas_e:
                    # Neighbouring SNRs have neighbouring σ
                    error = partial(_mse, stage, scale_e)
                    sigma_e = sigmas_e[snr] = bm3d.best_sigma_e(picture, error, sigma_e)
                planes = (
                    (BACK_PROJECTION, picture, None),
                    (PEER, bm3d.denoised(picture, sigmas_e[snr]), sigmas_e[snr]),
                )
                for method, plane, weight in planes:
                    mse, mse_texture = stage.errors(plane, scale_e)
                    errors.append(ErrorPoint(stage.name, snr, method, mse, seed, mse_texture, weight))
                print(errors[-1], flush=True)
    return errors


def _mse(stage: StagedObject, scale_e: float, plane: Image) -> float:
    return stage.errors(plane, scale_e)[0]


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.imaging.bm3d_peer", description=__doc__)
    parser.add_argument("python", type=Path, help="Python of an environment with the package bm3d")
    python = parser.parse_args().python
    program = subprocess.run([str(python), "-c", _VERSION], check=True, capture_output=True, text=True).stdout.strip()
    table = PeerTable(
        program, f"{datetime.now(UTC):%Y-%m-%d}", "python -m benchmarks.imaging.bm3d_peer PYTHON", measure(Bm3d(python))
    )
    write_json(PEER_FILE, table)


if __name__ == "__main__":
    main()
