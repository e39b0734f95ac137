"""Coverage where one object hides another: `python -m benchmarks.imaging.hidden_uncertainty`.

The whole scene of the demo, truck before airplane, at four signal-to-noise ratios. One line of JSON for each method and
prior: the share of the samples that the reference view sees of each object whose interval f ± 1.645 σ holds the truth.
"""

import argparse
import itertools
import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import faintfield
from faintfield.pipelines.arguments import Method, PriorName
from faintfield.pipelines.formats.sets.ground_truth import read_truth, texture_and_region

_SNRS = (0.05, 0.16, 0.5, 2.0)
_METHODS: tuple[Method, ...] = ("pmlem", "joint", "occlusion")
_PRIORS: tuple[PriorName, ...] = ("tv", "auto")

# Two-sided 90 % of the normal distribution.
_WITHIN = 1.6449


def coverages(folder: Path, method: Method, prior: PriorName) -> dict[str, float]:
    """Return the share of intervals that hold the truth, by object."""
    light_field, truth = faintfield.open(folder), read_truth(folder)
    assert isinstance(light_field, faintfield.LightField)
    assert truth is not None
    depths = [plane.depth_mm for plane in truth.planes]
    planes = light_field.planes(depths, method=method, prior=prior, uncertainty=True)
    shares = {}
    for of_object in truth.planes:
        texture, region = texture_and_region(folder, of_object)
        plane = next(plane for plane in planes if abs(plane.depth - of_object.depth_mm) < 0.1)
        assert plane.sigma is not None
        holds = np.abs(plane.image - texture) <= _WITHIN * plane.sigma
        shares[of_object.name] = round(float(holds[region].mean()), 3)
    return shares


def main() -> None:
    """Print the coverage at each signal-to-noise ratio."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--size-px", type=int, nargs=2, default=(320, 240), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with TemporaryDirectory() as folder:
        for snr in _SNRS:
            out = Path(folder) / f"{snr:g}"
            options = faintfield.SyntheticOptions(snr=snr, size_px=tuple(given.size_px), seed=given.seed)
            faintfield.simulate(out, options=options)
            for method, prior in itertools.product(_METHODS, _PRIORS):
                print(
                    json.dumps({"snr": snr, "method": method, "prior": prior} | coverages(out, method, prior)),
                    flush=True,
                )


if __name__ == "__main__":
    main()
