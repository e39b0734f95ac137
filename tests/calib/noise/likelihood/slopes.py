"""Derivatives by small differences."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray


def slopes(
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]], at: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the derivative (value, parameter) by central differences."""
    steps = 1e-5 * np.eye(len(at))
    return np.stack([(function(at + step) - function(at - step)) / 2e-5 for step in steps], axis=-1)
