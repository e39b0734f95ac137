"""What the bundle adjustment is given: corners of boards, by node and sweep."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.errors import TooFewViews

type Node = tuple[int, int]

# A view of a board with fewer corners tells less than its six unknowns cost.
_FEWEST_CORNERS = 6


@dataclass(frozen=True)
class Target:
    """One standing of one board: it does not move within a sweep."""

    board: str
    sweep: int


@dataclass(frozen=True)
class BoardObservation:
    """The corners of one board seen in one view.

    Parameters
    ----------
    node : (int, int)
        Row and column of the grid.
    target : Target
        Board and sweep.
    corners : int array (corner,)
        Their numbers on the board.
    pixels : float array (corner, 2)
        Where they were seen: column, row.
    sigma_px : float array (corner,)
        How far off each may be, per axis; only their ratios count, the level comes from the residuals.
    """

    node: Node
    target: Target
    corners: NDArray[np.intp]
    pixels: NDArray[np.float64]
    sigma_px: NDArray[np.float64]


@dataclass(frozen=True)
class Observations:
    """All corners in the order that the solver wants: by target, then by node, the reference node first.

    Attributes
    ----------
    nodes : list of (int, int)
        The nodes that are connected to the reference, which is the first.
    targets : list of Target
        Boards as they stood.
    node_of, target_of : int array (view,)
        Indices into the two.
    pixels : float array (view, row, column, 2)
        Corners on the largest board's lattice; zero where none was seen.
    weights : float array (view, row, column)
        The median σ over the corner's own, −1 where none was seen.
    """

    nodes: list[Node]
    targets: list[Target]
    node_of: NDArray[np.int32]
    target_of: NDArray[np.int32]
    pixels: NDArray[np.float64]
    weights: NDArray[np.float64]

    @property
    def corner_count(self) -> int:
        """How many corners were seen."""
        return int((self.weights > 0).sum())

    def view_name(self, view: int) -> str:
        """Return words for one of the views."""
        target = self.targets[self.target_of[view]]
        sweep = f", sweep {target.sweep}" if len({one.sweep for one in self.targets}) > 1 else ""
        return f"node {self.nodes[self.node_of[view]]}, board '{target.board}'{sweep}"


def gather(
    observations: Sequence[BoardObservation], corner_shapes: dict[str, tuple[int, int]], reference: Node
) -> Observations:
    """Sort observations for the solver; nodes that share no board with the rest are left out.

    Parameters
    ----------
    observations : sequence of BoardObservation
        In any order.
    corner_shapes : dict of board name to (int, int)
        Rows and columns of each board's inner corners.
    reference : (int, int)
        The centre node, whose camera is the reference frame.

    Raises
    ------
    TooFewViews
        The reference node saw no board.
    ValueError
        A corner is none of its board.
    """
    useful = [seen for seen in observations if len(seen.corners) >= _FEWEST_CORNERS and _spread(seen, corner_shapes)]
    nodes = _connected_nodes(useful, reference)
    if not nodes:
        raise TooFewViews(
            f"node {reference}, whose camera is the reference, shows no board with {_FEWEST_CORNERS} corners or more; "
            "take it again with a board in view"
        )
    kept = [seen for seen in useful if seen.node in nodes]
    targets = sorted({seen.target for seen in kept}, key=lambda target: (target.sweep, target.board))
    kept.sort(key=lambda seen: (targets.index(seen.target), nodes.index(seen.node)))
    shape = tuple(max(corner_shapes[target.board][axis] for target in targets) for axis in (0, 1))
    pixels, weights = np.zeros((len(kept), *shape, 2)), np.full((len(kept), *shape), -1.0)
    typical_px = float(np.median(np.concatenate([seen.sigma_px for seen in kept])))
    for view, seen in enumerate(kept):
        row, column = np.divmod(seen.corners, corner_shapes[seen.target.board][1])
        if row.max() >= corner_shapes[seen.target.board][0]:
            raise ValueError(
                f"board '{seen.target.board}' has no corner {seen.corners.max()}; give the board as printed"
            )
        pixels[view, row, column] = seen.pixels
        weights[view, row, column] = typical_px / seen.sigma_px
    node_of = np.array([nodes.index(seen.node) for seen in kept], np.int32)
    target_of = np.array([targets.index(seen.target) for seen in kept], np.int32)
    return Observations(nodes, targets, node_of, target_of, pixels, weights)


def _spread(seen: BoardObservation, corner_shapes: dict[str, tuple[int, int]]) -> bool:
    """Return whether the corners fix a plane's pose: at least two rows and two columns of them."""
    row, column = np.divmod(seen.corners, corner_shapes[seen.target.board][1])
    return len(set(row.tolist())) > 1 and len(set(column.tolist())) > 1


def _connected_nodes(observations: Sequence[BoardObservation], reference: Node) -> list[Node]:
    """Return the nodes reached from the reference through boards seen from both, the reference first."""
    nodes_of: dict[Target, set[Node]] = {}
    for seen in observations:
        nodes_of.setdefault(seen.target, set()).add(seen.node)
    reached = {reference} if any(reference in nodes for nodes in nodes_of.values()) else set()
    waiting = list(reached)
    while waiting:
        node = waiting.pop()
        for neighbours in nodes_of.values():
            if node in neighbours:
                waiting.extend(neighbours - reached)
                reached |= neighbours
    others = sorted(reached - {reference})
    return [reference, *others] if reached else []
