"""Windows of a large plane that stand for all of it where only few numbers are sought, such as a weight."""

import numpy as np

from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.solver.data_fit import SceneProblem

# Side of a window in samples: what lies beyond its edges is unknown to it, so that it should not be small.
SIDE = 256

# The windows have this share of the plane's samples together, and at least so many: the darkest scenes, of SNR 0.05,
# need that many to tell weights that are a quarter apart. A plane less than twice that large stands for itself.
_SHARE, _MIN_SAMPLES = 1 / 16, 2**20


def windows_of(problem: SceneProblem, min_views: int) -> list[SceneProblem]:
    """Return the problems of windows in rows and columns over a large plane; none for smaller planes, and for several.

    Parameters
    ----------
    problem : SceneProblem
        One plane. The windows share its images. Each is worked on by one thread, so that several can be at a time.
    min_views : int
        Windows that fewer views see are left out.
    """
    operator = problem.operator
    if not isinstance(operator, PlaneOperator):
        return []
    rows, columns = operator.grid.shape
    wanted = max(_MIN_SAMPLES, _SHARE * rows * columns)
    if rows * columns < 2 * wanted or min(rows, columns) < 2 * SIDE:
        return []
    across = max(round((wanted * columns / rows) ** 0.5 / SIDE), 1)
    down = max(round(wanted / SIDE**2 / across), 1)
    windows, maps = [], dict[float, Image]()
    for row, column in np.ndindex(down, across):
        try:
            window = operator.window(_middle(row, rows, down), _middle(column, columns, across), 1, maps)
        except GeometryMismatch:  # no view sees it
            continue
        if len(window.seeing_views) >= min_views:
            windows.append(SceneProblem(window, problem.images))
    return windows


def _middle(part: int, size: int, parts: int) -> slice:
    """Return the samples in the middle of one of several equal parts of a side."""
    first = ((2 * part + 1) * size // parts - SIDE) // 2
    return slice(first, first + SIDE)
