"""Warnings about views, nodes and scales that contradict the solution, each with what to do about it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.errors import PoorFit
from faintfield.calib.geometry.bundle import Bundle
from faintfield.calib.geometry.observations import Node, Observations

# A view is inconsistent if at least this share of its corners, and this many, are outliers: fewer are lone corners.
_MIN_OUTLIER_SHARE_OF_VIEW, _MIN_OUTLIERS_OF_VIEW = 0.2, 3

# Largest share of outliers among all corners; the model does not explain a set with more.
_MAX_OUTLIER_SHARE = 0.1

# Views that a message names, so that it stays readable.
_MAX_NAMED = 5

# A node farther than this from its place, in pitches, has the label of another one, or the stage lost steps.
_MAX_NODE_ERROR = 0.3
_REWEIGHTINGS = 50  # of the least absolute distances

# Largest relative error of a stage's scale, and the standard errors that it must exceed as well; beyond, it is the
# boards that differ from what is stated.
_MAX_SCALE_ERROR, _SCALE_SIGMAS = 0.005, 4.0


def inconsistent_views(bundle: Bundle, observations: Observations) -> list[str]:
    """Return a warning that names the views whose corners disagree with all others; empty if there is none.

    Raises
    ------
    PoorFit
        Too many corners disagree for any view to be trusted.
    """
    seen = (observations.weights > 0).sum(axis=(1, 2))
    lost = seen - bundle.inlier.sum(axis=(1, 2))
    worst = [
        view
        for view in np.argsort(-lost / seen, kind="stable")
        if lost[view] >= max(_MIN_OUTLIERS_OF_VIEW, _MIN_OUTLIER_SHARE_OF_VIEW * seen[view])
    ]
    named = [f"{observations.view_name(view)} ({lost[view]} of {seen[view]} corners)" for view in worst[:_MAX_NAMED]]
    more = f" and {len(worst) - _MAX_NAMED} more" if len(worst) > _MAX_NAMED else ""
    share = lost.sum() / seen.sum()
    if share > _MAX_OUTLIER_SHARE:
        raise PoorFit(
            f"{share:.0%} of the corners disagree with the fit, limit {_MAX_OUTLIER_SHARE:.0%}"
            f"{', most at ' + ', '.join(named) + more if named else ''}; check that every image has its right node and "
            "sweep, that columns and rows are those of the print, and that no board moved within a sweep"
        )
    if not named:
        return []
    return [
        f"corners disagree with all other images at {', '.join(named)}{more}: they were left out; check the node and "
        "sweep of these images, and whether they are shaken or the board moved; take them again"
    ]


def scale_warnings(axis: str, scale: float, sigma: float) -> list[str]:
    """Return a warning if distances between nodes differ from the pitch by more than a stage's error."""
    if abs(scale - 1) <= max(_MAX_SCALE_ERROR, _SCALE_SIGMAS * sigma):
        return []
    return [
        f"along {axis} the nodes lie {abs(scale - 1):.1%} {'farther apart' if scale > 1 else 'closer together'} than "
        "pitch_mm says: measure square_mm on the print (all depths and distances follow it), then check the stage's "
        "steps per mm"
    ]


def misplaced_nodes(nodes: Sequence[Node], centres_mm: NDArray[np.float64]) -> list[str]:
    """Return a warning for each node far from its place in the regular grid of least absolute distances."""
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
    for index in np.flatnonzero(distances > _MAX_NODE_ERROR * pitch_mm).tolist():
        away = np.linalg.norm(places - centres_mm[index], axis=1)
        there = int(np.argmin(away))
        known = there != index and away[there] < _MAX_NODE_ERROR * pitch_mm
        where = f", where node {nodes[there]} belongs" if known else ""
        found.append(
            f"node {nodes[index]} lies {distances[index]:.1f} mm from its place{where}: check the node of its images, "
            "and whether the stage lost steps"
        )
    return found
