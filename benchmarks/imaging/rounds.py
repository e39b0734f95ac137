"""Rounds until a noise is reached, by the noise that the planes then have: `python -m benchmarks.imaging.rounds`.

Sessions of the simulated rig are captured with `until`, at SNRs by eq. (4) of the brightest part of a frame. Found is
the standard deviation of a back-projected sample over the rounds of another session, of as many as are possible, for
samples about the axis, of which the prediction is, and for all that every view sees, which the lens darkens; it falls
with the root of the rounds. The rounds that were needed follow from it. The prediction knows the sensor and the
frames, not the scene.
"""

import argparse
from math import ceil, sqrt
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from benchmarks.imaging.plan_accuracy import noise_model, plane_operator
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.live.guided import capture_session
from faintfield.pipelines.planning.sample_noise import MeasuredNoise
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.solver.initialization import back_projection
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.plan import Grid, Until, nominal_poses_rt_cam_ref
from faintfield.rig.session.journal import RoundsEnded
from faintfield.rig.session.session import ROUNDS_ENDED, open_journal, read_plan, taken_frames
from faintfield.rig.settings import DriftSettings, RigSettings, SceneSettings, SettleSettings, StepSettings
from faintfield.rig.simulation.lab import lab_experiment
from faintfield.rig.stages.protocol import Point, StageSettings

_SNRS = (0.1, 0.5, 2.0)
_DEPTH_MM, _EXPOSURE_S, _ROUNDS = 700.0, 0.1, 12
# Light of the brightest part of a frame over that of a white object, by the simulated scene without noise.
_BRIGHTEST = 0.72
# Samples about the axis lie within this part of the width of a frame.
_NEAR_AXIS = 1 / 8
# Wanted noise as parts of that of one round.
_WANTED = (0.8, 0.6, 0.5, 0.45, 0.4, 0.35)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.imaging.rounds", description=__doc__)
    parser.add_argument("--size-px", nargs=2, type=int, default=(320, 240))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pitch-mm", type=float, default=20.0, help="of the grid; 21 moves a 320 px picture by 12 px")
    options = parser.parse_args()
    print("| SNR wanted, found | σ of a round: axis, all | wanted σ | rounds taken | needed: axis, all |")
    print("|---|---|---|---|---|")
    apart = []
    for snr in _SNRS:
        axis_e, all_e, _, measured_snr = _session(snr, None, options.seed, options)
        for index, part in enumerate(_WANTED):
            wanted_e = part * axis_e
            until = Until(wanted_e, _ROUNDS)
            _, _, rounds, _ = _session(snr, until, options.seed + 1 + index, options)
            needed = [ceil((sigma_e / wanted_e) ** 2) for sigma_e in (axis_e, all_e)]
            apart.append(rounds - needed[0])
            sigmas = f"{axis_e:.3f}, {all_e:.3f} | {wanted_e:.3f}"
            print(f"| {snr:g}, {measured_snr:.2f} | {sigmas} | {rounds} | {needed[0]}, {needed[1]} |", flush=True)
    print(f"rounds taken less those needed: {min(apart)} to {max(apart)}")


def _session(
    snr: float, until: Until | None, seed: int, options: argparse.Namespace
) -> tuple[float, float, int, float]:
    """Capture a session; return σ of a round about the axis and of all samples, the rounds, and the measured SNR."""
    settings = _settings(snr, until or Until(1e-9, _ROUNDS), seed, options)
    with TemporaryDirectory(prefix="faintfield-") as name:
        folder, rig = Path(name) / "session", Path(name) / "rig.toml"
        predictor = MeasuredNoise(settings, rig, folder, None, None, None, light_e_per_s=None)
        capture_session(settings, folder, unattended=True, page=False, noise=predictor.predict)
        with open_journal(folder, read_plan(folder), read_only=True) as journal:
            ended = journal.details(ROUNDS_ENDED, RoundsEnded)
        frames = taken_frames(folder)
        found_snr = float(np.mean([taken.record.checks["snr"] for _, taken, _ in frames]))
        rounds = ended[0].rounds if ended else _ROUNDS
        if until is not None:
            return 0.0, 0.0, rounds, found_snr
        planes = _planes(settings, folder)
    sigma_e = np.std(planes, axis=0, ddof=1)
    rows, columns = (np.arange(length) - length / 2 for length in sigma_e.shape)
    near = np.hypot(rows[:, np.newaxis], columns) < _NEAR_AXIS * options.size_px[0]
    return _rms(sigma_e[near]), _rms(sigma_e), rounds, found_snr


def _settings(snr: float, until: Until, seed: int, options: argparse.Namespace) -> RigSettings:
    camera = SimulatedSettings(size_px=tuple(options.size_px), seed=seed)
    sensor = lab_experiment(camera).sensor
    noise_e2 = sensor.read_noise_e**2 + 1 / (12 * sensor.gain_dn_per_e**2)
    light_e = -0.5 + sqrt(0.25 + snr * noise_e2)  # eq. (4) of even light: λ² + λ = SNR σ²
    photons_per_s = light_e / sensor.quantum_efficiency / _EXPOSURE_S / _BRIGHTEST
    return RigSettings(
        stage=StageSettings("simulated"),
        camera=replace(camera, unlit_photons_per_s=photons_per_s),
        grid=Grid(7, 7, options.pitch_mm, Point(-350.0, -350.0)),
        step=(StepSettings("dark_scene", _EXPOSURE_S, until=until),),
        settle=SettleSettings(measure=False),
        drift=DriftSettings(check=False),
        scene=SceneSettings((_DEPTH_MM,)),
    )


def _planes(settings: RigSettings, folder: Path) -> NDArray[np.float64]:
    """Return the back-projection (round, row, column) of each round, where all views see it."""
    assert isinstance(settings.camera, SimulatedSettings)
    experiment, grid = lab_experiment(settings.camera), settings.grid
    poses = nominal_poses_rt_cam_ref(grid.rows, grid.columns, grid.pitch_mm)
    operator, noise = plane_operator(experiment, poses, _DEPTH_MM), noise_model(experiment.sensor)
    rounds = np.empty((_ROUNDS, len(poses), *experiment.optics.size_px[::-1]), np.float32)
    for frame, _, path in taken_frames(folder):
        row, column = frame.stop.node
        rounds[frame.round, row * grid.columns + column] = noise.electrons(read_frame(path).pixels_dn)
    dark_e = experiment.sensor.dark_current_e_per_s * _EXPOSURE_S
    images = [ElementalImages(electrons, dark_e, noise.read_variance_e2()) for electrons in rounds]
    planes = np.stack([back_projection(operator, of_round) for of_round in images])
    margin = ceil(grid.columns // 2 * grid.pitch_mm * experiment.optics.fx_px / _DEPTH_MM) + 1
    return np.asarray(planes[:, margin:-margin, margin:-margin], np.float64)


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
