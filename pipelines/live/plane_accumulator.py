"""Planes of the frames so far: back-projections that each frame is added to at once, and PMLEM in the time left."""

from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.live.planes_client import LiveFrame, PictureKind
from faintfield.pipelines.live.planes_scene import LiveScene
from faintfield.pipelines.live.view_sums import RoundSums
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


class _Refined(NamedTuple):
    """PMLEM's plane in electrons of one round, its dual field, its views and rounds, and whether it is the optimum."""

    plane: Image
    dual: DualField
    views: tuple[int, ...]
    rounds: int
    done: bool


class Picture(NamedTuple):
    """A plane (row, column) in electrons of one round per pixel, where it is covered, and its nodes and rounds."""

    plane: Image
    covered: NDArray[np.bool_]
    nodes: int
    rounds: int


class _Frame(NamedTuple):
    """A frame that was read: its view, its pixels and bins in electrons, and its share of the exposure of a round."""

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
        frames = [len(exposures_s) for exposures_s in scene.rounds_s]
        self.stack_bytes = 4 * nodes * shape[0] * shape[1] * min(len(frames), 2)
        keeps = scene.knows_noise and self.stack_bytes <= MAX_STACK_BYTES
        self._sums = RoundSums(shape, nodes, frames) if keeps else None

    @property
    def nodes(self) -> set[tuple[int, int]]:
        """Nodes of the frames that were added."""
        return {frame.node for frame in self.frames.values()}

    @property
    def complete(self) -> int:
        """Number of nodes that PMLEM can take."""
        return 0 if self._sums is None else len(self._sums.shared.views)

    @property
    def rounds(self) -> int:
        """Number of rounds that PMLEM takes of these nodes."""
        return 1 if self._sums is None else self._sums.rounds

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
            self._sums.add(read.view, frame.round, read.images)
        self.frames[frame.intent] = frame
        return read.pixels

    def remove(self, frames: Sequence[LiveFrame]) -> None:
        """Take frames of one node away that are not valid any more; raises as `add` does."""
        for frame in frames:
            del self.frames[frame.intent]
        if self._sums is not None:
            self._remove_from_sums(self._sums, frames)
        for frame in frames:
            read = self._read(frame)
            for index, running in enumerate(self._running):
                if (view := self._project(index, read)) is not None:
                    running.remove(view, _half(frame))

    def _remove_from_sums(self, sums: RoundSums, frames: Sequence[LiveFrame]) -> None:
        view, parts = self.scene.view_of[frames[0].node], [sums.holds(frame.round) for frame in frames]
        same_node = [kept for kept in self.frames.values() if kept.node == frames[0].node]
        rest = [kept for kept in same_node if sums.holds(kept.round) in parts]
        for frame in frames:
            sums.drop(view, frame.round)
        for kept in rest:
            sums.add(view, kept.round, self._read(kept).images)
        # Its views may be the same when PMLEM runs again, of other frames
        self._refined = {index: refined._replace(done=False) for index, refined in self._refined.items()}

    def picture(self, index: int, kind: PictureKind) -> Picture | None:
        """Return a picture of a plane, None if there is none yet."""
        per_px = np.float32(1 / self.scene.bins**2)
        running, latest, refined = self._running[index], self._latest[index], self._refined.get(index)
        if kind == "mean" and self.frames:
            rounds = 1 + max(frame.round for frame in self.frames.values())
            return Picture(running.mean() * per_px, running.covered, len(self.nodes), rounds)
        if kind == "view" and latest is not None:
            return Picture(latest.mean() * per_px, latest.coverage > 0.1 * latest.coverage.max(), 1, 1)
        if kind == "pmlem" and refined is not None:
            return Picture(refined.plane * per_px, running.covered, len(refined.views), refined.rounds)
        return None

    def focus(self, index: int) -> FocusMeasure:
        """Return the power of detail that the two halves of the views agree on, in electrons per pixel, squared."""
        measure, bins = self._running[index].focus(), self.scene.bins
        return FocusMeasure(measure.detail_e2 / bins**4, measure.sigma_e2 / bins**4)

    def is_refined(self, index: int) -> bool:
        """Return whether PMLEM has reached the optimum of the nodes that are complete."""
        if self._sums is None or not self._sums.shared.views:
            return True
        refined, now = self._refined.get(index), (self._sums.shared.views, self._sums.rounds)
        return refined is not None and refined.done and (refined.views, refined.rounds) == now

    def refine(self, index: int, interrupted: Callable[[], bool]) -> None:
        """Run PMLEM on a plane, from where it was left, until its optimum is near or `interrupted`.

        The weight of the penalty follows from the noise, as in `universal_penalty_weight`; no views are held out.
        """
        assert self._sums is not None
        sums, rounds, bins = self._sums.shared, self._sums.rounds, self.scene.bins
        views, exposures_s = sums.views, list(chain(*self.scene.rounds_s[:rounds]))
        images = sums.images(
            _binned_sum(self._noise.background_e(sum(exposures_s)), bins),
            _binned_sum(len(exposures_s) * self._noise.read_variance_e2(), bins),
        )
        # The light in electrons of one round, relative to that of all rounds
        share = np.float32(sum(self.scene.rounds_s[0]) / sum(exposures_s))
        operator = self._factory.at(self._depths_mm[index], self._grids[index], views, images.valid)
        objective = Objective.of(SceneProblem(operator, images), SolverOptions())
        weight = universal_penalty_weight(operator, objective.posed.images, objective.start)
        before = self._refined.get(index)
        start, dual = objective.start, objective.posed.dual()
        if before is not None:
            start, dual = objective.positive(before.plane / share), before.dual
        fit = objective.posed.fit(objective.level_e)
        iterates = pmlem(fit, start, penalty_weight=weight, penalty=objective.penalty, tolerance=_TOLERANCE, dual=dual)
        for count, iterate in enumerate(iterates, 1):
            done = iterate.certificate.distance <= _TOLERANCE or count >= MAX_PASSES or iterate.passes >= MAX_PASSES
            if done or count >= _MIN_ITERATES:
                self._refined[index] = _Refined(iterate.plane * share, iterate.dual, views, rounds, done)
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
        round_s = sum(self.scene.rounds_s[0])
        view = self.scene.view_of[frame.node]
        return _Frame(view, electrons, images.binned(self.scene.bins), frame.exposure_s / round_s)


def _binned_sum(value: float | NDArray[np.floating], bins: int) -> float | Image:
    """Return a number per pixel, or a map of numbers, as sums over bins."""
    if np.ndim(value) == 0:
        return float(value) * bins**2
    return np.asarray(binned(np.asarray(value), bins) * bins**2, np.float32)


def _half(frame: LiveFrame) -> int:
    """Return the half of the views that a node belongs to: a colour of the checkerboard."""
    return sum(frame.node) % 2
