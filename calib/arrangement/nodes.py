"""Nodes of a grid: their orientation, their neighbours, and a few of many."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

type Node = tuple[int, int]


@dataclass(frozen=True)
class Orientation:
    """Map from the two numbers of a name to row and column: swapped first, then reversed."""

    transpose: bool = False
    flip_rows: bool = False
    flip_columns: bool = False

    @property
    def opposed(self) -> bool:
        """One of rows and columns is reversed."""
        return self.flip_rows != self.flip_columns

    def turned(self) -> "Orientation":
        """Return the orientation turned by 180°."""
        return Orientation(self.transpose, not self.flip_rows, not self.flip_columns)

    def apply(self, nodes: Sequence[Node]) -> list[Node]:
        """Return row and column of each node, counted from zero."""
        numbers = np.array(nodes)[:, ::-1] if self.transpose else np.array(nodes)
        numbers = numbers - numbers.min(axis=0)
        flips = np.array([self.flip_rows, self.flip_columns])
        numbers = np.where(flips, numbers.max(axis=0) - numbers, numbers)
        return [(int(row), int(column)) for row, column in numbers]


def neighbour(node: Node, number: int, steps: int) -> Node:
    """Return the node some steps further along one of its numbers."""
    return (node[0] + steps, node[1]) if number == 0 else (node[0], node[1] + steps)


def neighbour_counts(nodes: Sequence[Node], distance: int) -> NDArray[np.intp]:
    """Return how many neighbours (node, number) each node has at a distance along either number: 0, 1 or 2."""
    present = set(nodes)
    return np.array(
        [[sum(neighbour(node, n, sign * distance) in present for sign in (-1, 1)) for n in (0, 1)] for node in nodes]
    )


def central_nodes(nodes: Sequence[Node], count: int, distance: int, *, fill: bool = True) -> list[Node]:
    """Return at most `count` nodes between most pairs of neighbours, evenly spread, filled up with others."""
    counts = neighbour_counts(nodes, distance)
    ranks = 10 * (counts == 2).sum(axis=1) + counts.sum(axis=1)
    chosen: list[Node] = []
    for rank in np.unique(ranks)[::-1] if fill else [ranks.max()]:
        alike = [node for node, own in zip(nodes, ranks, strict=True) if own == rank]
        chosen += spread(alike, count - len(chosen))
    return chosen


def spread(nodes: Sequence[Node], count: int) -> list[Node]:
    """Return at most `count` nodes, spread evenly over the list."""
    if count < 1:
        return []
    chosen = np.unique(np.linspace(0, len(nodes) - 1, min(count, len(nodes))).round().astype(int))
    return [nodes[index] for index in chosen]
