"""Coverage of the 90 % interval of a sample: `python -m benchmarks.imaging.uncertainty [SCENE …]`.

Each scene is one picture as a plane at 500 mm before the paper's camera and grid, rendered by the simulated rig, whose
lens and interpolation are not those of the reconstruction: an object of the demo alone, a picture that scikit-image
ships, or a synthetic one. It is reconstructed at four signal-to-noise ratios with the weight that held-out views
choose. One line of JSON each: the share of samples whose interval f ± 1.645 σ holds the truth, where the truth is
light, on the steepest tenth of these, and everywhere, with the seconds it took. `--size-px WIDTH HEIGHT` and `--seed`
as for `faintfield simulate`. The constants of σ were chosen on the scenes of `CHOSEN_ON`.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import skimage.data
from numpy.typing import NDArray

from faintfield.calib.homography import fronto_parallel_rt_ref_plane, plane_from_ray
from faintfield.pipelines.arguments import PriorName, SolverOptions
from faintfield.pipelines.reconstruction.planes.solve import solve
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.metrics import signal_scale_for_snr
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.solver.initialization import well_seen_samples
from faintfield.rig.simulation.experiment import paper_experiment
from faintfield.rig.simulation.scene import TexturedPlane, render

CHOSEN_ON = ("truck", "camera", "coins", "brick", "grass", "disks", "smooth", "fine", "points")
OTHERS = ("airplane", "moon", "gravel", "astronaut", "chelsea", "hubble_deep_field", "text")

_SNRS = (0.05, 0.16, 0.5, 2.0)

# Two-sided 90 % of the normal distribution.
_WITHIN = 1.6449

_DEPTH_MM, _DARK_E, _READ_NOISE_E = 500.0, 0.01, 3.464

# Errors of the poses, which the reconstruction knows: views fall on all phases between the samples.
_POSITION_SD_MM, _ROTATION_SD_RAD = 0.3, 0.0035

# Samples of light that are steeper than this part of all count as edges.
_EDGES = 0.9

# Width of a picture relative to the field of view.
_MARGIN = 1.05


@dataclass(frozen=True)
class Scene:
    """A plane's views, and the light of its samples (row, column) in electrons."""

    truth: Image
    operator: PlaneOperator
    images: ElementalImages


def made(name: str, snr: float, size_px: tuple[int, int], seed: int) -> Scene:
    """Render a scene and expose it."""
    generator = np.random.default_rng([seed, round(1000 * snr)])
    experiment = paper_experiment(*size_px)
    optics, ideal = experiment.optics, experiment.optics.ideal()
    objects = {"truck": experiment.planes[0], "airplane": experiment.planes[1]}
    plane = objects[name].grey() if name in objects else _filling(picture(name), size_px, optics.fx_px)
    light = np.asarray(next(render([plane], ideal, np.zeros((1, 6)), samples_per_px=3)).light)
    poses = experiment.poses_rt_cam_ref(_POSITION_SD_MM, _ROTATION_SD_RAD, generator)
    scale = signal_scale_for_snr(light[light > 0], snr, _DARK_E, _READ_NOISE_E)
    views = np.stack([view.light for view in render([plane], optics, poses, samples_per_px=3)]) * scale
    electrons = generator.poisson(views + _DARK_E) + generator.normal(0, _READ_NOISE_E, views.shape)
    pitch_mm = plane.depth_mm / ideal.fx_px
    grid = PlaneGrid(light.shape, pitch_mm, (-ideal.cx_px * pitch_mm, -ideal.cy_px * pitch_mm))
    homographies = plane_from_ray(poses, fronto_parallel_rt_ref_plane(plane.depth_mm))
    operator = PlaneOperator(homographies, optics.rays(1), grid, flat=optics.relative_illumination())
    images = ElementalImages(electrons.astype(np.float32), _DARK_E, _READ_NOISE_E**2)
    return Scene(np.asarray(light * scale, np.float32), operator, images)


def picture(name: str) -> NDArray[np.float32]:
    """Return a picture (row, column), 0 to 1."""
    if name in _SYNTHETIC:
        return np.asarray(_SYNTHETIC[name](np.random.default_rng(7)), np.float32)
    found = np.asarray(getattr(skimage.data, name)(), np.float32) / 255
    return np.asarray(found if found.ndim == 2 else found[:, :, :3].mean(axis=2), np.float32)


def _filling(reflectance: NDArray[np.float32], size_px: tuple[int, int], f_px: float) -> TexturedPlane:
    """Return a picture as a plane that fills the reference view."""
    rows, columns = reflectance.shape
    pitch_mm = _MARGIN * _DEPTH_MM / f_px * max(size_px[0] / columns, size_px[1] / rows)
    pose = (0.0, 0.0, 0.0, 0.0, 0.0, _DEPTH_MM)
    return TexturedPlane("picture", reflectance, np.ones_like(reflectance), pitch_mm, pose)


def _disks(generator: np.random.Generator) -> NDArray[np.floating]:
    canvas = np.full((480, 640), 0.1, np.float32)
    for _ in range(60):
        centre = int(generator.uniform(0, 640)), int(generator.uniform(0, 480))
        cv2.circle(canvas, centre, int(generator.uniform(5, 60)), generator.uniform(0.1, 1), -1)
    return canvas


def _points(generator: np.random.Generator) -> NDArray[np.floating]:
    canvas = np.full((480, 640), 0.02, np.float32)
    for _ in range(300):
        centre = int(generator.uniform(0, 640)), int(generator.uniform(0, 480))
        cv2.circle(canvas, centre, int(generator.uniform(1, 4)), generator.uniform(0.3, 1), -1)
    return canvas


def _smooth(generator: np.random.Generator) -> NDArray[np.floating]:
    y, x = np.mgrid[:480, :640]
    return np.asarray(0.5 + 0.3 * np.sin(x / 90) * np.cos(y / 70) + 0.2 * np.sin((x + y) / 130))


def _fine(generator: np.random.Generator) -> NDArray[np.floating]:
    rough = cv2.GaussianBlur(generator.normal(size=(480, 640)), (0, 0), 2.0)
    return np.asarray(np.clip(0.5 + 0.2 * rough / rough.std(), 0, 1))


_SYNTHETIC: dict[str, Callable[[np.random.Generator], NDArray[np.floating]]] = {
    "disks": _disks,
    "points": _points,
    "smooth": _smooth,
    "fine": _fine,
}


def covered(scene: Scene, prior: PriorName) -> dict[str, float]:
    """Return the shares of samples whose interval holds the truth, and the seconds it took."""
    started = time.monotonic()
    solution = solve(scene.operator, scene.images, "pmlem", SolverOptions(uncertainty=True, prior=prior))
    held = np.abs(solution.plane - scene.truth) <= _WITHIN * solution.sidecars["sigma"]
    seen = well_seen_samples(scene.operator.coverage())
    lit = seen & (scene.truth > 0)
    steepness = np.hypot(*np.gradient(scene.truth))
    edges = lit & (steepness > np.quantile(steepness[lit], _EDGES))
    return {
        "where_light": round(float(held[lit].mean()), 3),
        "edges": round(float(held[edges].mean()), 3),
        "all": round(float(held[seen].mean()), 3),
        "seconds": round(time.monotonic() - started, 1),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.imaging.uncertainty", description=__doc__)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join([*CHOSEN_ON, *OTHERS]))
    parser.add_argument("--size-px", nargs=2, type=int, default=(320, 240))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--prior", choices=["tv", "patches", "learned", "auto"], default="auto")
    options = parser.parse_args()
    if unknown := set(options.scenes) - {*CHOSEN_ON, *OTHERS}:
        parser.error(f"no scenes called {', '.join(sorted(unknown))}; see --help")
    width, height = options.size_px
    for name in options.scenes or (*CHOSEN_ON, *OTHERS):
        for snr in _SNRS:
            row: dict[str, Any] = {"scene": name, "constants_chosen_on_it": name in CHOSEN_ON, "snr": snr}
            row |= covered(made(name, snr, (width, height), options.seed), options.prior)
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
