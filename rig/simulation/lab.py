"""The simulated lab: what stands before the camera in each step, seen from where the stage truly is."""

import math
from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rig.boards import Board
from rig.plan import StepKind
from rig.simulation.experiment import SimulatedExperiment, paper_experiment
from rig.simulation.lab_boards import standing_board
from rig.simulation.scene import TexturedPlane, render
from rig.stages.protocol import Point

# After a stop the carriage swings along both axes, as an undamped gantry does.
_SWING_MM, _SWING_HZ, _SWING_DECAY_S = 1.5, 7.0, 0.25


class SimulatedLab:
    """Scene, light and sensor around a simulated stage.

    Parameters
    ----------
    centre : Point
        Where the stage has the camera in the reference pose.
    true_position : callable
        Where the carriages really are, whatever the controller reports.
    still_s : callable
        How long ago they stopped.
    boards : sequence of Board
        What there is to put up for charuco sweeps.
    size_px : (int, int)
        Of a frame.
    lit_photons_per_s, unlit_photons_per_s : float
        On a pixel that sees a white object, with the lights on and almost off.
    seed : int
        Of all chance; every exposure's noise follows from it and the exposure's number alone.
    """

    def __init__(
        self,
        centre: Point,
        true_position: Callable[[], Point],
        still_s: Callable[[], float],
        boards: tuple[Board, ...],
        *,
        size_px: tuple[int, int],
        lit_photons_per_s: float,
        unlit_photons_per_s: float,
        seed: int,
    ) -> None:
        self._centre = centre
        self._true_position = true_position
        self._still_s = still_s
        self._boards = boards
        self._size_px = size_px
        self._lit, self._unlit = lit_photons_per_s, unlit_photons_per_s
        self._seed = seed
        self._planes: tuple[TexturedPlane, ...] = ()
        self._photons_per_s = 0.0
        self._flat = False

    @cached_property
    def _experiment(self) -> SimulatedExperiment:
        """The paper's objects and camera, drawn when they are first looked at."""
        return paper_experiment(*self._size_px).grey()

    @cached_property
    def _illumination(self) -> NDArray[np.float32]:
        """What the lens lets through."""
        return self._experiment.optics.relative_illumination()

    def arrange(self, kind: StepKind, sweep: int) -> None:
        """Do what the guide asks of a person: put things up or away, switch the light, cover the lens."""
        self._planes = ()
        if kind == "charuco":
            optics = self._experiment.optics
            self._planes = tuple(standing_board(board, sweep, at, optics) for at, board in enumerate(self._boards))
        elif kind in ("bright", "dark_scene"):
            self._planes = self._experiment.planes
        self._photons_per_s = self._unlit if kind == "dark_scene" else self._lit
        self._flat = kind == "flat"

    def expose(self, exposure_s: float, number: int) -> NDArray[np.uint16]:
        """Return a frame in DN, taken now from where the camera is."""
        light: NDArray[np.floating] = np.zeros_like(self._illumination)
        if self._flat:
            light = 0.5 * self._illumination
        elif self._planes:
            light = next(render(self._planes, self._experiment.optics, self._pose(exposure_s), samples_per_px=1)).light
        generator = np.random.default_rng([self._seed, number])
        return self._experiment.sensor.expose(light * self._photons_per_s * exposure_s, exposure_s, generator)

    def _pose(self, exposure_s: float) -> NDArray[np.float64]:
        """Return the pose (1, 6) in the middle of an exposure that begins now, swing included."""
        x_mm, y_mm = self._true_position()
        after_s = self._still_s() + 0.5 * exposure_s
        swing_mm = _SWING_MM * math.exp(-after_s / _SWING_DECAY_S) * math.cos(2.0 * math.pi * _SWING_HZ * after_s)
        # A camera moved right and down by c maps reference points by −c
        return np.array([[0, 0, 0, self._centre.x_mm - x_mm - swing_mm, self._centre.y_mm - y_mm - swing_mm, 0.0]])
