"""The penalty's dual fields of several planes, which lie one after the other: each plane is penalised by itself."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from faintfield.recon.likelihood.images import Image
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.proximal import DualField, Nearest


@dataclass
class SceneDual:
    """A dual field per plane; all that `recon.solver.proximal.DualField` says of one plane holds for all samples (sample,).

    Attributes
    ----------
    fields : list of DualField
        In the order of the planes.
    """

    fields: list[DualField]

    @classmethod
    def zero(cls, shapes: Sequence[tuple[int, int]], dtype: np.dtype[np.floating]) -> "SceneDual":
        """Return the fields of constant planes."""
        return cls([DualField.zero(shape, dtype) for shape in shapes])

    def copy(self) -> "SceneDual":
        """Return a copy that can be changed without changing this one."""
        return SceneDual([field.copy() for field in self.fields])

    def plane(self, centre: Image, reach: Image) -> Image:
        """Return `v − β/w ∇ᵀp` (sample,), not clipped at zero."""
        return np.concatenate([field.plane(*parts).ravel() for field, _, parts in self._parts(centre, reach)])

    def penalty_and_slack(self, plane: Image, penalty: Penalty) -> tuple[float, float]:
        """Return the sums over the planes of what one has."""
        sums = [field.penalty_and_slack(part, penalty) for field, _, (part,) in self._parts(plane)]
        return sum(part[0] for part in sums), sum(part[1] for part in sums)

    def nearest(
        self, centre: Image, metric: Image, weight: float, penalty: Penalty, enough: Callable[[Image], float], most: int
    ) -> Nearest:
        """Solve each plane's problem, to an equal part of the gap that is enough for all."""
        found = np.maximum(self.plane(centre, centre.dtype.type(weight) / metric), 0)
        gap, steps = 0.0, 0
        for field, where, (v, w) in self._parts(centre, metric):

            def enough_of_one(part: Image, where: slice = where) -> float:
                found[where] = part.ravel()
                return enough(found) / len(self.fields)

            nearest = field.nearest(v, w, weight, penalty, enough_of_one, most)
            found[where] = nearest.plane.ravel()
            gap, steps = gap + nearest.gap, max(steps, nearest.steps)
        return Nearest(found, gap, steps)

    def _parts(self, *samples: Image) -> Iterator[tuple[DualField, slice, list[Image]]]:
        """Yield each plane's field, where its samples are, and they (row, column) of each array."""
        first = 0
        for field in self.fields:
            shape = field.vectors.shape[1:]
            where = slice(first, first + shape[0] * shape[1])
            yield field, where, [array[where].reshape(shape) for array in samples]
            first = where.stop
