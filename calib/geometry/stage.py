"""What the poses say of the gantry: scale, squareness, backlash, tilt, and where each node really was."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.geometry.diagnostics import doubtful_scale, nodes_elsewhere
from faintfield.calib.geometry.observations import Node
from faintfield.calib.geometry.rig_geometry import RigGeometry

type Numbers = NDArray[np.float64]

_AXES = ("x", "y")
_LINES = ("rows", "columns")


@dataclass(frozen=True)
class Estimate:
    """A figure with its standard error, or why there is none."""

    value: float | None
    sigma: float | None = None
    why: str | None = None


@dataclass(frozen=True)
class StageReport:
    """What the owner of the stage may want to correct.

    Attributes
    ----------
    pitch_x_mm, pitch_y_mm : Estimate
        Distance of neighbouring nodes along a row and along a column.
    scale_x, scale_y : Estimate
        The same over what the stage was told.
    squareness_rad : Estimate
        Angle between the axes less a right angle.
    backlash_x_mm, backlash_y_mm : Estimate
        How much farther along the axis a node lies when it was approached in that axis's positive direction's
        opposite: the stage falls short by half of it either way.
    tilt_rad : Estimate
        Angle between the reference camera's axis and the normal of the grid.
    node_residual_rms_mm : Estimate
        Of the nodes from the regular grid that fits best, in three dimensions.
    residuals_mm : list of (float, float, float)
        The same per node, in the grid's x, y and normal.
    doubts : list of str
        Nodes that lie where others belong, and distances that no stage gets so wrong.
    """

    pitch_x_mm: Estimate
    pitch_y_mm: Estimate
    scale_x: Estimate
    scale_y: Estimate
    squareness_rad: Estimate
    backlash_x_mm: Estimate
    backlash_y_mm: Estimate
    tilt_rad: Estimate
    node_residual_rms_mm: Estimate
    residuals_mm: list[tuple[float, float, float]]
    doubts: list[str] = field(default_factory=list)


def approach_directions(visits: Sequence[tuple[Node, int]]) -> dict[Node, tuple[float, float]]:
    """Return from which side each node was approached along x and y, +1, −1 or between: the mean over sweeps.

    Parameters
    ----------
    visits : sequence of ((int, int), int)
        Node and sweep in the order of capture. An axis that does not move keeps the direction of its last move;
        before its first move it is taken to have come the way it then goes on.
    """
    directions: dict[Node, list[NDArray[np.float64]]] = {}
    for sweep in dict.fromkeys(sweep for _, sweep in visits):
        path = [node for node, of_sweep in visits if of_sweep == sweep]
        moves = np.sign(np.diff(np.array(path, float)[:, ::-1], axis=0, prepend=np.nan))
        for axis in (0, 1):
            _fill_forward(moves[:, axis])
        for node, direction in zip(path, moves, strict=True):
            directions.setdefault(node, []).append(direction)
    means = {node: np.mean(of_node, axis=0) for node, of_node in directions.items()}
    return {node: (float(mean[0]), float(mean[1])) for node, mean in means.items()}


def _fill_forward(moves: Numbers) -> None:
    """Replace standing still (0, or NaN at the start) by the last move, and by the first one before that."""
    moving = np.flatnonzero(np.nan_to_num(moves))
    if not moving.size:
        moves[:] = 0.0
        return
    last = np.maximum(np.searchsorted(moving, np.arange(len(moves)), side="right") - 1, 0)
    moves[:] = moves[moving[last]]


def stage_report(
    geometry: RigGeometry, directions: dict[Node, tuple[float, float]], pitch_mm: float | None
) -> StageReport:
    """Fit a regular grid with backlash to the camera centres.

    The centre of node (row, column) is `c = o + column·a + row·b − (dₓ/2)·βₓ·â − (d_y/2)·β_y·b̂ + residual`, with d the
    direction of approach and β the backlash. Standard errors carry both the covariance of the measured centres and the
    scatter of the nodes about the grid.

    Parameters
    ----------
    geometry : RigGeometry
        Measured.
    directions : dict of node to (float, float)
        From `approach_directions`; empty when the stage approaches from one side, so that its play cannot show.
    pitch_mm : float, optional
        What the stage was told.
    """
    design, told = _design(geometry, directions)
    if np.linalg.matrix_rank(design[:, :3]) < 3:
        return _nothing("the nodes lie on one line; take at least 2 x 2")
    centres = geometry.centres_mm()
    solver = np.linalg.pinv(design)
    solution = solver @ centres
    residuals = centres - design @ solution
    covariance = _solution_covariance(solver, residuals, geometry.centre_covariance_mm2(), design.shape)
    estimate = _Propagated(solution, covariance)
    pitch_x, pitch_y = (_pitch(estimate, axis) for axis in (0, 1))
    freedom = max(residuals.size - solution.size, 1)
    rms_mm = float(np.sqrt(3 * (residuals**2).sum() / freedom))
    scales = [_scale(pitch, pitch_mm) for pitch in (pitch_x, pitch_y)]
    return StageReport(
        pitch_x_mm=pitch_x,
        pitch_y_mm=pitch_y,
        scale_x=scales[0],
        scale_y=scales[1],
        squareness_rad=estimate(_squareness_rad),
        backlash_x_mm=_backlash(estimate, 0, told),
        backlash_y_mm=_backlash(estimate, 1, told),
        tilt_rad=estimate(_tilt_rad),
        node_residual_rms_mm=Estimate(rms_mm, float(rms_mm / np.sqrt(2 * freedom))),
        residuals_mm=[(x, y, z) for x, y, z in (residuals @ _grid_axes(solution).T).tolist()],
        doubts=nodes_elsewhere(geometry.nodes, centres) or _doubtful_scales(scales),
    )


def _doubtful_scales(scales: Sequence[Estimate]) -> list[str]:
    """Return a word on each axis along which the stage cannot be so wrong."""
    words = []
    for axis, scale in zip(_AXES, scales, strict=True):
        if scale.value is not None and scale.sigma is not None:
            words += doubtful_scale(axis, scale.value, scale.sigma)
    return words


class _Propagated:
    """Carries the covariance of the fitted grid to any figure of it."""

    def __init__(self, solution: Numbers, covariance: Numbers) -> None:
        self._solution = solution
        self._covariance = covariance

    def __call__(self, figure: Callable[[Numbers], float]) -> Estimate:
        step = 1e-6
        slopes = np.empty(self._solution.size)
        for index in range(self._solution.size):
            moved = self._solution.ravel().copy()
            moved[index] += step
            ahead = figure(moved.reshape(self._solution.shape))
            moved[index] -= 2 * step
            slopes[index] = (ahead - figure(moved.reshape(self._solution.shape))) / (2 * step)
        variance = float(slopes @ self._covariance @ slopes)
        return Estimate(figure(self._solution), float(np.sqrt(max(variance, 0.0))))


def _design(geometry: RigGeometry, directions: dict[Node, tuple[float, float]]) -> tuple[Numbers, list[int | None]]:
    """Return the design (node, term): 1, column, row, −d/2 per axis where it can be told, and where those terms are."""
    nodes = np.array(geometry.nodes, float)
    row_0, column_0 = geometry.nodes[geometry.reference]
    terms = [np.ones(len(nodes)), nodes[:, 1] - column_0, nodes[:, 0] - row_0]
    told: list[int | None] = []
    for axis in (0, 1):
        term = np.array([-directions.get(node, (0.0, 0.0))[axis] / 2 for node in geometry.nodes])
        design = np.column_stack([*terms, term])
        kept = np.linalg.matrix_rank(design, tol=0.5) == len(terms) + 1
        told.append(len(terms) if kept else None)
        terms = [*terms, term] if kept else terms
    return np.column_stack(terms), told


def _solution_covariance(solver: Numbers, residuals: Numbers, measured: Numbers, shape: tuple[int, ...]) -> Numbers:
    """Return the covariance of the fitted terms (3·term, 3·term): of measurement, and of the nodes' scatter."""
    freedom = max(3 * (shape[0] - shape[1]), 1)
    scatter = max(float((residuals**2).sum()) / freedom - float(np.trace(measured)) / len(measured), 0.0)
    spread = np.kron(solver, np.eye(3))
    return np.asarray(spread @ (measured + scatter * np.eye(len(measured))) @ spread.T)


def _pitch(estimate: _Propagated, axis: int) -> Estimate:
    return estimate(lambda s: float(np.linalg.norm(s[1 + axis])))


def _backlash(estimate: _Propagated, axis: int, told: list[int | None]) -> Estimate:
    term = told[axis]
    if term is None:
        return Estimate(
            None,
            None,
            f"nothing tells it along {_AXES[axis]}: nodes were approached from one side, or the side goes with the "
            f"place; capture three {_LINES[axis]} or more in alternation, with approach_mm = 0",
        )
    return estimate(lambda s: float(s[term] @ s[1 + axis] / np.linalg.norm(s[1 + axis])))


def _scale(pitch: Estimate, pitch_mm: float | None) -> Estimate:
    if pitch_mm is None or pitch.value is None or pitch.sigma is None:
        return Estimate(None, None, "what the stage was told is not known; give pitch_mm")
    return Estimate(pitch.value / pitch_mm, pitch.sigma / pitch_mm)


def _squareness_rad(solution: Numbers) -> float:
    a, b = solution[1], solution[2]
    return float(np.arccos(a @ b / (np.linalg.norm(a) * np.linalg.norm(b))) - np.pi / 2)


def _tilt_rad(solution: Numbers) -> float:
    x, y, z = _grid_axes(solution)[2]
    return float(np.arctan2(np.hypot(x, y), abs(z)))  # rows counted upwards turn the normal round


def _grid_axes(solution: Numbers) -> Numbers:
    """Return the grid's x, its y at a right angle, and its normal, as rows."""
    x = solution[1] / np.linalg.norm(solution[1])
    normal = np.cross(solution[1], solution[2])
    normal /= np.linalg.norm(normal)
    return np.stack([x, np.cross(normal, x), normal])


def _nothing(why: str) -> StageReport:
    none = Estimate(None, None, why)
    return StageReport(none, none, none, none, none, none, none, none, none, [])
