"""What does not fit together although a solution was found: said by name, with what to do about it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.errors import PoorFit
from faintfield.calib.geometry.bundle import Bundle
from faintfield.calib.geometry.observations import Node, Observations

# From this share of a view's corners on, it is the view that is wrong and not its corners.
_DOUBTFUL_SHARE, _DOUBTFUL_CORNERS = 0.2, 3

# Every corner thrown away is one the model did not explain.
_MOST_OUTLIERS = 0.1

_MOST_NAMED = 5

# A node that lies this far from its place, in pitches, is another one, or the stage lost steps.
_ELSEWHERE = 0.3
_REWEIGHTINGS = 50

# No stage is that wrong: then it is the boards that are not what is stated.
_MOST_SCALE_ERROR, _SCALE_SIGMAS = 0.005, 4.0


def doubtful_views(bundle: Bundle, observations: Observations) -> list[str]:
    """Return the views whose corners disagree with all others.

    Raises
    ------
    PoorFit
        There are so many that none can be trusted.
    """
    seen = (observations.weights > 0).sum(axis=(1, 2))
    lost = seen - bundle.inlier.sum(axis=(1, 2))
    worst = [
        view
        for view in np.argsort(-lost / seen, kind="stable")
        if lost[view] >= max(_DOUBTFUL_CORNERS, _DOUBTFUL_SHARE * seen[view])
    ]
    named = [f"{observations.view_name(view)} ({lost[view]} of {seen[view]} corners)" for view in worst[:_MOST_NAMED]]
    more = f" and {len(worst) - _MOST_NAMED} more" if len(worst) > _MOST_NAMED else ""
    share = lost.sum() / seen.sum()
    if share > _MOST_OUTLIERS:
        raise PoorFit(
            f"{share:.0%} of the corners disagree with the fit, limit {_MOST_OUTLIERS:.0%}"
            f"{', most at ' + ', '.join(named) + more if named else ''}; check that every image has its right node and "
            "sweep, that columns and rows are those of the print, and that no board moved within a sweep"
        )
    if not named:
        return []
    return [
        f"corners disagree with all other images at {', '.join(named)}{more}: they were left out; check the node and "
        "sweep of these images, and whether they are shaken or the board moved; take them again"
    ]


def doubtful_scale(axis: str, scale: float, sigma: float) -> list[str]:
    """Return a word on distances of nodes that no stage gets so wrong, over what it was told."""
    if abs(scale - 1) <= max(_MOST_SCALE_ERROR, _SCALE_SIGMAS * sigma):
        return []
    return [
        f"along {axis} the nodes lie {abs(scale - 1):.1%} {'farther apart' if scale > 1 else 'closer together'} than "
        "pitch_mm says: measure square_mm on the print (all depths and distances follow it), then check the stage's "
        "steps per mm"
    ]


def nodes_elsewhere(nodes: Sequence[Node], centres_mm: NDArray[np.float64]) -> list[str]:
    """Return the nodes that lie far from where the others put them, by least absolute distances to a regular grid."""
    grid = np.column_stack([np.ones(len(nodes)), np.array(nodes, float)])
    if len(nodes) < grid.shape[1] + 2 or np.linalg.matrix_rank(grid) < grid.shape[1]:
        return []
    distances = np.ones(len(nodes))
    for _ in range(_REWEIGHTINGS):
        roots = 1 / np.sqrt(np.maximum(distances, 1e-6))[:, np.newaxis]
        solution = np.linalg.lstsq(roots * grid, roots * centres_mm, rcond=None)[0]
        distances = np.linalg.norm(centres_mm - grid @ solution, axis=1)
    places = grid @ solution
    pitch_mm = float(np.linalg.norm(solution[1:], axis=1).min())
    found = []
    for index in np.flatnonzero(distances > _ELSEWHERE * pitch_mm).tolist():
        away = np.linalg.norm(places - centres_mm[index], axis=1)
        there = int(np.argmin(away))
        known = there != index and away[there] < _ELSEWHERE * pitch_mm
        where = f", where node {nodes[there]} belongs" if known else ""
        found.append(
            f"node {nodes[index]} lies {distances[index]:.1f} mm from its place{where}: check the node of its images, "
            "and whether the stage lost steps"
        )
    return found
