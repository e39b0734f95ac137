"""The configuration of the demo's rig, full-sized or small, with light for the SNR asked for."""

from dataclasses import dataclass
from typing import Self

import msgspec
import numpy as np

from faintfield.recon.metrics import signal_scale_for_snr
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.plan import Grid
from faintfield.rig.settings import (
    BoardSettings,
    CheckSettings,
    DriftSettings,
    RigSettings,
    SceneSettings,
    SettleSettings,
    StepSettings,
)
from faintfield.rig.simulation.lab import flat_photons_per_s, lab_experiment
from faintfield.rig.simulation.scene import render
from faintfield.rig.stages.protocol import Point, StageSettings

EXPOSURE_S = 0.1

# Sweeps over the nodes with a board at another place each.
_BOARD_SWEEPS = 6


@dataclass(frozen=True)
class DemoSize:
    """How much is captured: nodes along each side of the grid, their pitch, pixels, and dark and flat frames."""

    nodes: int
    pitch_mm: float
    size_px: tuple[int, int]
    frames: int

    @classmethod
    def full(cls) -> Self:
        """Return the paper's grid and a detector of the usual demo."""
        return cls(7, 50.0, (640, 480), 10)

    @classmethod
    def quick(cls) -> Self:
        """Return the same baseline with fewer nodes, a quarter of the pixels and fewer frames."""
        return cls(5, 75.0, (320, 240), 6)


def demo_rig(size: DemoSize, snr: float, seed: int) -> RigSettings:
    """Return the configuration of the demo's rig.

    Parameters
    ----------
    size : DemoSize
        How much is captured.
    snr : float
        SNR of the dark views, eq. (4); it sets the light.
    seed : int
        Seed of the random generator.
    """
    camera = SimulatedSettings(size.size_px, position_error_mm=0.3, rotation_error_mrad=3.5, seed=seed)
    steps = [
        *[StepSettings("charuco", 0.1)] * _BOARD_SWEEPS,
        StepSettings("bright", 0.02),
        StepSettings("dark_scene", EXPOSURE_S),
        StepSettings("noise_reference", EXPOSURE_S, at="centre"),
        StepSettings("dark", (0.1, 1.0, 10.0, 60.0), size.frames),
        StepSettings("flat", (0.05, 0.1), size.frames, photons_per_s=flat_photons_per_s(camera)),
    ]
    return RigSettings(
        stage=StageSettings("simulated", port="simulated:grbl:pty"),
        camera=msgspec.structs.replace(camera, unlit_photons_per_s=_photons_per_s(camera, snr)),
        grid=Grid(size.nodes, size.nodes, size.pitch_mm, Point(-350.0, -350.0)),
        step=tuple(steps),
        settle=SettleSettings(measure=False, wait_s=2.5),
        checks=CheckSettings(saturation_dn=float(camera.saturation_dn)),
        drift=DriftSettings(),
        scene=SceneSettings((500.0, 700.0)),
        board=(BoardSettings("large", 9, 7, 40.0, 30.0, "DICT_4X4_50"),),
    )


def _photons_per_s(camera: SimulatedSettings, snr: float) -> float:
    """Return the light of a white object, in photons per second and pixel, that gives the reference view an SNR."""
    experiment = lab_experiment(camera)
    sensor = experiment.sensor
    view = next(render(experiment.planes, experiment.optics, np.zeros((1, 6)), samples_per_px=1))
    on_object = view.light[np.sum(list(view.visible.values()), axis=0) > 0.5]
    dark_e = sensor.dark_current_e_per_s * EXPOSURE_S
    white_e = signal_scale_for_snr(on_object, snr, dark_e, sensor.read_noise_e)
    return white_e / (sensor.quantum_efficiency * EXPOSURE_S)
