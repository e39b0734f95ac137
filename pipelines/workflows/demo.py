"""The whole experiment on a simulated rig, from a capture to the report with its errors: `faintfield demo`."""

import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise_model import NoiseModel
from faintfield.pipelines.arguments import Method
from faintfield.pipelines.console import inform
from faintfield.pipelines.formats.exchange.imported_set import relative
from faintfield.pipelines.formats.files import check_free, exclusive, write_json, write_record
from faintfield.pipelines.formats.results.figures import METRICS_FILE, GeometryErrors, KnownValue, Metrics
from faintfield.pipelines.formats.results.geometry import CameraPoses, read_geometry
from faintfield.pipelines.formats.results.noise import NOISE_FILE, read_noise
from faintfield.pipelines.formats.results.plane_files import plane_name
from faintfield.pipelines.formats.results.records import RECONSTRUCTION_FILE, ReconstructionRecord
from faintfield.pipelines.formats.results.surface import read_result
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS, load_session, nominal_session
from faintfield.pipelines.formats.toml_files import write_toml
from faintfield.pipelines.live.guided import capture_session
from faintfield.pipelines.pages.report import write_report
from faintfield.pipelines.reconstruction.accuracy import assess
from faintfield.pipelines.reconstruction.options import Options
from faintfield.pipelines.reconstruction.request import DEFAULT_METHOD, Request, folder_of_method, select_planes
from faintfield.pipelines.reconstruction.run import reconstruct_set
from faintfield.pipelines.reconstruction.surface.request import select_surface
from faintfield.pipelines.simulation.synthetic_set import NOISE_FREE, render_scene, write_ground_truth
from faintfield.pipelines.workflows.session import run_steps, session_steps
from faintfield.recon.metrics import signal_scale_for_snr
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.plan import Grid
from faintfield.rig.session.session import read_plan, taken_frames
from faintfield.rig.settings import (
    BoardSettings,
    CheckSettings,
    DriftSettings,
    RigSettings,
    SceneSettings,
    SettleSettings,
    StepSettings,
)
from faintfield.rig.simulation.experiment import SimulatedExperiment
from faintfield.rig.simulation.lab import TRUE_POSE, flat_photons_per_s, lab_experiment
from faintfield.rig.simulation.scene import render
from faintfield.rig.stages.protocol import Point, StageSettings

# The file that marks a folder as made by a demo; the next demo may replace such a folder.
_MARK = "demo.json"

# The methods that are compared, beside single planes of total variation.
_METHODS: list[Method] = ["backprojection", "pmlem-osl", "occlusion"]

type Node = tuple[int, int]

_EXPOSURE_S = 0.1

# Every byte passes through a pseudo-terminal and pyserial where the system has pseudo-terminals.
_PORT = "simulated:grbl" if sys.platform == "win32" else "simulated:grbl:pty"

# Depths among which the surface is searched.
_RANGE_MM = "400:900"

# Sweeps over the nodes with a board at another place each.
_BOARD_SWEEPS = 5


@dataclass(frozen=True)
class DemoSize:
    """Size of the capture: nodes along each side of the grid, their pitch, pixels, and dark and flat frames."""

    nodes: int
    pitch_mm: float
    size_px: tuple[int, int]
    frames: int


# The paper's grid and a detector of the usual size; and the same baseline with fewer nodes, pixels and frames.
FULL = DemoSize(7, 50.0, (640, 480), 10)
QUICK = DemoSize(5, 75.0, (320, 240), 6)


class DemoResult(msgspec.Struct, frozen=True):
    """The result of `faintfield demo`."""

    out: str
    report: str
    metrics: Metrics


def run_demo(out: Path, quick: bool, snr: float, seed: int) -> DemoResult:
    """Capture the demo's scene, measure and reconstruct it, and compare the results with the truth."""
    _make_free(out)
    settings = demo_rig(QUICK if quick else FULL, snr, seed)
    write_toml(out / "rig.toml", settings)
    session = out / "session"
    inform(
        "capturing: boards, a toy truck at 500 mm and a toy airplane at 700 mm, almost dark, then dark and flat frames"
    )
    capture_session(settings, session, unattended=True, page=False)
    depths = list(settings.scene.depth_mm)
    asked = Options(depth_mm=[*depths], method=_METHODS, surface=True, depth_range_mm=_RANGE_MM)
    run_steps(session, session_steps(session, select_planes(asked), select_surface(asked)))
    inform("looking up the truth, and reconstructing with it and without any measured poses, for comparison")
    truth = write_truth(out / "truth", session, snr)
    _reconstruct(load_set(truth / NOISE_FREE), out / "noise-free", Request(depths, ["backprojection"]))
    alone = Request(depths, [DEFAULT_METHOD])  # by total variation
    _reconstruct(load_session(session), out / "tv", alone)
    _reconstruct(nominal_session(session), out / "nominal", alone)
    _reconstruct(true_set(session, truth), out / "true", alone)
    metrics = demo_metrics(out, session, truth)
    write_record(out / METRICS_FILE, metrics)
    return DemoResult(str(out), str(write_report(out)), metrics)


def _reconstruct(elemental_set: ElementalSet, out: Path, request: Request) -> None:
    """Reconstruct planes without a report of their own: the demo's shows them."""
    with exclusive(out):
        reconstruct_set(elemental_set, out, request)


def _make_free(out: Path) -> None:
    """Remove what an earlier demo left, and nothing else."""
    check_free(out, replace_if=_MARK)
    for name in ("session", "truth", "noise-free", "tv", "nominal", "true"):
        shutil.rmtree(out / name, ignore_errors=True)
    write_json(out / _MARK, {"format": 1, "made_by": "faintfield demo"})


def demo_rig(size: DemoSize, snr: float, seed: int) -> RigSettings:
    """Return the configuration of the demo's rig; `snr`, eq. (4), sets the light of the dark views."""
    camera = SimulatedSettings(size.size_px, position_error_mm=0.3, rotation_error_mrad=3.5, seed=seed)
    steps = (
        *[StepSettings("charuco", 0.1)] * _BOARD_SWEEPS,
        StepSettings("bright", 0.02),
        StepSettings("dark_scene", _EXPOSURE_S),
        StepSettings("noise_reference", _EXPOSURE_S, at="centre"),
        StepSettings("dark", (0.1, 1.0, 10.0, 60.0), size.frames),
        StepSettings("flat", (0.025, 0.05, 0.1), size.frames, photons_per_s=flat_photons_per_s(camera)),
    )
    return RigSettings(
        stage=StageSettings("simulated", port=_PORT),
        camera=msgspec.structs.replace(camera, unlit_photons_per_s=_photons_per_s(camera, snr)),
        grid=Grid(size.nodes, size.nodes, size.pitch_mm, Point(-350.0, -350.0)),
        step=steps,
        settle=SettleSettings(measure=False, wait_s=2.5),
        checks=CheckSettings(saturation_dn=float(camera.saturation_dn)),
        drift=DriftSettings(),
        scene=SceneSettings((500.0, 700.0)),
        board=(BoardSettings("large", 9, 7, 40.0, 30.0, "DICT_4X4_50"),),
    )


def _photons_per_s(camera: SimulatedSettings, snr: float) -> float:
    """Return the light of a white object that gives the reference view an SNR, in photons per second and pixel."""
    experiment = lab_experiment(camera)
    sensor = experiment.sensor
    view = next(render(experiment.planes, experiment.optics, np.zeros((1, 6)), samples_per_px=1))
    on_object = view.light[np.sum(list(view.visible.values()), axis=0) > 0.5]
    dark_e = sensor.dark_current_e_per_s * _EXPOSURE_S
    white_e = signal_scale_for_snr(on_object, snr, dark_e, sensor.read_noise_e)
    return white_e / (sensor.quantum_efficiency * _EXPOSURE_S)


def write_truth(out: Path, session: Path, snr: float) -> Path:
    """Write the noise-free views, the textures and the true poses of a session of the simulated lab; return `out`."""
    camera, grid = _camera(session), read_plan(session).rig.grid
    poses = true_poses(session)
    exposures = {frame.exposure_s for frame, _, _ in taken_frames(session) if frame.kind == "dark_scene"}
    lab = lab_experiment(camera)
    experiment = SimulatedExperiment(
        lab.planes, lab.optics, lab.sensor, grid.rows, grid.columns, grid.pitch_mm, sum(exposures)
    )
    white_e = camera.unlit_photons_per_s * sum(exposures) * lab.sensor.quantum_efficiency
    in_order = np.stack([poses[node] for node in sorted(poses)])
    scene = render_scene(experiment, in_order, camera.mosaic, samples_per_px=1)  # as the simulated camera renders
    out.mkdir(parents=True)
    write_ground_truth(out, scene, white_e, snr)
    return out


def true_poses(session: Path) -> dict[Node, NDArray[np.float64]]:
    """Return rt_cam_ref (6,) of every node's dark-scene frame, as the simulated world has recorded it."""
    recorded = {
        frame.stop.node: np.array(taken.record.camera[TRUE_POSE])
        for frame, taken, _ in taken_frames(session)
        if frame.kind == "dark_scene"
    }
    reference = recorded[read_plan(session).plan.centre.node]
    return {node: relative(pose, reference) for node, pose in recorded.items()}


def true_set(session: Path, truth: Path) -> ElementalSet:
    """Return a session's dark-scene views with their true lens, poses, response and noise."""
    elemental_set, free = nominal_session(session), load_set(truth / NOISE_FREE)
    poses = {view.node: view.rt_cam_ref for view in free.settings.view}
    views = [msgspec.structs.replace(view, rt_cam_ref=poses[view.node]) for view in elemental_set.settings.view]
    camera = msgspec.structs.replace(free.settings.camera, flat=None, mosaic=elemental_set.settings.camera.mosaic)
    sensor = lab_experiment(_camera(session)).sensor
    names = ("offset_dn", "gain_dn_per_e", "read_noise_e", "dark_current_e_per_s", "quantum_efficiency")
    noise = NoiseModel(**{name: getattr(sensor, name) for name in names}, saturation_dn=float(sensor.saturation_dn))
    return replace(
        elemental_set,
        settings=msgspec.structs.replace(elemental_set.settings, camera=camera, view=views),
        noise=noise,
        flat=free.flat,
        unusable=np.zeros_like(elemental_set.unusable),
        poses="true",
    )


def demo_metrics(out: Path, session: Path, truth: Path) -> Metrics:
    """Return the errors of geometry, noise and planes against the truth that `write_truth` wrote.

    Kinds of poses are compared by single planes of total variation.
    """
    depths = read_plan(session).rig.scene.depth_mm
    results = session / RECONSTRUCTIONS

    def metrics_of(elemental_set: ElementalSet, folders: dict[Method, Path]) -> Metrics:
        planes = {
            (method, depth): folders[method] / f"{plane_name(depth)}.tiff" for method in folders for depth in depths
        }
        results = [read_result(folder / RECONSTRUCTION_FILE, ReconstructionRecord) for folder in folders.values()]
        metrics = assess(elemental_set, planes, [record for result in results for record in result.planes], truth)
        assert metrics is not None
        return metrics

    folders = {method: folder_of_method(results, method, _METHODS) for method in _METHODS}
    metrics = metrics_of(load_session(session), folders | {DEFAULT_METHOD: out / "tv"})
    errors = [*metrics.planes]
    for elemental_set in (nominal_session(session), true_set(session, truth)):
        errors += metrics_of(elemental_set, {DEFAULT_METHOD: out / elemental_set.poses}).planes
    geometry, noise = _geometry_errors(session), _noise_errors(session)
    return msgspec.structs.replace(metrics, geometry=geometry, noise=noise, planes=errors)


def _geometry_errors(session: Path) -> GeometryErrors:
    poses = true_poses(session)
    measured = {entry.node: np.array(entry.rt_cam_ref) for entry in read_geometry(session, CameraPoses).nodes}
    shared = sorted(measured.keys() & poses.keys())
    off_mm = np.array([_centre_mm(measured[node]) - _centre_mm(poses[node]) for node in shared])
    turned_rad = np.array([relative(measured[node], poses[node])[:3] for node in shared])
    x_mm, y_mm, z_mm = np.sqrt(np.mean(np.square(off_mm), axis=0)).tolist()
    return GeometryErrors(
        nodes=len(shared),
        centre_rms_mm=float(np.sqrt(np.mean(np.sum(np.square(off_mm), axis=1)))),
        centre_rms_axes_mm=(x_mm, y_mm, z_mm),
        rotation_rms_mdeg=float(1e3 * np.degrees(np.sqrt(np.mean(np.sum(np.square(turned_rad), axis=1))))),
    )


def _noise_errors(session: Path) -> dict[str, KnownValue]:
    sensor = lab_experiment(_camera(session)).sensor
    noise = read_noise(session / NOISE_FILE)
    names = ("read_noise_e", "dark_current_e_per_s", "gain_dn_per_e", "offset_dn")
    measured = {name: getattr(noise, name) for name in names}
    return {name: KnownValue(value.value, value.se, getattr(sensor, name)) for name, value in measured.items()}


def _centre_mm(rt_cam_ref: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(-cv2.Rodrigues(rt_cam_ref[:3])[0].T @ rt_cam_ref[3:], np.float64)


def _camera(session: Path) -> SimulatedSettings:
    camera = read_plan(session).rig.camera
    assert isinstance(camera, SimulatedSettings)
    return camera
