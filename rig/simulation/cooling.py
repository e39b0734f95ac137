"""The temperature of a simulated sensor, which its cooler brings to the set point and holds there."""

import math

import numpy as np

# Temperature of a sensor whose cooling is not simulated, and the set point of one whose is, unless it is stated.
SET_POINT_C = -20.0

# What the cooler's control leaves: three waves of this amplitude, and the range of their periods.
_RIPPLE_K, _WAVES, _PERIODS_S = 0.03, 3, (40.0, 200.0)


class Cooling:
    """The temperature of a sensor over time.

    It falls, or rises, exponentially from the temperature at which the camera was switched on, and then swings a
    little about the set point.

    Parameters
    ----------
    start_c : float or None
        Temperature at time 0; None keeps the sensor at the set point, without any ripple.
    set_point_c, time_s : float
        Set point, and the time in which the distance from it falls to 1/e.
    seed : int
        Seed of the ripple.
    """

    def __init__(self, start_c: float | None, set_point_c: float, time_s: float, seed: int) -> None:
        self._start_c = start_c
        self._set_point_c = set_point_c
        self._time_s = time_s
        generator = np.random.default_rng([seed, 2])
        self._per_s = 2.0 * np.pi / generator.uniform(*_PERIODS_S, _WAVES)
        self._phase = generator.uniform(0.0, 2.0 * np.pi, _WAVES)

    def temperature_c(self, after_s: float) -> float:
        """Return the temperature at a time after the camera was switched on."""
        if self._start_c is None:
            return self._set_point_c
        ripple_k = _RIPPLE_K * float(np.sin(self._per_s * after_s + self._phase).sum())
        return self._set_point_c + (self._start_c - self._set_point_c) * math.exp(-after_s / self._time_s) + ripple_k
