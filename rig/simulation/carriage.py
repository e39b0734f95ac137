"""The errors of real rails: the pose of the camera differs from the position of the motors."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from faintfield.rig.stages.protocol import Point

# Bent rails and eccentric pulleys: number of waves over the travel, and the range of their lengths in mm.
_WAVES, _WAVE_LENGTHS_MM = 8, (80.0, 400.0)


@dataclass(frozen=True)
class Carriage:
    """Maps motor positions to camera poses, repeatably and without error at the centre.

    Parameters
    ----------
    centre : Point
        Motor position of the reference pose.
    position_sd_mm, rotation_sd_rad : float
        Standard deviation over the travel of the error of each axis, relative to the centre.
    scale_error : float
        Relative excess of distances along the columns' axis.
    squareness_rad : float
        Difference of a right angle and the angle between the axes.
    seed : int
        Seed of the shape of the rails.
    """

    centre: Point
    position_sd_mm: float = 0.0
    rotation_sd_rad: float = 0.0
    scale_error: float = 0.0
    squareness_rad: float = 0.0
    seed: int = 0

    def rt_cam_ref(self, x_mm: float, y_mm: float) -> NDArray[np.float64]:
        """Return the camera pose (6,), Rodrigues rad and mm, at a motor position."""
        right_mm, down_mm = x_mm - self.centre.x_mm, y_mm - self.centre.y_mm
        sd = np.repeat([self.rotation_sd_rad, self.position_sd_mm], 3)
        pose: NDArray[np.float64] = sd * (self._waves(right_mm, down_mm) - self._waves(0.0, 0.0))
        right_mm = right_mm * (1.0 + self.scale_error) + down_mm * np.sin(self.squareness_rad)
        down_mm *= np.cos(self.squareness_rad)
        # A camera moved right and down by c maps reference points by −c
        pose[3:5] -= right_mm, down_mm
        return pose

    def _waves(self, x_mm: float, y_mm: float) -> NDArray[np.float64]:
        """Return the errors (6,) of the rails; the difference of two distant positions has variance 1."""
        x_per_mm, y_per_mm, phase = self._shape
        return np.asarray(np.sin(x_per_mm * x_mm + y_per_mm * y_mm + phase).sum(axis=1) / np.sqrt(_WAVES))

    @cached_property
    def _shape(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the wave vectors' x and y and the phases, each (6, wave)."""
        generator = np.random.default_rng([self.seed, 1])
        direction, phase = generator.uniform(0.0, 2.0 * np.pi, (2, 6, _WAVES))
        per_mm = 2.0 * np.pi / generator.uniform(*_WAVE_LENGTHS_MM, (6, _WAVES))
        return per_mm * np.cos(direction), per_mm * np.sin(direction), phase
