"""How often the 90 % interval of a sample holds the truth: `python -m benchmarks.uncertainty [SETS]`.

Each set has one object of the demo scene alone, its expected light that of SNR 0.16, in 49 views displaced by up to
three samples, with its own noise; half of the sets have the truck and half the airplane. Reconstructed with the
weight that held-out views choose. Printed as JSON: the share of samples whose interval f ± 1.645 σ holds the truth,
on the object, beside it, and everywhere.
"""

import json
import sys

import numpy as np

from faintfield.pipelines.reconstruction.planes import Settings, solve
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.rig.simulation.experiment import paper_experiment
from faintfield.rig.simulation.scene import render

# Two-sided 90 % of the normal distribution.
_WITHIN = 1.6449

_LIGHT_E, _READ_NOISE_E, _VIEWS = 0.92, 3.464, 49


def texture(index: int, size_px: tuple[int, int]) -> Image:
    """Return one object of the demo scene (row, column) in expected electrons."""
    experiment = paper_experiment(*size_px)
    view = next(render([experiment.planes[index].grey()], experiment.optics.ideal(), np.zeros((1, 6))))
    return np.asarray(view.light * (_LIGHT_E / view.light[view.light > 0].mean()), np.float32)


def covered(truth: Image, seed: int) -> tuple[float, float, float]:
    """Return the share of samples whose interval holds the truth: on the object, beside it, and everywhere."""
    generator = np.random.default_rng(seed)
    homographies = np.stack([np.eye(3)] * _VIEWS)
    homographies[:, :2, 2] = generator.uniform(-3, 3, (_VIEWS, 2))
    rows, columns = truth.shape
    rays = np.stack(np.meshgrid(np.arange(float(columns)), np.arange(float(rows))), axis=-1)
    operator = PlaneOperator(homographies, rays, PlaneGrid(truth.shape, 1.0, (0.0, 0.0)))
    light = operator.forward(truth)
    electrons = generator.poisson(light) + generator.normal(0, _READ_NOISE_E, light.shape)
    images = ElementalImages(electrons.astype(np.float32), 0.0, _READ_NOISE_E**2)
    found = solve(operator, images, "pmlem", Settings(uncertainty=True))
    held = np.abs(found.plane - truth) <= _WITHIN * found.sidecars["sigma"]
    on = truth > 0
    return float(held[on].mean()), float(held[~on].mean()), float(held.mean())


def main() -> None:
    """Measure and print."""
    sets = int(sys.argv[1]) if len(sys.argv) > 1 else 50
    result = []
    for size_px in ((160, 120), (320, 240)):
        for index, name in enumerate(("truck", "airplane")):
            truth = texture(index, size_px)
            shares = np.array([covered(truth, seed) for seed in range(sets // 2)])
            keys = ("on_object", "beside", "all")
            means = dict(zip(keys, shares.mean(axis=0).round(3).tolist(), strict=True))
            result.append({"object": name, "size_px": size_px, "sets": sets // 2, **means})
            print(json.dumps(result[-1]), flush=True)


if __name__ == "__main__":
    main()
