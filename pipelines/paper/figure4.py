"""Figure 4 of the paper: the error of the reconstruction against the SNR, by several methods, for four objects.

To compare one more method, add an entry to `METHODS`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.homography import fronto_parallel_rt_ref_plane, plane_from_ray
from faintfield.calib.lens import Lens
from faintfield.pipelines.arguments import PriorName, SolverOptions
from faintfield.pipelines.console import progress
from faintfield.pipelines.formats.results.records import Method
from faintfield.pipelines.reconstruction.planes.solve import solve
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.metrics import mean_square_error, signal_scale_for_snr
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.solver.initialization import back_projection
from faintfield.rig.simulation.experiment import SimulatedExperiment, paper_experiment
from faintfield.rig.simulation.objects import sailing_boat, shaded_ball, toy_airplane, toy_truck
from faintfield.rig.simulation.scene import TexturedPlane, render


@dataclass(frozen=True)
class FigureMethod:
    """A method that makes a plane from dark views.

    `plane` takes the operator, the images and one of the `weights`, if there are any; it returns the plane (row,
    column) in electrons. It is None for a method whose errors stand in a table. The best weight only the true object
    tells. `draws` limits the draws of the noise, for methods that are slow and far from the best.
    """

    name: str
    title: str
    plane: Callable[..., Image] | None
    weights: tuple[float, ...] = ()
    draws: int | None = None


def _solved(
    method: Method,
    operator: PlaneOperator,
    images: ElementalImages,
    weight: float | Literal["auto"] = "auto",
    prior: PriorName = "tv",
) -> Image:
    return solve(operator, images, method, SolverOptions(penalty_weight=weight, prior=prior)).plane


BACK_PROJECTION = "backprojection"

# The default of `reconstruct`; total variation alone; and the same with the best weight, which only the truth tells.
OURS, TOTAL_VARIATION, BEST = "pmlem-auto", "pmlem", "pmlem-best"
_PMLEM_WEIGHTS = tuple(np.geomspace(1.0, 3.2, 6).tolist())

PEER = "bm3d"
PEER_FILE = Path(__file__).parent / "bm3d_errors.json"

# The first is the reference for the others.
METHODS = (
    FigureMethod(BACK_PROJECTION, "back-projection", back_projection),
    FigureMethod("pmlem-osl", "PMLEM, one-step-late, weight from the noise", partial(_solved, "pmlem-osl"), draws=2),
    FigureMethod(BEST, "PMLEM, total variation, best weight", partial(_solved, "pmlem"), _PMLEM_WEIGHTS),
    FigureMethod(TOTAL_VARIATION, "PMLEM, total variation, weight from held-out views", partial(_solved, "pmlem")),
    FigureMethod(PEER, "back-projection + BM3D, best weight", None),
    FigureMethod("pmlem-patches", "PMLEM, prior of patches", partial(_solved, "pmlem", prior="patches")),
    FigureMethod(OURS, "PMLEM, prior auto", partial(_solved, "pmlem", prior="auto")),
)

OBJECTS = (toy_truck, toy_airplane, sailing_boat, shaded_ball)
SNRS = tuple(round(0.16 + 0.01 * step, 2) for step in range(8))
PAPERS_AXIS = (0.0, 0.12)

_DEPTH_MM = 600.0

# A plane extends beyond its object on each side by the object's width divided by this.
_MARGIN_DIVISOR = 16

# Back-projections of the same exposure by different versions of the libraries differ by less than this.
_SAME_MSE = 1e-3

_POSITION_SD_MM, _ROTATION_SD_RAD = 0.3, 3.5e-3


class ErrorPoint(msgspec.Struct, frozen=True):
    """The error of one object by one method, of one draw of the noise.

    `mse` is against the back-projection of the views without noise, over the object, scaled to 0…1; `mse_texture` is
    against the object itself. `weight` is the best one, where the method was given that.
    """

    object: str
    snr: float
    method: str
    mse: float
    seed: int
    mse_texture: float
    weight: float | None


class PeerTable(msgspec.Struct, frozen=True):
    """Errors of a program that is no part of faintfield, measured once: `bm3d_errors.json`.

    `errors` also has those of the back-projections that the program denoised. They tell the exposures apart.
    """

    program: str
    made: str
    command: str
    errors: list[ErrorPoint]


class CurvePoint(msgspec.Struct, frozen=True):
    """The mean over the draws of the noise, and its standard error (None for a single draw)."""

    object: str
    method: str
    snr: float
    draws: int
    mse: float
    standard_error: float | None
    mse_texture: float


@dataclass(frozen=True)
class StagedObject:
    """One object alone before the camera, and the planes that reconstructions are compared with.

    Attributes
    ----------
    light : float32 array (view, row, column)
        Light of the views, relative to that of a white object.
    region : bool array (row, column)
        Mask of the object in the reference view, whose `window` the plane's samples overlay.
    bright, texture : float array (row, column)
        The back-projection of `light`, and the object itself, at the plane's samples.
    """

    name: str
    experiment: SimulatedExperiment
    operator: PlaneOperator
    light: NDArray[np.float32]
    region: NDArray[np.bool_]
    window: tuple[slice, slice]
    bright: Image
    texture: Image

    def exposures(self, seed: int) -> Iterator[tuple[float, ElementalImages, float]]:
        """Yield SNR, images, and the electrons of a white object, from the darkest exposure to the brightest.

        Each is the previous one with more photons and the same read noise.
        """
        sensor, exposure_s = self.experiment.sensor, self.experiment.exposure_s
        dark_e = sensor.dark_current_e_per_s * exposure_s
        in_region = self.light[self.experiment.reference_view][self.region]
        generator = np.random.default_rng(seed)
        read_noise_e = generator.normal(0.0, sensor.read_noise_e, self.light.shape)
        counts = generator.poisson(dark_e, self.light.shape)
        last_e = 0.0
        for snr in SNRS:
            scale_e = signal_scale_for_snr(in_region, snr, dark_e, sensor.read_noise_e)
            counts += generator.poisson(self.light * (scale_e - last_e))
            frames_dn = sensor.digitise(counts + read_noise_e)
            electrons = (frames_dn - np.float32(sensor.offset_dn)) / np.float32(sensor.gain_dn_per_e)
            yield snr, ElementalImages(electrons, dark_e, sensor.read_noise_e**2), scale_e
            last_e = scale_e

    def errors(self, plane: Image, scale_e: float) -> tuple[float, float]:
        """Return the mean square errors of a plane against the bright one and against the texture."""
        scaled, region = plane / scale_e, self.region[self.window]
        return mean_square_error(scaled, self.bright, region), mean_square_error(scaled, self.texture, region)


# Best weights by method and SNR.
type _Weights = dict[tuple[str, float], float | None]
type _Case = tuple[StagedObject, _Weights, int, tuple[float, ElementalImages, float]]


def measure_errors(size_px: tuple[int, int], seeds: int) -> list[ErrorPoint]:
    """Return the errors of all objects, SNRs and methods, for `seeds` draws of the noise each."""
    errors = []
    cases = progress(_exposures(size_px, seeds), "figure 4: exposures", len(OBJECTS) * seeds * len(SNRS))
    for stage, weights, seed, (snr, images, scale_e) in cases:
        for method in METHODS:
            if method.plane is None or (method.draws is not None and seed > method.draws):
                continue
            plane_of = partial(method.plane, stage.operator, images)
            if (method.name, snr) not in weights:
                weights[method.name, snr] = _best_weight(stage, plane_of, method.weights, scale_e)
            weight = weights[method.name, snr]
            mse, mse_texture = stage.errors(plane_of() if weight is None else plane_of(weight), scale_e)
            errors.append(ErrorPoint(stage.name, snr, method.name, mse, seed, mse_texture, weight))
    return errors + peer_errors(errors)


def read_peer_table() -> PeerTable:
    """Return the errors of BM3D."""
    return msgspec.json.decode(PEER_FILE.read_bytes(), type=PeerTable)


def peer_errors(errors: Sequence[ErrorPoint]) -> list[ErrorPoint]:
    """Return the errors of BM3D for the exposures of `errors`, those whose back-projection has the same error."""
    known = {(error.object, error.snr, error.seed): error.mse for error in errors if error.method == BACK_PROJECTION}
    table = read_peer_table().errors
    same = {
        key
        for error in table
        if error.method == BACK_PROJECTION
        and np.isclose(known.get(key := (error.object, error.snr, error.seed), np.nan), error.mse, rtol=_SAME_MSE)
    }
    return [error for error in table if error.method == PEER and (error.object, error.snr, error.seed) in same]


def _exposures(size_px: tuple[int, int], seeds: int) -> Iterator[_Case]:
    """Yield every object at every SNR with every draw; an object's draws share the best weights, of the first draw."""
    for make in OBJECTS:
        stage = stage_object(make(0.0, 0.0, _DEPTH_MM).grey(), size_px)
        weights: _Weights = {}
        for seed in range(1, seeds + 1):
            for exposure in stage.exposures(seed):
                yield stage, weights, seed, exposure


def _best_weight(
    stage: StagedObject, plane_of: Callable[[float], Image], weights: Sequence[float], scale_e: float
) -> float | None:
    """Return the weight whose plane is nearest to the bright one, None if there are no weights to try."""
    return min(weights, key=lambda weight: stage.errors(plane_of(weight), scale_e)[0], default=None)


def stage_object(shown: TexturedPlane, size_px: tuple[int, int]) -> StagedObject:
    """Render an object from all nodes, and without noise, and make the operator of its plane."""
    paper = paper_experiment(*size_px)
    experiment = SimulatedExperiment((shown,), paper.optics, paper.sensor)
    poses = experiment.poses_rt_cam_ref(_POSITION_SD_MM, _ROTATION_SD_RAD, np.random.default_rng(0))
    optics = experiment.optics
    light = np.stack([view.light for view in render([shown], optics, poses)])
    ideal = next(render([shown], optics.ideal(), np.zeros((1, 6))))
    lens = Lens(size_px, optics.fx_px, optics.fy_px, optics.cx_px, optics.cy_px, optics.distortion)
    region = ideal.visible[shown.name] > 0.5
    window = _window(region)
    operator = PlaneOperator(
        plane_from_ray(poses, fronto_parallel_rt_ref_plane(shown.depth_mm)),
        lens.rays(),
        _grid(experiment, window),
        flat=optics.relative_illumination(),
    )
    bright = back_projection(operator, ElementalImages(light))
    return StagedObject(shown.name, experiment, operator, light, region, window, bright, ideal.light[window])


def _window(region: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Return the rows and columns of a region with a margin: a plane of these costs a fraction of a whole one."""
    rows, columns = (np.flatnonzero(region.any(axis=axis)) for axis in (1, 0))
    margin = -(-len(columns) // _MARGIN_DIVISOR)
    first_row, first_column = max(rows[0] - margin, 0), max(columns[0] - margin, 0)
    return slice(first_row, rows[-1] + 1 + margin), slice(first_column, columns[-1] + 1 + margin)


def _grid(experiment: SimulatedExperiment, window: tuple[slice, slice]) -> PlaneGrid:
    """Return the samples that overlay a window of the reference view pixel for pixel."""
    optics = experiment.optics
    pitch_mm = _DEPTH_MM / optics.fx_px
    width, height = optics.size_px
    (top, bottom, _), (left, right, _) = window[0].indices(height), window[1].indices(width)
    origin_mm = ((left - optics.cx_px) * pitch_mm, (top - optics.cy_px) * pitch_mm)
    return PlaneGrid((bottom - top, right - left), pitch_mm, origin_mm)


def mean_curves(errors: Sequence[ErrorPoint]) -> list[CurvePoint]:
    """Return the mean over the draws, and its standard error, for each object, method and SNR."""
    groups: dict[tuple[str, str, float], list[ErrorPoint]] = {}
    for error in errors:
        groups.setdefault((error.object, error.method, error.snr), []).append(error)
    points = []
    for (name, method, snr), draws in groups.items():
        mses = [error.mse for error in draws]
        standard_error = float(np.std(mses, ddof=1) / np.sqrt(len(draws))) if len(draws) > 1 else None
        mse_texture = float(np.mean([error.mse_texture for error in draws]))
        points.append(CurvePoint(name, method, snr, len(draws), float(np.mean(mses)), standard_error, mse_texture))
    return points


def is_monotone(points: Sequence[CurvePoint], method: str) -> bool:
    """Return whether every object's mean error by a method falls from each SNR to the next."""
    curve = sorted((point.object, point.snr, point.mse) for point in points if point.method == method)
    return all(after[2] < before[2] for before, after in pairwise(curve) if after[0] == before[0])


def over_best(points: Sequence[CurvePoint], method: str, best: str) -> dict[str, float]:
    """Return for each object the largest ratio, over all SNRs, of the error by `method` to that by `best`."""
    mse = {(point.object, point.method, point.snr): point.mse for point in points}
    ratios: dict[str, float] = {}
    for point in points:
        if point.method == method:
            ratio = point.mse / mse[point.object, best, point.snr]
            ratios[point.object] = max(ratios.get(point.object, 0.0), ratio)
    return ratios
