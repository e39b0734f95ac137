"""Input of the bundle adjustment: corners of boards, by node and sweep."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.errors import TooFewViews

type Node = tuple[int, int]

# Corners of a view below which it is left out: fewer add less than the six unknowns of a pose take.
_MIN_CORNERS = 6


@dataclass(frozen=True)
class Target:
    """One board in one sweep of the camera over the grid, during which the board does not move.

    Parameters
    ----------
    board : str
        Name of the board.
    sweep : int
        Number of the sweep.
    homing : int
        Number of the stage's homing that the node's position relies on.

    Examples
    --------
    A board that is moved between two sweeps makes two targets, each with a pose of its own:

    >>> from faintfield import Target
    >>> before, after = Target("wall", sweep=0), Target("wall", sweep=1)
    >>> before == after
    False
    >>> after
    Target(board='wall', sweep=1, homing=0)
    """

    board: str
    sweep: int
    homing: int = 0


@dataclass(frozen=True)
class BoardObservation:
    """The corners of one board seen in one view.

    Parameters
    ----------
    node : (int, int)
        Row and column of the camera's node in the grid.
    target : Target
        Board and sweep.
    corners : int array (corner,)
        Numbers of the corners on the board.
    pixels : float array (corner, 2)
        Column and row of each corner in the image.
    sigma_px : float array (corner,)
        Standard deviation of each corner per axis. Only ratios count; the level follows from the residuals.

    Examples
    --------
    >>> from faintfield import Board, BoardObservation, Target, detect_all
    >>> board = Board("wall", columns=9, rows=7, square_mm=30.0, marker_mm=22.0)
    >>> image = board.opencv_board().generateImage((450, 350))
    >>> ((corners,),) = detect_all([image], [board])
    >>> target = Target("wall", sweep=0)
    >>> observation = BoardObservation((0, 1), target, corners.corners, corners.pixels, corners.sigma_px)
    >>> observation.pixels.shape
    (48, 2)
    >>> observation.pixels[:2].round(1)
    array([[49.5, 49.5],
           [99.5, 49.5]])
    """

    node: Node
    target: Target
    corners: NDArray[np.intp]
    pixels: NDArray[np.float64]
    sigma_px: NDArray[np.float64]


@dataclass(frozen=True)
class Observations:
    """All corners in the order that mrcal requires: by target, then by node, the reference node first.

    Attributes
    ----------
    nodes, targets : list of (int, int), list of Target
        The nodes that boards connect to the reference, which is the first; the boards in each sweep.
    node_of, target_of : int array (view,)
        Indices into `nodes` and `targets`.
    pixels, weights : float array (view, row, column, 2), (view, row, column)
        Corners on the lattice of the largest board, and the median σ over that of the corner; 0 and −1 where none was
        seen.
    """

    nodes: list[Node]
    targets: list[Target]
    node_of: NDArray[np.int32]
    target_of: NDArray[np.int32]
    pixels: NDArray[np.float64]
    weights: NDArray[np.float64]

    @property
    def corner_count(self) -> int:
        """Number of corners that were seen."""
        return int((self.weights > 0).sum())

    def view_name(self, view: int) -> str:
        """Return the name of a view in messages."""
        target = self.targets[self.target_of[view]]
        sweep = f", sweep {target.sweep}" if len({node.sweep for node in self.targets}) > 1 else ""
        return f"node {self.nodes[self.node_of[view]]}, board '{target.board}'{sweep}"


def gather(
    observations: Sequence[BoardObservation], corner_shapes: dict[str, tuple[int, int]], reference: Node
) -> Observations:
    """Sort observations for the solver, and leave out nodes that share no board with the rest.

    `corner_shapes` has rows and columns of each board's inner corners; the camera of node `reference` is the frame.

    Raises
    ------
    TooFewViews
        The reference node saw no board.
    ValueError
        A corner does not exist on its board.
    """
    useful = [observation for observation in observations if determines_pose(observation, corner_shapes)]
    nodes = _connected_nodes(useful, reference)
    if not nodes:
        raise TooFewViews(
            f"node {reference}, whose camera is the reference, shows no board with {_MIN_CORNERS} corners or more; "
            "take it again with a board in view"
        )
    kept = [observation for observation in useful if observation.node in nodes]
    targets = sorted(
        {observation.target for observation in kept}, key=lambda target: (target.sweep, target.homing, target.board)
    )
    kept.sort(key=lambda observation: (targets.index(observation.target), nodes.index(observation.node)))
    node_of = np.array([nodes.index(observation.node) for observation in kept], np.int32)
    target_of = np.array([targets.index(observation.target) for observation in kept], np.int32)
    return Observations(nodes, targets, node_of, target_of, *_lattices(kept, corner_shapes))


def as_one_homing(observations: Sequence[BoardObservation]) -> list[BoardObservation]:
    """Return the observations as if no homing had interrupted a sweep."""
    return [replace(observation, target=replace(observation.target, homing=0)) for observation in observations]


def interrupted_sweeps(observations: Sequence[BoardObservation]) -> list[int]:
    """Return the sweeps within which the stage homed."""
    homings: dict[int, set[int]] = {}
    for observation in observations:
        homings.setdefault(observation.target.sweep, set()).add(observation.target.homing)
    return sorted(sweep for sweep, of_sweep in homings.items() if len(of_sweep) > 1)


def _lattices(
    views: Sequence[BoardObservation], corner_shapes: dict[str, tuple[int, int]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return `pixels` and `weights` of the views' corners, see `Observations`."""
    shape = np.max([corner_shapes[observation.target.board] for observation in views], axis=0)
    pixels, weights = np.zeros((len(views), *shape, 2)), np.full((len(views), *shape), -1.0)
    typical_px = float(np.median(np.concatenate([observation.sigma_px for observation in views])))
    for view, observation in enumerate(views):
        rows, columns = corner_shapes[observation.target.board]
        row, column = np.divmod(observation.corners, columns)
        if row.max() >= rows:
            board, corner = observation.target.board, observation.corners.max()
            raise ValueError(f"board '{board}' has no corner {corner}; give the board as printed")
        pixels[view, row, column] = observation.pixels
        weights[view, row, column] = typical_px / observation.sigma_px
    return pixels, weights


def determines_pose(observation: BoardObservation, corner_shapes: dict[str, tuple[int, int]]) -> bool:
    """Return whether corners are enough, and on two rows and two columns at least: they then determine the pose."""
    row, column = np.divmod(observation.corners, corner_shapes[observation.target.board][1])
    return len(observation.corners) >= _MIN_CORNERS and len(np.unique(row)) > 1 and len(np.unique(column)) > 1


def _connected_nodes(observations: Sequence[BoardObservation], reference: Node) -> list[Node]:
    """Return the nodes that chains of common boards connect to the reference, the reference first."""
    nodes_of: dict[Target, set[Node]] = {}
    for observation in observations:
        nodes_of.setdefault(observation.target, set()).add(observation.node)
    reached = {reference} if any(reference in nodes for nodes in nodes_of.values()) else set()
    waiting = list(reached)
    while waiting:
        node = waiting.pop()
        for neighbours in nodes_of.values():
            if node in neighbours:
                waiting.extend(neighbours - reached)
                reached |= neighbours
    return [reference, *sorted(reached - {reference})] if reached else []
