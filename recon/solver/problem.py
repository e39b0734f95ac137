"""The reconstruction of a scene as solvers need it: images, and the operator that explains them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator, ViewSelection
from faintfield.recon.solver.data_fit import DataFit
from faintfield.recon.solver.initialization import (
    mean_light_e,
    smooth_start,
    universal_penalty_weight,
    well_seen_samples,
)
from faintfield.recon.solver.proximal import DualField


@dataclass(frozen=True)
class SceneProblem:
    """One plane, or several planes together; the unknowns are the operator's samples."""

    operator: SceneOperator
    images: ElementalImages

    @property
    def views(self) -> NDArray[np.intp]:
        """The views that see anything."""
        return self.operator.seeing_views

    def start(self, views: ViewSelection = None) -> Image:
        """Return `recon.solver.initialization.smooth_start`."""
        return smooth_start(self.operator, self.images, views)

    def level_e(self, start: Image) -> float:
        """Return `recon.solver.initialization.mean_light_e`."""
        return mean_light_e(self.operator, start)

    def well_seen(self) -> NDArray[np.bool_]:
        """Return which samples represent the planes, each plane judged by its own best seen sample."""
        seen = [well_seen_samples(plane).ravel() for plane in self.operator.planes_of(self.operator.sensitivity())]
        return np.concatenate(seen).reshape(self.operator.samples_shape)

    def fit(self, level_e: float, views: ViewSelection = None) -> DataFit:
        """Return L of some views."""
        return DataFit(self.operator, self.images, level_e, views)

    def value(self, samples: Image, views: ViewSelection = None) -> float:
        """Return the value of L of some views alone."""
        return self.operator.negative_log_likelihood(samples, self.images, views)

    def dual(self) -> DualField:
        """Return a dual field of zeros."""
        return DualField.zero([grid.shape for grid in self.operator.grids], self.operator.dtype)

    def usual_weight(self, start: Image) -> float:
        """Return `recon.solver.initialization.universal_penalty_weight`."""
        return universal_penalty_weight(self.operator, self.images, start)

    def metrics(self, level_e: float, optimum: Image) -> list[Image]:
        """Return the metric (row, column) of each plane if the others are known."""
        return self.fit(level_e).metric_of_each(optimum)

    def planes_of(self, samples: Image) -> list[Image]:
        """Return each plane (row, column)."""
        return self.operator.planes_of(samples)
