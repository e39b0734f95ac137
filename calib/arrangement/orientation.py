"""Orientation of a grid: the two numbers of a name become row and column."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import gcd

import numpy as np

from faintfield.calib.arrangement.pictures import Node


@dataclass(frozen=True)
class Orientation:
    """Map from the two numbers of a name to row and column: swapped first, then reversed."""

    transpose: bool = False
    flip_rows: bool = False
    flip_columns: bool = False

    def turned(self) -> "Orientation":
        """Return the orientation turned by 180°."""
        return Orientation(self.transpose, not self.flip_rows, not self.flip_columns)

    def of(self, nodes: Sequence[Node]) -> list[Node]:
        """Return row and column of each node, counted from zero."""
        numbers = np.array(nodes)[:, ::-1] if self.transpose else np.array(nodes)
        numbers = numbers - numbers.min(axis=0)
        last = numbers.max(axis=0)
        for axis, flip in enumerate((self.flip_rows, self.flip_columns)):
            if flip:
                numbers[:, axis] = last[axis] - numbers[:, axis]
        return [(int(row), int(column)) for row, column in numbers]


def counted(nodes: Sequence[Node]) -> list[Node]:
    """Return numbers counted from zero in their common steps: every second view is a grid of its own."""
    numbers = np.array(nodes, int)
    numbers = numbers - numbers.min(axis=0)
    steps = [gcd(*(int(number) for number in numbers[:, axis])) or 1 for axis in (0, 1)]
    return [(int(row), int(column)) for row, column in numbers // steps]
