"""Diagnose the stage from the poses: scale, squareness, backlash, tilt, and residuals of the nodes."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.estimate import StageFigure, StageReport
from faintfield.calib.geometry.observations import Node
from faintfield.calib.geometry.rig_geometry import RigGeometry

type Array = NDArray[np.float64]

_AXES = ("x", "y")
_LINES = ("rows", "columns")  # what lies along each axis

# A node farther than this from its place, in pitches, has the label of another one, or the stage lost steps.
_MAX_NODE_ERROR = 0.3
_REWEIGHTINGS = 50  # of the least absolute distances

# Largest relative error of a stage's scale, and the standard errors that it must exceed as well; beyond, it is the
# boards that differ from what is stated.
_MAX_SCALE_ERROR, _SCALE_SIGMAS = 0.005, 4.0

_DIFFERENCE = 1e-6  # step of the central differences, in mm or in units of the solution


def approach_directions(visits: Sequence[tuple[Node, int]]) -> dict[Node, tuple[float, float]]:
    """Return the direction in which each node was approached along x and y: ±1, averaged over sweeps.

    `visits` are node and sweep in the order of capture. An axis that does not move keeps the direction of its last
    move; before its first move it gets the direction of that move.
    """
    directions: dict[Node, list[Array]] = {}
    for sweep in dict.fromkeys(sweep for _, sweep in visits):
        path = [node for node, of_sweep in visits if of_sweep == sweep]
        moves = np.sign(np.diff(np.array(path, float)[:, ::-1], axis=0, prepend=0.0))
        moves[0] = 0.0
        for along in moves.T:
            moving = np.flatnonzero(along)
            if moving.size:
                last = np.searchsorted(moving, np.arange(len(along)), side="right") - 1
                along[:] = along[moving[np.maximum(last, 0)]]
        for node, direction in zip(path, moves, strict=True):
            directions.setdefault(node, []).append(direction)
    return {node: tuple(np.mean(of_node, axis=0).tolist()) for node, of_node in directions.items()}


def stage_report(
    geometry: RigGeometry, directions: dict[Node, tuple[float, float]], pitch_mm: float | None
) -> StageReport:
    """Fit a regular grid with backlash to the camera centres.

    The centre of node (row, column) is `c = o + column·a + row·b − (dₓ/2)·βₓ·â − (d_y/2)·β_y·b̂ + residual`, with d the
    direction of approach and β the backlash. Standard errors include both the covariance of the measured centres and
    the scatter of the nodes about the grid.

    Parameters
    ----------
    geometry : RigGeometry
        Measured lens and poses.
    directions : dict of node to (float, float)
        Result of `approach_directions`; empty if the stage approaches from one side, which hides the backlash.
    pitch_mm : float, optional
        Commanded distance between neighbouring nodes.
    """
    design, backlash_terms = _design(geometry, directions)
    if np.linalg.matrix_rank(design[:, :3]) < 3:
        none = StageFigure(None, None, "the nodes lie on one line; take at least 2 x 2")
        return StageReport(none, none, none, none, none, none, none, none, none, [], [])
    grid = _Grid(design, geometry)
    pitches = [_pitch(grid, axis) for axis in (0, 1)]
    scales = [_scale(pitch, pitch_mm) for pitch in pitches]
    backlashes = [_backlash(grid, axis, backlash_terms[axis]) for axis in (0, 1)]
    return StageReport(
        pitch_x_mm=pitches[0],
        pitch_y_mm=pitches[1],
        scale_x=scales[0],
        scale_y=scales[1],
        squareness_rad=grid.estimate(_squareness_rad),
        backlash_x_mm=backlashes[0],
        backlash_y_mm=backlashes[1],
        tilt_rad=grid.estimate(_tilt_rad),
        node_residual_rms_mm=grid.residual_rms_mm(),
        residuals_mm=[(x, y, z) for x, y, z in (grid.residuals @ _grid_axes(grid.solution).T).tolist()],
        warnings=_misplaced_nodes(geometry) or _scale_warnings(scales),
    )


def _scale_warnings(scales: Sequence[StageFigure]) -> list[str]:
    """Return a warning for each axis along which the scale error is too large for a stage."""
    warnings = []
    for axis, scale in zip(_AXES, scales, strict=True):
        error = (scale.value or 1.0) - 1
        if abs(error) > max(_MAX_SCALE_ERROR, _SCALE_SIGMAS * (scale.sigma or 0.0)):
            warnings.append(
                f"along {axis} the nodes lie {abs(error):.1%} {'farther apart' if error > 0 else 'closer together'} "
                "than pitch_mm says: measure square_mm on the print (all depths and distances follow it), then check "
                "the stage's steps per mm"
            )
    return warnings


def _misplaced_nodes(geometry: RigGeometry) -> list[str]:
    """Return a warning for each node far from its place in the regular grid of least absolute distances."""
    nodes, centres_mm = geometry.nodes, geometry.centres_mm()
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
    warnings = []
    for index in np.flatnonzero(distances > _MAX_NODE_ERROR * pitch_mm).tolist():
        away = np.linalg.norm(places - centres_mm[index], axis=1)
        there = int(np.argmin(away))
        known = there != index and away[there] < _MAX_NODE_ERROR * pitch_mm
        where = f", where node {nodes[there]} belongs" if known else ""
        warnings.append(
            f"node {nodes[index]} lies {distances[index]:.1f} mm from its place{where}: check the node of its images, "
            "and whether the stage lost steps"
        )
    return warnings


class _Grid:
    """The grid that fits the camera centres best: its terms (term, 3), their covariance, and residuals (node, 3)."""

    def __init__(self, design: Array, geometry: RigGeometry) -> None:
        centres = geometry.centres_mm()
        solver = np.linalg.pinv(design)
        self.solution = solver @ centres
        self.residuals = centres - design @ self.solution
        self._freedom = max(self.residuals.size - self.solution.size, 1)
        measured = geometry.centre_covariance_mm2()
        squares = float((self.residuals**2).sum())
        scatter = max(squares / self._freedom - float(np.trace(measured)) / len(measured), 0.0)
        spread = np.kron(solver, np.eye(3))
        self._covariance = spread @ (measured + scatter * np.eye(len(measured))) @ spread.T

    def estimate(self, figure: Callable[[Array], float]) -> StageFigure:
        """Return a function of the terms with the standard error that their covariance implies."""
        slopes = np.empty(self.solution.size)
        for index in range(self.solution.size):
            moved = self.solution.copy()
            moved.flat[index] += _DIFFERENCE
            ahead = figure(moved)
            moved.flat[index] -= 2 * _DIFFERENCE
            slopes[index] = (ahead - figure(moved)) / (2 * _DIFFERENCE)
        variance = float(slopes @ self._covariance @ slopes)
        return StageFigure(figure(self.solution), float(np.sqrt(max(variance, 0.0))))

    def residual_rms_mm(self) -> StageFigure:
        """Return the rms distance of the nodes from the grid."""
        rms_mm = float(np.sqrt(3 * (self.residuals**2).sum() / self._freedom))
        return StageFigure(rms_mm, float(rms_mm / np.sqrt(2 * self._freedom)))


def _design(geometry: RigGeometry, directions: dict[Node, tuple[float, float]]) -> tuple[Array, list[int | None]]:
    """Return the design (node, term) and, per axis, the index of its backlash term or None.

    The terms are 1, column, row, and −d/2 for each axis along which it is independent of the others.
    """
    nodes = np.array(geometry.nodes, float)
    row_0, column_0 = geometry.nodes[geometry.reference]
    terms = [np.ones(len(nodes)), nodes[:, 1] - column_0, nodes[:, 0] - row_0]
    backlash_terms: list[int | None] = []
    for axis in (0, 1):
        term = np.array([-directions.get(node, (0.0, 0.0))[axis] / 2 for node in geometry.nodes])
        design = np.column_stack([*terms, term])
        kept = np.linalg.matrix_rank(design, tol=0.5) == len(terms) + 1
        backlash_terms.append(len(terms) if kept else None)
        terms = [*terms, term] if kept else terms
    return np.column_stack(terms), backlash_terms


def _pitch(grid: _Grid, axis: int) -> StageFigure:
    return grid.estimate(lambda s: float(np.linalg.norm(s[1 + axis])))


def _backlash(grid: _Grid, axis: int, term: int | None) -> StageFigure:
    if term is None:
        return StageFigure(
            None,
            None,
            f"nothing tells it along {_AXES[axis]}: nodes were approached from one side, or the side goes with the "
            f"place; capture three {_LINES[axis]} or more in alternation, with approach_mm = 0",
        )
    return grid.estimate(lambda s: float(s[term] @ s[1 + axis] / np.linalg.norm(s[1 + axis])))


def _scale(pitch: StageFigure, pitch_mm: float | None) -> StageFigure:
    if pitch_mm is None or pitch.value is None or pitch.sigma is None:
        return StageFigure(None, None, "what the stage was told is not known; give pitch_mm")
    return StageFigure(pitch.value / pitch_mm, pitch.sigma / pitch_mm)


def _squareness_rad(solution: Array) -> float:
    a, b = solution[1], solution[2]
    return float(np.arccos(a @ b / (np.linalg.norm(a) * np.linalg.norm(b))) - np.pi / 2)


def _tilt_rad(solution: Array) -> float:
    x, y, z = _grid_axes(solution)[2]
    return float(np.arctan2(np.hypot(x, y), abs(z)))  # rows counted upwards reverse the normal


def _grid_axes(solution: Array) -> Array:
    """Return unit vectors as rows: the grid's x, the y orthogonal to it, and the normal."""
    x = solution[1] / np.linalg.norm(solution[1])
    normal = np.cross(solution[1], solution[2])
    normal /= np.linalg.norm(normal)
    return np.stack([x, np.cross(normal, x), normal])
