"""How real rails carry a camera: not quite where the motors are, and not quite straight."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from faintfield.rig.stages.protocol import Point

# Bent rails and eccentric pulleys: waves of these lengths over the travel, so many of them.
_WAVES, _WAVE_LENGTHS_MM = 8, (80.0, 400.0)


@dataclass(frozen=True)
class Carriage:
    """Where the camera is when the motors are at a position; the same each time, and without error at the centre.

    Parameters
    ----------
    centre : Point
        Where the motors have the camera in the reference pose.
    position_sd_mm, rotation_sd_rad : float
        Standard deviation over the travel of each axis's error against the centre.
    scale_error : float
        By which part of itself a way along the columns' axis is longer than told.
    squareness_rad : float
        By how much the angle between the axes falls short of a right one.
    seed : int
        Of the shape of the rails.
    """

    centre: Point
    position_sd_mm: float = 0.0
    rotation_sd_rad: float = 0.0
    scale_error: float = 0.0
    squareness_rad: float = 0.0
    seed: int = 0

    def rt_cam_ref(self, x_mm: float, y_mm: float) -> NDArray[np.float64]:
        """Return the pose (6,), Rodrigues rad and mm, of the camera when the motors are at a position."""
        right_mm, down_mm = x_mm - self.centre.x_mm, y_mm - self.centre.y_mm
        sd = np.repeat([self.rotation_sd_rad, self.position_sd_mm], 3)
        pose: NDArray[np.float64] = sd * (self._waves(right_mm, down_mm) - self._waves(0.0, 0.0))
        right_mm = right_mm * (1.0 + self.scale_error) + down_mm * np.sin(self.squareness_rad)
        down_mm *= np.cos(self.squareness_rad)
        # A camera moved right and down by c maps reference points by −c
        pose[3:5] -= right_mm, down_mm
        return pose

    def _waves(self, x_mm: float, y_mm: float) -> NDArray[np.float64]:
        """Return the rails' shape (6,); a difference of two far places has variance 1."""
        x_per_mm, y_per_mm, phase = self._shape
        return np.asarray(np.sin(x_per_mm * x_mm + y_per_mm * y_mm + phase).sum(axis=1) / np.sqrt(_WAVES))

    @cached_property
    def _shape(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return wave vectors and phases (6, wave)."""
        generator = np.random.default_rng([self.seed, 1])
        direction, phase = generator.uniform(0.0, 2.0 * np.pi, (2, 6, _WAVES))
        per_mm = 2.0 * np.pi / generator.uniform(*_WAVE_LENGTHS_MM, (6, _WAVES))
        return per_mm * np.cos(direction), per_mm * np.sin(direction), phase
