"""Compare penalties, each at its best weight for the true picture, on four objects at SNR 0.16.

The paper claims that total variation is best. Run `python -m benchmarks.imaging.penalties`; it prints one JSON object
of mean square errors, the object scaled to run from 0 to 1.
"""

import argparse
import json
import sys
from collections.abc import Callable

import numpy as np

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.metrics import mean_square_error, signal_scale_for_snr
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.solver.data_fit import DataFit
from faintfield.recon.solver.initialization import smooth_start
from faintfield.recon.solver.penalties import Penalty, PenaltyName
from faintfield.recon.solver.penalty_weight import universal_penalty_weight
from faintfield.recon.solver.pmlem import pmlem
from faintfield.rig.simulation.objects import shaded_ball, star_chart, toy_airplane, toy_truck
from faintfield.rig.simulation.scene import TexturedPlane

_VIEWS, _SIZE_PX, _SNR, _READ_VARIANCE_E2, _DARK_E = 49, 192, 0.16, 12.0, 0.02
_PENALTIES: tuple[PenaltyName, ...] = ("tv", "huber-tv", "quadratic")
_FACTORS = np.geomspace(0.35, 5.6, 9)


def pictures() -> dict[str, Image]:
    """Return the four objects' textures, scaled from 0 to 1."""
    makers: dict[str, Callable[[float, float, float], TexturedPlane]] = {
        "truck": toy_truck,
        "airplane": toy_airplane,
        "star": star_chart,
        "ball": shaded_ball,
    }
    places = np.linspace(0, 1, _SIZE_PX)
    scaled = {}
    for name, make in makers.items():
        shown = make(0.0, 0.0, 500.0)
        reflectance = shown.reflectance if shown.reflectance.ndim == 2 else shown.reflectance.mean(axis=2)
        picture = (reflectance * shown.opacity).astype(float)
        rows, columns = ((places * (size - 1)).astype(int) for size in picture.shape)
        picture = picture[np.ix_(rows, columns)]
        scaled[name] = (picture - picture.min()) / np.ptp(picture)
    return scaled


def smallest_errors(picture: Image, seed: int = 1) -> dict[str, float]:
    """Return the smallest error of each penalty over the weights."""
    generator = np.random.default_rng(seed)
    homographies = np.stack([np.eye(3)] * _VIEWS)
    homographies[:, :2, 2] = generator.uniform(-0.5, 0.5, (_VIEWS, 2))
    axis = np.arange(float(_SIZE_PX))
    operator = PlaneOperator(
        homographies, np.stack(np.meshgrid(axis, axis), axis=-1), PlaneGrid(picture.shape, 1.0, (0.0, 0.0))
    )
    scale_e = signal_scale_for_snr(picture, _SNR, _DARK_E, _READ_VARIANCE_E2**0.5)
    counts = generator.poisson(scale_e * operator.forward(picture) + _DARK_E)
    electrons = counts + generator.normal(0, np.sqrt(_READ_VARIANCE_E2), counts.shape)
    images = ElementalImages(electrons.astype(np.float32), _DARK_E, _READ_VARIANCE_E2)
    start = smooth_start(operator, images)
    fit = DataFit(operator, images, float(start.mean()))
    noise_e = float(1 / np.sqrt(np.median(fit.metric(start))))
    guess = universal_penalty_weight(operator, images, start)
    least: dict[str, float] = {}
    for name in _PENALTIES:
        errors = []
        penalty = Penalty.for_noise(name, lambda: noise_e)
        for factor in _FACTORS:
            weight = guess * float(factor)
            for iterate in pmlem(fit, start, penalty_weight=weight, penalty=penalty):
                if iterate.certificate.distance < 0.01 or iterate.passes >= 20:
                    break
            errors.append(float(mean_square_error(iterate.plane / scale_e, picture)))
        least[name] = min(errors)
    return least


if __name__ == "__main__":
    argparse.ArgumentParser(prog="python -m benchmarks.imaging.penalties", description=__doc__).parse_args()
    sys.stdout.write(json.dumps({name: smallest_errors(picture) for name, picture in pictures().items()}) + "\n")
