"""Gain by maps per pixel on an sCMOS sensor: `python -m benchmarks.calibration.sensor_maps [SEEDS] [WIDTH HEIGHT]`.

Each simulated sensor has log-normal read noise (median 1.2 e⁻, a tail to 10 e⁻, columns that differ), 1 % telegraph
pixels, offsets of pixels and columns, gains that differ by 1 % from pixel to pixel and by 2 % between two taps, and
1 % of PRNU beside. It is calibrated from 40 darks and 40 flats each of three levels. Then 49 views of the demo's truck
at SNR 0.16, one frame each, are reconstructed by PMLEM four times: with one number for all pixels; with maps of offset
and response, and defects left out; with all maps; and with the true maps. Printed as JSON, for each sensor and as
means: errors of the maps against the truth, and the mean squared error of each picture over that of one number.
"""

import argparse
import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise import Conditions, NoiseCalibration, Series, calibrate, measure_series
from faintfield.calib.noise_model import NoiseModel
from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.reconstruction.planes.solve import solve
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.metrics import signal_scale_for_snr
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.rig.simulation.experiment import paper_experiment
from faintfield.rig.simulation.scene import render

type Array = NDArray[np.float64]

_FRAMES, _FLATS_E, _DARK_E = 40, (1000.0, 4000.0, 12000.0), 0.02
_VIEWS, _SNR = 49, 0.16


@dataclass(frozen=True)
class Sensor:
    """One sCMOS; arrays (row, column). A telegraph pixel is up by `jump_e` in a share `up` of the frames."""

    offset_dn: Array
    gain_dn_per_e: Array
    read_noise_e: Array
    response: Array
    jump_e: Array
    up: Array

    def expose(self, light_e: Array, rng: np.random.Generator) -> NDArray[np.uint16]:
        """Return a frame in DN of expected electrons (row, column)."""
        shape = self.offset_dn.shape
        electrons = rng.poisson(light_e * self.response + _DARK_E) + self.read_noise_e * rng.standard_normal(shape)
        electrons += self.jump_e * (rng.random(shape) < self.up)
        return np.clip(np.rint(self.offset_dn + self.gain_dn_per_e * electrons), 0, 65535).astype(np.uint16)

    @property
    def total_noise_e(self) -> Array:
        """Read noise with the jumps."""
        return np.asarray(np.sqrt(self.read_noise_e**2 + self.jump_e**2 * self.up * (1 - self.up)))

    @property
    def mean_offset_dn(self) -> Array:
        """Offset with the mean of the jumps."""
        return self.offset_dn + self.gain_dn_per_e * self.jump_e * self.up


def make_sensor(shape: tuple[int, int], rng: np.random.Generator) -> Sensor:
    """Return one specimen."""
    columns = shape[1]
    noise = 1.2 * np.exp(0.2 * rng.standard_normal(shape) + 0.08 * rng.standard_normal((1, columns)))
    tail = rng.random(shape) < 0.02
    noise = np.where(tail, noise * np.exp(rng.exponential(0.7, shape)), noise)
    taps = np.where(np.arange(columns) < columns // 2, 0.99, 1.01)
    return Sensor(
        offset_dn=100 + rng.normal(0, 1.0, shape) + rng.normal(0, 1.0, (1, columns)),
        gain_dn_per_e=2.0 * taps * (1 + 0.01 * rng.standard_normal(shape)),
        read_noise_e=np.minimum(noise, 10.0),
        response=1 + 0.01 * rng.standard_normal(shape),
        jump_e=np.where(rng.random(shape) < 0.01, rng.uniform(3.0, 12.0, shape), 0.0),
        up=rng.uniform(0.1, 0.9, shape),
    )


def record(sensor: Sensor, rng: np.random.Generator) -> list[Series]:
    """Take the darks and flats."""
    lights = [("dark", 0.0), *(("flat", light) for light in _FLATS_E)]
    series = []
    for level, (kind, light_e) in enumerate(lights):
        even = np.full(sensor.up.shape, light_e)
        frames = ((f"{kind}_{level}_{k}", sensor.expose(even, rng)) for k in range(_FRAMES))
        dark = kind == "dark"
        series.append(
            measure_series(frames, Conditions("dark", 0.1) if dark else Conditions("flat", 0.1, level, light_e))
        )
    return series


def map_errors(sensor: Sensor, calibration: NoiseCalibration, dark: Series) -> dict[str, float]:
    """Return rms errors of the maps over usable pixels: of the pixel's own frames, one number, and the map."""
    used = ~calibration.maps.unusable
    one, maps = calibration.noise_model(per_pixel=False), calibration.noise_model()
    raw_e = np.sqrt(np.maximum(dark.within_dn2 / (_FRAMES - 1) - 1 / 12, 0.0)) / one.gain_dn_per_e

    def rms(error: Any) -> float:
        return float(np.sqrt(np.mean(np.square(error[used]))))

    return {
        **{
            f"read_noise_{name}": rms(value / sensor.total_noise_e - 1)
            for name, value in (("raw", raw_e), ("one", one.read_noise_e), ("map", maps.read_noise_e))
        },
        **{
            f"offset_{name}_dn": rms(value - sensor.mean_offset_dn)
            for name, value in (("raw", dark.mean_dn), ("one", one.offset_dn), ("map", maps.offset_dn))
        },
        **{
            f"gain_{name}": rms(value / sensor.gain_dn_per_e - 1)
            for name, value in (("one", one.gain_dn_per_e), ("map", maps.gain_dn_per_e))
        },
    }


def _truck(size_px: tuple[int, int]) -> Array:
    """Return the demo's first object (row, column) as the reference camera sees it."""
    experiment = paper_experiment(*size_px)
    view = next(render([experiment.planes[0].grey()], experiment.optics.ideal(), np.zeros((1, 6))))
    return np.asarray(view.light, np.float64)


def picture_errors(sensor: Sensor, calibration: NoiseCalibration, rng: np.random.Generator) -> dict[str, float]:
    """Return the mean squared error of the picture with each kind of calibration, in (e⁻)²."""
    shape = sensor.up.shape
    truth = _truck((shape[1], shape[0]))
    on = truth > 0
    truth *= signal_scale_for_snr(truth[on], _SNR, _DARK_E, float(np.sqrt(np.mean(sensor.total_noise_e**2))))
    homographies = np.stack([np.eye(3)] * _VIEWS)
    homographies[:, :2, 2] = rng.uniform(-3, 3, (_VIEWS, 2))
    rays = np.stack(np.meshgrid(np.arange(float(shape[1])), np.arange(float(shape[0]))), axis=-1)
    grid = PlaneGrid(shape, 1.0, (0.0, 0.0))
    light = PlaneOperator(homographies, rays, grid).forward(truth.astype(np.float32))
    frames = [sensor.expose(view.astype(float), rng) for view in light]
    one, maps = calibration.noise_model(per_pixel=False), calibration.noise_model()
    usable = ~calibration.maps.unusable
    response = np.where(
        usable, 1.0 if calibration.maps.relative_response is None else calibration.maps.relative_response, 0
    )
    levels = NoiseModel(maps.offset_dn, one.gain_dn_per_e, one.read_noise_e, one.dark_current_e_per_s)
    true = NoiseModel(sensor.mean_offset_dn, sensor.gain_dn_per_e, sensor.total_noise_e, _DARK_E / 0.1)
    errors = {}
    for name, model, flat in (
        ("one_number", one, np.ones(shape)),
        ("offset_and_response", levels, response),
        ("all_maps", maps, response),
        ("true_maps", true, sensor.response),
    ):
        electrons = np.stack([model.electrons(frame) for frame in frames])
        images = ElementalImages(electrons, model.background_e(0.1), model.read_variance_e2())
        operator = PlaneOperator(homographies, rays, grid, flat=flat.astype(np.float32))
        plane = solve(operator, images, "pmlem", SolverOptions()).plane
        errors[name] = float(np.mean((plane - truth) ** 2))
    return errors


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibration.sensor_maps", description=__doc__)
    parser.add_argument("seeds", type=int, nargs="?", default=5)
    parser.add_argument("width", type=int, nargs="?", default=128)
    parser.add_argument("height", type=int, nargs="?", default=96)
    arguments = parser.parse_args()
    seeds, width, height = arguments.seeds, arguments.width, arguments.height
    results = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        sensor = make_sensor((height, width), rng)
        series = record(sensor, rng)
        calibration = calibrate(series, 65535)
        errors = picture_errors(sensor, calibration, rng)
        relative = {f"mse_{name}": error / errors["one_number"] for name, error in errors.items()}
        results.append({"mse_e2": errors["one_number"], **relative, **map_errors(sensor, calibration, series[0])})
        print(json.dumps({"seed": seed, **{name: round(value, 4) for name, value in results[-1].items()}}), flush=True)
    means = {name: float(np.mean([result[name] for result in results])) for name in results[0]}
    errors = {
        f"{n}_se": float(np.std([result[n] for result in results], ddof=1) / seeds**0.5) for n in means if seeds > 1
    }
    print(json.dumps({"mean": {name: round(value, 4) for name, value in (means | errors).items()}}))


if __name__ == "__main__":
    main()
