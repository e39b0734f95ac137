"""A reconstruction as PMLEM is asked for it: of one plane, or of all planes of a scene together."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.plane import PlaneOperator
from faintfield.recon.operator.scene import SceneOperator
from faintfield.recon.solver.data_fit import DataFit
from faintfield.recon.solver.pmlem import Dual
from faintfield.recon.solver.proximal import DualField
from faintfield.recon.solver.scene_dual import SceneDual
from faintfield.recon.solver.scene_fit import SceneFit, scene_start
from faintfield.recon.solver.starts import smooth_start, universal_weight, well_seen_samples

type Views = Sequence[int] | NDArray[np.intp] | None


class Posed(Protocol):
    """Images, and the operator that explains them; unknown are samples of any shape."""

    @property
    def images(self) -> ElementalImages:
        """Return the elemental images."""

    @property
    def views(self) -> NDArray[np.intp]:
        """Return the views that see anything."""

    def start(self, views: Views = None) -> Image:
        """Return positive samples to start from."""

    def level_e(self, start: Image) -> float:
        """Return the mean light of what the views see."""

    def well_seen(self) -> NDArray[np.bool_]:
        """Return which samples count for the whole."""

    def fit(self, level_e: float, views: Views = None) -> DataFit | SceneFit:
        """Return L of some views."""

    def value(self, samples: Image, views: Views = None) -> float:
        """Return the value of L of some views alone."""

    def dual(self) -> Dual:
        """Return the dual field of nothing rough."""

    def usual_weight(self, start: Image) -> float:
        """Return a penalty weight from the noise alone."""

    def metrics(self, level_e: float, optimum: Image) -> list[Image]:
        """Return the curvature of L (row, column) along each plane alone."""

    def planes_of(self, samples: Image) -> list[Image]:
        """Return the planes (row, column)."""


@dataclass(frozen=True)
class PosedPlane:
    """One plane (row, column)."""

    operator: PlaneOperator
    images: ElementalImages

    @property
    def views(self) -> NDArray[np.intp]:
        """Return the views that see anything."""
        return self.operator.seeing_views

    def start(self, views: Views = None) -> Image:
        """Return `recon.solver.starts.smooth_start`."""
        return smooth_start(self.operator, self.images, views)

    def level_e(self, start: Image) -> float:
        """Return the mean over the samples that count."""
        return float(start[self.well_seen()].mean(dtype=np.float64))

    def well_seen(self) -> NDArray[np.bool_]:
        """Return which samples count (row, column)."""
        return well_seen_samples(self.operator.sensitivity())

    def fit(self, level_e: float, views: Views = None) -> DataFit:
        """Return L of some views."""
        return DataFit(self.operator, self.images, level_e, views)

    def value(self, samples: Image, views: Views = None) -> float:
        """Return the value of L of some views alone."""
        return self.operator.negative_log_likelihood(samples, self.images, views)

    def dual(self) -> DualField:
        """Return a field of zeros."""
        return DualField.zero(self.operator.grid.shape, self.operator.dtype)

    def usual_weight(self, start: Image) -> float:
        """Return `recon.solver.starts.universal_weight`."""
        return universal_weight(self.operator.sensitivity(), self.images, start)

    def metrics(self, level_e: float, optimum: Image) -> list[Image]:
        """Return the one metric."""
        return [self.fit(level_e).metric(optimum)]

    def planes_of(self, samples: Image) -> list[Image]:
        """Return the one plane."""
        return [samples]


@dataclass(frozen=True)
class PosedScene:
    """All planes of a scene, one after the other (sample,)."""

    operator: SceneOperator
    images: ElementalImages

    @property
    def views(self) -> NDArray[np.intp]:
        """Return the views that see anything."""
        return self.operator.seeing_views

    def start(self, views: Views = None) -> Image:
        """Return `recon.solver.scene_fit.scene_start`."""
        return scene_start(self.operator, self.images, views)

    def level_e(self, start: Image) -> float:
        """Return the mean light of a pixel: the planes' means add up."""
        planes, seen = self.operator.planes_of(start), self.operator.planes_of(self.well_seen())
        return sum(float(plane[where].mean(dtype=np.float64)) for plane, where in zip(planes, seen, strict=True))

    def well_seen(self) -> NDArray[np.bool_]:
        """Return which samples count (sample,), each plane by its own best."""
        return np.concatenate([well_seen_samples(one).ravel() for one in self.operator.sensitivity()])

    def fit(self, level_e: float, views: Views = None) -> SceneFit:
        """Return L of some views."""
        return SceneFit(self.operator, self.images, level_e, views)

    def value(self, samples: Image, views: Views = None) -> float:
        """Return the value of L of some views alone."""
        return self.operator.negative_log_likelihood(self.planes_of(samples), self.images, views)

    def dual(self) -> SceneDual:
        """Return fields of zeros."""
        return SceneDual.zero([grid.shape for grid in self.operator.grids], self.operator.dtype)

    def usual_weight(self, start: Image) -> float:
        """Return `recon.solver.starts.universal_weight` of all samples, under the light of all planes."""
        everywhere = np.full_like(start, self.level_e(start))
        return universal_weight(self.operator.samples_of(self.operator.sensitivity()), self.images, everywhere)

    def metrics(self, level_e: float, optimum: Image) -> list[Image]:
        """Return each plane's metric were the others known."""
        return self.fit(level_e).metric_of_each(optimum)

    def planes_of(self, samples: Image) -> list[Image]:
        """Return each plane."""
        return self.operator.planes_of(samples)
