"""Predictions of `faintfield plan` against simulated captures: `python -m benchmarks.imaging.plan_accuracy [STUDY …]`.

`sigma`: the paper's truck before the paper's camera, at SNRs by eq. (4) and on grids of several sizes. The rig's
simulation renders and exposes the views, which share no code with the operator; each is exposed anew for every draw,
and reconstructed without a penalty by one step of maximum likelihood and by back-projection. Found is the root mean
square over the object's samples of the standard deviation over draws. The prediction knows the mean light on the
object, the sensor, and the number of views.

`features`: an even card with a darker square of the smallest contrast that is predicted to be visible. Found is how
many standard deviations its best linear estimate is from zero, which should be 5 (of a black square where none is dark
enough, and in proportion), and the standard deviation of the best linear estimate of the depth of a black square, both
from rendered differences and drawn noise.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.homography import fronto_parallel_rt_ref_plane, plane_from_ray
from faintfield.calib.noise_model import NoiseModel
from faintfield.recon.likelihood.images import ElementalImages, Image, select_likelihood
from faintfield.recon.metrics import signal_scale_for_snr
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.prediction import (
    depth_sigma_mm,
    information_of_views,
    interpolation,
    sample_sigma_e,
    smallest_contrast,
)
from faintfield.recon.solver.data_fit import DataFit
from faintfield.recon.solver.initialization import back_projection, smooth_start
from faintfield.rig.plan import nominal_poses_rt_cam_ref
from faintfield.rig.simulation.experiment import SimulatedExperiment, paper_experiment
from faintfield.rig.simulation.objects import toy_truck
from faintfield.rig.simulation.optics import SimulatedOptics, SimulatedSensor
from faintfield.rig.simulation.scene import TexturedPlane, render

_SNRS, _GRIDS, _READ_NOISES_E = (0.05, 0.16, 0.5, 1.6, 5.0), (3, 5, 7, 9, 11), (12**0.5, 0.7)
_SIDES_PX, _SNRS_OF_FEATURES = (2.0, 5.0, 10.0), (0.16, 5.0)

# All views of the largest grid see the object.
_PITCH_MM, _DEPTH_MM, _EXPOSURE_S = 20.0, 500.0, 0.1

# Errors of the poses, which the reconstruction knows, as those of `faintfield simulate`.
_POSITION_SD_MM, _ROTATION_SD_RAD = 0.3, 0.0035

# The camera and grid of `features`: few pixels, of which a square moves over some ten from the first view to the last.
_NEAR = SimulatedOptics((64, 64), 400.0, 400.0, 31.5, 31.5, vignetting=False)
_NEAR_PITCH_MM = 5.0

# Samples of a square per pixel, in its texture and along the rays, so that its edges move evenly; and the change of
# depth that gives the derivative.
_FINE, _STEP_MM = 8, 1.0


def sigma(options: argparse.Namespace) -> None:
    """Print a table of predicted and found standard deviations."""
    print("| read noise, e⁻ | SNR | light, e⁻ | grid | predicted σ, e⁻ | found | back-projection | predicted / found |")
    print("|---|---|---|---|---|---|---|---|")
    ratios = []
    for read_noise_e in _READ_NOISES_E:
        for snr in _SNRS:
            for count in _GRIDS:
                light_e, predicted, found, averaged = _sigmas(read_noise_e, snr, count, options)
                ratios.append(predicted / found)
                given = f"{read_noise_e:.2f} | {snr:g} | {light_e:.3f} | {count} x {count}"
                sigmas = f"{predicted:.4f} | {found:.4f} | {averaged:.4f} | {predicted / found:.3f}"
                print(f"| {given} | {sigmas} |", flush=True)
    print(f"predicted / found: {min(ratios):.3f} to {max(ratios):.3f}")


def _sigmas(
    read_noise_e: float, snr: float, count: int, options: argparse.Namespace
) -> tuple[float, float, float, float]:
    """Return the light on the object, and σ: predicted, found by one step of maximum likelihood, by back-projection."""
    generator = np.random.default_rng([options.seed, count, round(100 * snr), round(100 * read_noise_e)])
    experiment = paper_experiment(*options.size_px).grey()
    experiment = replace(experiment, rows=count, columns=count, pitch_mm=_PITCH_MM)
    truck, optics = toy_truck(0.0, 0.0, _DEPTH_MM).grey(), experiment.optics
    sensor = SimulatedSensor(read_noise_e=read_noise_e)
    dark_e = sensor.dark_current_e_per_s * _EXPOSURE_S
    poses = experiment.poses_rt_cam_ref(_POSITION_SD_MM, _ROTATION_SD_RAD, generator)
    views = list(render([truck], optics, poses))
    reference = views[experiment.reference_view]
    on_object = reference.light[reference.visible[truck.name] > 0.5]
    white_e = signal_scale_for_snr(on_object, snr, dark_e, read_noise_e)
    expected_e = np.stack([view.light for view in views]) * white_e
    operator = plane_operator(experiment, poses, _DEPTH_MM)
    seen = next(render([truck], optics.ideal(), np.zeros((1, 6)))).visible[truck.name] > 0.99
    noise = noise_model(sensor)
    estimates: list[list[Image]] = [[], []]
    for _ in range(options.draws):
        drawn = [sensor.expose(view / sensor.quantum_efficiency, _EXPOSURE_S, generator) for view in expected_e]
        electrons = np.stack([noise.electrons(frame) for frame in drawn])
        images = ElementalImages(electrons, dark_e, noise.read_variance_e2())
        likelihood = select_likelihood(images, "auto", float(on_object.mean()) * white_e)
        estimates[0].append(_one_step(operator, replace(images, likelihood=likelihood))[seen])
        estimates[1].append(back_projection(operator, images)[seen])
    found, averaged = (float(np.sqrt(np.var(drawn, axis=0, ddof=1).mean())) for drawn in estimates)
    light_e = float(on_object.mean()) * white_e
    response = _response_on_axis(experiment)
    information = information_of_views(light_e, dark_e, float(np.sqrt(noise.read_variance_e2())), response)
    return light_e, sample_sigma_e(float(information.sum()), interpolation(count**2)), found, averaged


def _response_on_axis(experiment: SimulatedExperiment) -> NDArray[np.float64]:
    """Return the light of the middle of the plane in each view relative to that on the lens's axis, by cos⁴."""
    poses = experiment.nominal_poses_rt_cam_ref()
    return np.asarray(1 / (1 + np.square(poses[:, 3:5] / _DEPTH_MM).sum(axis=1)) ** 2)


def _one_step(operator: PlaneOperator, images: ElementalImages) -> Image:
    """Return one step of maximum likelihood from the smooth start, without a penalty and without f ≥ 0."""
    start = smooth_start(operator, images)
    fit = DataFit(operator, images, max(float(start.mean()), 1e-6))
    return np.asarray(start - fit.value_and_gradient(start)[1] / fit.metric(start))


def plane_operator(experiment: SimulatedExperiment, poses: NDArray[np.float64], depth_mm: float) -> PlaneOperator:
    """Return H of a plane at a depth, one sample per pixel of the reference view."""
    optics = experiment.optics
    pitch_mm = depth_mm / optics.fx_px
    grid = PlaneGrid(optics.size_px[::-1], pitch_mm, (-optics.cx_px * pitch_mm, -optics.cy_px * pitch_mm))
    homographies = plane_from_ray(poses, fronto_parallel_rt_ref_plane(depth_mm))
    return PlaneOperator(homographies, optics.rays(1), grid, flat=optics.relative_illumination())


def noise_model(sensor: SimulatedSensor) -> NoiseModel:
    """Return what is known of the sensor."""
    return NoiseModel(sensor.offset_dn, sensor.gain_dn_per_e, sensor.read_noise_e, sensor.dark_current_e_per_s)


def features(options: argparse.Namespace) -> None:
    """Print a table of squares at their smallest contrast, and of the depth of black ones."""
    print("| SNR | grid | side, px | smallest contrast | deviations | σ of depth, mm | found | predicted / found |")
    print("|---|---|---|---|---|---|---|---|")
    for count in (3, 7):
        for side_px in _SIDES_PX:
            generator = np.random.default_rng([options.seed, count, round(side_px)])
            poses = nominal_poses_rt_cam_ref(count, count, _NEAR_PITCH_MM)
            poses[:, 3:5] += generator.normal(0, _POSITION_SD_MM, (count**2, 2))
            black, nearer, farther = (_seen(side_px, _DEPTH_MM + step, poses) for step in (0, -_STEP_MM, _STEP_MM))
            moved = (farther - nearer) / (2 * _STEP_MM)
            for snr in _SNRS_OF_FEATURES:
                found = _feature(snr, side_px, poses, black, moved, generator, 40 * options.draws)
                contrast, deviations, predicted_mm, found_mm = found
                given = f"{snr:g} | {count} x {count} | {side_px:g} | {contrast:.3f} | {deviations:.2f}"
                sigmas = f"{predicted_mm:.2f} | {found_mm:.2f} | {predicted_mm / found_mm:.3f}"
                print(f"| {given} | {sigmas} |", flush=True)


def _seen(side_px: float, depth_mm: float, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the share (view, row, column) of each pixel that a square covers; the middle view shows it alike."""
    mm_per_px = depth_mm / _NEAR.fx_px
    opacity = np.pad(np.ones((round(side_px * _FINE),) * 2, np.float32), 2)
    place = (0.0, 0.0, 0.0, 0.37 * mm_per_px, 0.61 * mm_per_px, depth_mm)
    square = TexturedPlane("square", np.ones_like(opacity), opacity, mm_per_px / _FINE, place)
    return np.stack([view.light for view in render([square], _NEAR, poses, samples_per_px=_FINE)]).astype(np.float64)


def _feature(
    snr: float,
    side_px: float,
    poses: NDArray[np.float64],
    black: NDArray[np.float64],
    moved: NDArray[np.float64],
    generator: np.random.Generator,
    draws: int,
) -> tuple[float, float, float, float]:
    """Return the smallest contrast, deviations found at it, and σ of depth of a black square, predicted and found."""
    sensor = SimulatedSensor()
    noise, dark_e = noise_model(sensor), sensor.dark_current_e_per_s * _EXPOSURE_S
    light_e = signal_scale_for_snr(np.ones(1), snr, dark_e, sensor.read_noise_e)
    information = information_of_views(light_e, dark_e, float(np.sqrt(noise.read_variance_e2())), np.ones(len(poses)))
    contrast = smallest_contrast(side_px, light_e, float(information.sum()))
    shown = min(contrast, 1.0)
    photons = light_e * (1 - shown * black) / sensor.quantum_efficiency
    found: list[list[float]] = [[], []]
    for _ in range(draws):
        missing = light_e + dark_e - noise.electrons(sensor.expose(photons, _EXPOSURE_S, generator))
        found[0].append(float(np.vdot(black, missing) / np.vdot(black, black)))
        found[1].append(float(np.vdot(moved, missing) / np.vdot(moved, moved)) / light_e)
    predicted_mm = depth_sigma_mm(
        _DEPTH_MM, _NEAR.fx_px, -poses[:, 3:5], information, side_px=side_px, difference_e=light_e
    )
    deviations = float(np.mean(found[0]) / np.std(found[0], ddof=1)) * contrast / shown
    return contrast, deviations, predicted_mm, float(np.std(found[1], ddof=1))


_STUDIES: dict[str, Callable[[argparse.Namespace], None]] = {"sigma": sigma, "features": features}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.imaging.plan_accuracy", description=__doc__)
    parser.add_argument("studies", nargs="*", metavar="STUDY", help=", ".join(_STUDIES))
    parser.add_argument("--size-px", nargs=2, type=int, default=(320, 240))
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    if unknown := set(options.studies) - _STUDIES.keys():
        parser.error(f"no studies called {', '.join(sorted(unknown))}; see --help")
    for name in options.studies or _STUDIES:
        _STUDIES[name](options)


if __name__ == "__main__":
    main()
