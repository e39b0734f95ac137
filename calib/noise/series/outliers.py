"""A value that is too large to be one of the others."""

import numpy as np
from numpy.typing import NDArray
from scipy import stats

# Probability below which a value is no chance.
MAX_CHANCE = 1e-7


def outlier(values: NDArray[np.float64], min_excess: float, certain_excess: float) -> tuple[int, float]:
    """Return the index of the largest value, and its excess over the mean of the others; 0 if it can be chance.

    An excess above `certain_excess` always counts. One above `min_excess` counts if its probability, by Student's t
    from the scatter of the others, is below `MAX_CHANCE`.
    """
    largest = int(values.argmax())
    others = np.delete(values, largest)
    excess = float(values[largest] - others.mean())
    if excess > certain_excess:
        return largest, excess
    if excess < min_excess or others.size < 2:
        return largest, 0.0
    t = excess / max(float(others.std(ddof=1)) * np.sqrt(1 + 1 / others.size), 1e-12)
    return largest, excess if stats.t.sf(t, others.size - 1) < MAX_CHANCE else 0.0
