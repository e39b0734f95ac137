"""Pairs to train on: what the product knows of a dark plane, in units of its noise, and the light that is true."""

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.reconstruction.planes.solve import solve
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.metrics import signal_scale_for_snr
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.prior.collaborative import Groups, Patches, collaborative_wiener
from faintfield.recon.prior.evidence import noise_of_back_projection
from faintfield.recon.solver.initialization import back_projection, smooth_start
from faintfield.recon.solver.penalty_weight import universal_penalty_weight
from training.pictures import Picture, picture

# Samples of a plane along each side, and pixels of a view: a view is smaller or larger than the plane.
_PLANE, _VIEW = 192, 192

# The true light has this many samples for each of the plane: what lies between them is not left out.
_FINE = 2

_SNRS, _READ_NOISES_E, _VIEWS = (0.05, 5.0), (0.5, 10.0), (9, 121)

# Every so many pairs the weight of the penalty is cross-validated, as in the product; others take a guess near it.
_CROSS_VALIDATED = 8


@dataclass(frozen=True)
class Exposure:
    """Dark views of a picture.

    Attributes
    ----------
    operator : PlaneOperator
        H of the plane.
    images : ElementalImages
        The data.
    truth : float array (row, column)
        The back-projection of the light without noise, in electrons.
    snr : float
        By eq. (4).
    """

    operator: PlaneOperator
    images: ElementalImages
    truth: NDArray[np.floating]
    snr: float


def _log_uniform(random: np.random.Generator, limits: tuple[float, float]) -> float:
    return float(np.exp(random.uniform(*np.log(limits))))


def _homographies(random: np.random.Generator, views: int) -> NDArray[np.float64]:
    """Return homographies from pixels to samples: shifts, by much in some sets, small turns, scales and tilts."""
    maps = np.stack([np.eye(3)] * views)
    spread = random.choice([0.5, 0.5, random.uniform(2, 60)])
    angles = random.normal(0, 4e-3, views)
    scale = random.uniform(0.85, 1.1) * (1 + random.normal(0, 2e-3, views))
    maps[:, 0, 0] = maps[:, 1, 1] = scale * np.cos(angles)
    maps[:, 1, 0] = scale * np.sin(angles)
    maps[:, 0, 1] = -maps[:, 1, 0]
    maps[:, :2, 2] = random.uniform(-spread, spread, (views, 2)) + (_PLANE - scale[:, np.newaxis] * _VIEW) / 2
    maps[:, 2, :2] = random.normal(0, 1e-5, (views, 2))
    return maps


def exposure(random: np.random.Generator, shown: Picture) -> Exposure:
    """Return dark views of a picture that has `_FINE` samples for each of the plane, of random level and noise."""
    views = round(_log_uniform(random, _VIEWS))
    homographies = _homographies(random, views)
    axis = np.arange(float(_VIEW))
    rays = np.stack(np.meshgrid(axis, axis), axis=-1)
    radius = np.linalg.norm(rays - _VIEW / 2, axis=-1) / _VIEW
    flat = (1 - random.choice([0.0, 0.5]) * radius**2).astype(np.float32)
    operator = PlaneOperator(homographies, rays, PlaneGrid((_PLANE, _PLANE), 1.0, (0.0, 0.0)), flat=flat)
    corner = -0.5 + 0.5 / _FINE
    grid = PlaneGrid((_FINE * _PLANE, _FINE * _PLANE), 1 / _FINE, (corner, corner))
    light = PlaneOperator(homographies, rays, grid, flat=flat).forward(shown)
    read_noise_e, dark_e = _log_uniform(random, _READ_NOISES_E), float(random.choice([0.0, 0.02, 0.5]))
    snr = _log_uniform(random, _SNRS)
    bright = np.maximum(shown, 0.3) if shown.max() < 0.01 else shown[shown > 0.02 * shown.max()]
    scale_e = signal_scale_for_snr(bright, snr, dark_e, read_noise_e)
    counts = random.poisson(scale_e * light + dark_e)
    electrons = counts + random.normal(0, read_noise_e, counts.shape)
    images = ElementalImages(electrons.astype(np.float32), dark_e, read_noise_e**2)
    return Exposure(operator, images, scale_e * back_projection(operator, ElementalImages(light)), snr)


def channels(exposed: Exposure, weight: float | None) -> NDArray[np.float32]:
    """Return back-projection, pilot, patch estimate, standard deviation of the noise, truth (5, row, column), in e⁻."""
    operator, images = exposed.operator, exposed.images
    plane = solve(operator, images, "pmlem", SolverOptions(penalty_weight="auto" if weight is None else weight)).plane
    noise = noise_of_back_projection(operator, images, plane)
    coverage = operator.coverage()
    pilot = operator.adjoint_of_forward(plane) / np.maximum(coverage, 1e-9)
    seen = back_projection(operator, images)
    fine, coarse = Patches(8, 4, 16, 64), Patches(12, 5, 18, 64)
    wiener, hard = Groups(pilot, noise, fine).wiener_and_thresholded(seen, pilot)
    first = (wiener + collaborative_wiener(seen, pilot, noise, coarse)) / 2
    second = collaborative_wiener(seen, (hard + first) / 2, noise, fine)
    return np.stack([seen, pilot, (first + second) / 2, np.sqrt(noise.variance), exposed.truth]).astype(np.float32)


def read_photographs(folder: Path | None) -> list[Picture]:
    """Return the pictures of a folder as light from 0 to 1."""
    files = sorted(folder.iterdir()) if folder else []
    return [_read_photograph(file) for file in files]


def _read_photograph(file: Path) -> Picture:
    levels = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    if levels is None:
        raise SystemExit(f"{file} is no picture that OpenCV reads; move it out of the folder of photographs")
    return np.asarray((levels / np.float32(255)) ** np.float32(2.2), np.float32)


def _cut(random: np.random.Generator, photograph: Picture, size: int) -> Picture:
    """Return a square of a photograph, shrunk or enlarged a little."""
    side = min(*photograph.shape, round(size * random.uniform(0.9, 2)))
    top, left = (int(random.integers(0, length - side + 1)) for length in photograph.shape)
    square = photograph[top : top + side, left : left + side]
    light = cv2.resize(square, (size, size), interpolation=cv2.INTER_AREA if side > size else cv2.INTER_LINEAR)
    return np.asarray(np.clip(light, 0, 1), np.float32)


def shown_picture(random: np.random.Generator, photographs: list[Picture]) -> tuple[str, Picture]:
    """Return a picture to expose, one in eight a part of a photograph."""
    size = _FINE * _PLANE
    if photographs and random.random() < 1 / 8:
        return "photograph", _cut(random, photographs[random.integers(len(photographs))], size)
    return picture(random, size)


def main() -> None:
    """Write pairs to files `NNNNN.npz`, one for each seed of a range."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, nargs=3, default=(0, 800, 1), metavar=("FIRST", "END", "STEP"))
    parser.add_argument("--photographs", type=Path)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    photographs = read_photographs(options.photographs)
    for seed in range(*options.seeds):
        random = np.random.default_rng([4, seed])
        kind, shown = shown_picture(random, photographs)
        exposed = exposure(random, shown)
        start = smooth_start(exposed.operator, exposed.images)
        guess = universal_penalty_weight(exposed.operator, exposed.images, start) * _log_uniform(random, (0.7, 2.5))
        made = channels(exposed, None if seed % _CROSS_VALIDATED == 0 else guess)
        # Renamed once whole: training may read the folder meanwhile
        unfinished = options.folder / f"{seed:05}.unfinished"
        with unfinished.open("wb") as file:
            np.savez(file, channels=made, kind=kind, snr=exposed.snr)
        unfinished.rename(unfinished.with_suffix(".npz"))


if __name__ == "__main__":
    main()
