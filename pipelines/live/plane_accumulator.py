"""Planes of the frames so far: back-projections that each frame is added to at once, and PMLEM in the time left."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.live.planes_client import LiveFrame, PictureKind
from faintfield.pipelines.live.planes_scene import LiveScene
from faintfield.pipelines.reconstruction.channels import lattice_noise, view_electrons
from faintfield.pipelines.reconstruction.operators import OperatorFactory, plane_grid
from faintfield.pipelines.reconstruction.planes.penalised import MAX_PASSES, Objective
from faintfield.recon.depth.focus import FocusMeasure, RunningPlane, SeenByView, seen_by_view
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages, Image, binned
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.solver.penalty_weight import universal_penalty_weight
from faintfield.recon.solver.pmlem import pmlem
from faintfield.recon.solver.proximal import DualField

# PMLEM is left out where the images of all nodes take more memory.
MAX_STACK_BYTES = 2_000_000_000

# PMLEM of a plane stops this near to the optimum, relative to the plane: twice as far as that of `reconstruct`.
_TOLERANCE = 0.02

# PMLEM is not interrupted before it has made so many iterates: the first is its smooth start.
_MIN_ITERATES = 3

# A plane that was zero somewhere begins at this share of the smooth start there.
_MIN_START = 1e-3


class _Refined(NamedTuple):
    """PMLEM's plane with its dual field, the views that it is of, and whether it has reached the optimum."""

    plane: Image
    dual: DualField
    views: tuple[int, ...]
    done: bool


class ViewSums:
    """Sums of the frames of each node, one after another in memory, which solvers read as they are.

    Those of the `views` that have all of their frames come first; sums of the others follow, in the order of `_order`.
    There is one image per node, however many frames are missing, and `np.empty` takes its memory when it is used.
    """

    def __init__(self, shape: tuple[int, int], nodes: int, frames_per_view: int) -> None:
        self._electrons = np.empty((nodes, *shape), np.float32)
        self._valid = np.empty((nodes, *shape), bool)
        self._frames_per_view = frames_per_view
        self._order: list[int] = []
        self._counts: dict[int, int] = {}
        self._complete = 0

    @property
    def views(self) -> tuple[int, ...]:
        """Views that have all of their frames."""
        return tuple(self._order[: self._complete])

    def add(self, view: int, images: ElementalImages) -> None:
        """Add a frame to its node."""
        if view not in self._counts:
            place = len(self._order)
            self._order.append(view)
            self._counts[view], self._electrons[place], self._valid[place] = 0, 0, True
        place = self._order.index(view)
        self._counts[view] += 1
        self._electrons[place] += images.electrons[0]
        if images.valid is not None:
            self._valid[place] &= images.valid[0]
        if self._counts[view] == self._frames_per_view:
            self._swap(place, self._complete)
            self._complete += 1

    def drop(self, view: int) -> None:
        """Forget a node."""
        if self._counts.pop(view, None) is None:
            return
        place = self._order.index(view)
        if place < self._complete:
            self._complete -= 1
            self._swap(place, self._complete)
            place = self._complete
        self._swap(place, len(self._order) - 1)
        self._order.pop()

    def images(self, background_e: float | Image, read_variance_e2: float | Image) -> ElementalImages:
        """Return the images in the order of `views`, given what all of them share."""
        valid = self._valid[: self._complete]
        electrons = self._electrons[: self._complete]
        return ElementalImages(electrons, background_e, read_variance_e2, None if valid.all() else valid)

    def _swap(self, first: int, second: int) -> None:
        if first == second:
            return
        for values in (self._electrons, self._valid):
            values[[first, second]] = values[[second, first]]
        self._order[first], self._order[second] = self._order[second], self._order[first]


class _Frame(NamedTuple):
    """A frame that was read: its view, its pixels and bins in electrons, and its share of the exposure of a view."""

    view: int
    pixels: NDArray[np.float32]
    images: ElementalImages
    share: float


class PlaneAccumulator:
    """Planes of a scene at some depths, from frames in a folder; `frames` are those added, by number of exposure."""

    def __init__(self, scene: LiveScene, folder: Path, depths_mm: Sequence[float]) -> None:
        self.scene = scene
        self.frames: dict[int, LiveFrame] = {}
        self._folder, self._depths_mm = folder, depths_mm
        elemental_set = scene.elemental_set
        self._factory = OperatorFactory(elemental_set, scene.layout, None, bins=scene.bins)
        self._grids = [plane_grid(elemental_set, depth).binned(scene.bins) for depth in depths_mm]
        self._running = [RunningPlane(grid.shape) for grid in self._grids]
        self._latest: list[SeenByView | None] = [None] * len(depths_mm)
        self._refined: dict[int, _Refined] = {}
        self._noise = lattice_noise(elemental_set, scene.layout.lattices[0], None)
        width, height = elemental_set.settings.camera.size_px
        shape, nodes = (height // scene.bins, width // scene.bins), len(elemental_set.settings.view)
        self.stack_bytes = 4 * nodes * shape[0] * shape[1]
        keeps = scene.knows_noise and self.stack_bytes <= MAX_STACK_BYTES
        self._sums = ViewSums(shape, nodes, elemental_set.frames_per_view) if keeps else None

    @property
    def nodes(self) -> set[tuple[int, int]]:
        """Nodes of the frames that were added."""
        return {frame.node for frame in self.frames.values()}

    @property
    def complete(self) -> int:
        """Number of nodes that PMLEM can take."""
        return 0 if self._sums is None else len(self._sums.views)

    def add(self, frame: LiveFrame) -> NDArray[np.float32]:
        """Add a frame to all planes; return its pixels (row, column), in electrons.

        Raises
        ------
        InputError
            The file cannot be read, or does not fit the others.
        """
        read = self._read(frame)
        for index, running in enumerate(self._running):
            self._latest[index] = view = self._project(index, read)
            if view is not None:
                running.add(view, _half(frame))
        if self._sums is not None:
            self._sums.add(read.view, read.images)
        self.frames[frame.intent] = frame
        return read.pixels

    def remove(self, frame: LiveFrame) -> None:
        """Take a frame away that is not valid any more; raises as `add` does."""
        read = self._read(frame)
        del self.frames[frame.intent]
        for index, running in enumerate(self._running):
            if (view := self._project(index, read)) is not None:
                running.remove(view, _half(frame))
        if self._sums is not None:
            self._sums.drop(read.view)
            for same_node in [kept for kept in self.frames.values() if kept.node == frame.node]:
                self._sums.add(read.view, self._read(same_node).images)

    def picture(self, index: int, kind: PictureKind) -> tuple[Image, NDArray[np.bool_], int] | None:
        """Return a plane (row, column) in electrons per pixel, where it is covered, and from how many nodes."""
        per_px = np.float32(1 / self.scene.bins**2)
        running, latest, refined = self._running[index], self._latest[index], self._refined.get(index)
        if kind == "mean" and self.frames:
            return running.mean() * per_px, running.covered, len(self.nodes)
        if kind == "view" and latest is not None:
            return latest.mean() * per_px, latest.coverage > 0.1 * latest.coverage.max(), 1
        if kind == "pmlem" and refined is not None:
            return refined.plane * per_px, running.covered, len(refined.views)
        return None

    def focus(self, index: int) -> FocusMeasure:
        """Return the power of detail that the two halves of the views agree on, in electrons per pixel, squared."""
        measure, bins = self._running[index].focus(), self.scene.bins
        return FocusMeasure(measure.detail_e2 / bins**4, measure.sigma_e2 / bins**4)

    def is_refined(self, index: int) -> bool:
        """Return whether PMLEM has reached the optimum of the nodes that are complete."""
        if self._sums is None or not self._sums.views:
            return True
        refined = self._refined.get(index)
        return refined is not None and refined.done and refined.views == self._sums.views

    def refine(self, index: int, interrupted: Callable[[], bool]) -> None:
        """Run PMLEM on a plane, from where it was left, until its optimum is near or `interrupted`.

        The weight of the penalty follows from the noise, as in `universal_penalty_weight`; no views are held out.
        """
        assert self._sums is not None
        views = self._sums.views
        elemental_set, bins = self.scene.elemental_set, self.scene.bins
        images = self._sums.images(
            _binned_sum(elemental_set.background_e(self._noise), bins),
            _binned_sum(elemental_set.read_variance_e2(self._noise), bins),
        )
        operator = self._factory.at(self._depths_mm[index], self._grids[index], views, images.valid)
        objective = Objective.of(SceneProblem(operator, images), SolverOptions())
        weight = universal_penalty_weight(operator, objective.posed.images, objective.start)
        before = self._refined.get(index)
        start, dual = objective.start, objective.posed.dual()
        if before is not None:
            start, dual = np.maximum(before.plane, _MIN_START * start), before.dual
        fit = objective.posed.fit(objective.level_e)
        iterates = pmlem(fit, start, penalty_weight=weight, penalty=objective.penalty, tolerance=_TOLERANCE, dual=dual)
        for count, iterate in enumerate(iterates, 1):
            done = iterate.certificate.distance <= _TOLERANCE or count >= MAX_PASSES or iterate.passes >= MAX_PASSES
            if done or count >= _MIN_ITERATES:
                self._refined[index] = _Refined(iterate.plane, iterate.dual, views, done)
                if done or interrupted():
                    return

    def _project(self, index: int, read: _Frame) -> SeenByView | None:
        """Back-project a frame to a plane; None if its view does not see the plane."""
        depth_mm, grid = self._depths_mm[index], self._grids[index]
        try:
            operator = self._factory.at(depth_mm, grid, [read.view], read.images.valid)
        except GeometryMismatch:
            return None
        return seen_by_view(operator, read.images, read.share)

    def _read(self, frame: LiveFrame) -> _Frame:
        elemental_set = self.scene.elemental_set
        [(electrons, over)] = view_electrons(elemental_set, self.scene.layout, [self._folder / frame.file])
        background_e = self._noise.background_e(frame.exposure_s)
        images = ElementalImages(electrons[np.newaxis], background_e, valid=~over[np.newaxis] if over.any() else None)
        total_s = elemental_set.settings.exposure_s or frame.exposure_s
        view = self.scene.view_of[frame.node]
        return _Frame(view, electrons, images.binned(self.scene.bins), frame.exposure_s / total_s)


def _binned_sum(value: float | NDArray[np.floating], bins: int) -> float | Image:
    """Return a number per pixel, or a map of numbers, as sums over bins."""
    if np.ndim(value) == 0:
        return float(value) * bins**2
    return np.asarray(binned(np.asarray(value), bins) * bins**2, np.float32)


def _half(frame: LiveFrame) -> int:
    """Return the half of the views that a node belongs to: a colour of the checkerboard."""
    return sum(frame.node) % 2
