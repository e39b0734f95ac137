"""Planes of all colours, depths and methods: the tasks they consist of, each done once, in whatever process."""

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from msgspec import UNSET, structs
from numpy.typing import NDArray

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import FileFailed
from faintfield.pipelines.formats.frames import ChannelLayout
from faintfield.pipelines.formats.large_arrays import memory_or_file
from faintfield.pipelines.formats.plane_poses import Place, TiltedPlane, depth_of
from faintfield.pipelines.formats.results.plane_files import Origin, PlaneFiles
from faintfield.pipelines.formats.results.records import (
    JOINT_METHODS,
    FocusCurve,
    FocusPoint,
    Method,
    PlaneFileRecord,
    PlaneRecord,
)
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, in_units, light_per_e
from faintfield.pipelines.reconstruction.channels import load_channel
from faintfield.pipelines.reconstruction.operators import OperatorFactory, blind_views
from faintfield.pipelines.reconstruction.planes.penalised import Pilot, Solution
from faintfield.pipelines.reconstruction.planes.saturation import PixelSelection
from faintfield.pipelines.reconstruction.planes.solve import solve, solve_pilot, solve_together
from faintfield.recon.depth.focus import FocusMeasure, focus_measure, sharp_depths_mm
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.single_plane import PlaneOperator

# Does the tasks of a set in any order, with a folder for temporary files; yields each when saved, with its messages.
type Runner = Callable[[ElementalSet, Path, Sequence[PlaneTask]], Generator[tuple[PlaneTask, list[str]]]]


@dataclass(frozen=True)
class PlaneTask:
    """One plane by the methods that still lack it, or all planes for methods that solve them together.

    It holds paths and options, no pixels: one colour, or all colours if a prior compares them; and a file for each
    method and plane. `with_focus` measures the power of detail, too.
    """

    layouts: tuple[ChannelLayout, ...]
    grids: dict[Place, PlaneGrid]
    files: tuple[PlaneFiles, ...]
    solver: SolverOptions
    with_focus: bool

    @property
    def cost(self) -> int:
        """Planes that are solved, a colour once for each of its lattices: about how long the task takes."""
        return len(self.files) * sum(len(layout.lattices) for layout in self.layouts)


@dataclass(frozen=True)
class Part:
    """A part of the planes of a sweep, made by a process of its own: every `count`-th plane from the `number`-th on."""

    number: int
    count: int

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"


class Channel:
    """One colour of a set in memory: what all of its tasks share."""

    def __init__(self, elemental_set: ElementalSet, layout: ChannelLayout, images: ElementalImages) -> None:
        self._set, self._layout, self._images = elemental_set, layout, images
        self._factory = OperatorFactory(elemental_set, layout, images)

    def total_variation(self, task: PlaneTask) -> dict[Place, Solution]:
        """Return the planes from which the priors of a task begin."""
        solver = task.solver.without_prior()
        if any(files.method in JOINT_METHODS for files in task.files):
            return solve_together(self._factory, self._images, task.grids, ["joint"], solver)["joint"]
        operators = {place: self._operator(place, grid) for place, grid in task.grids.items()}
        return {place: solve_pilot(operator, self._images, solver) for place, operator in operators.items()}

    def do(self, task: PlaneTask, pilots: Mapping[Place, Pilot] | None = None) -> list[str]:
        """Reconstruct and save this colour of what a task asks for, and return messages for the user."""
        messages: list[str] = []
        focus: dict[Place, FocusPoint | None] = dict.fromkeys(task.grids)
        selected: dict[Place, PixelSelection | None] = dict.fromkeys(task.grids)
        for place, grid in task.grids.items():
            operator = self._operator(place, grid)
            if self._images.valid is not None:
                whole = self._factory.at(place, grid, range(len(self._set.settings.view)))
                selected[place] = PixelSelection.of(operator, whole, self._images)
            if message := blind_views(self._set, operator, "the plane"):
                messages.append(f"{self._describe(place)}: {message}")
            if task.with_focus:
                focus[place] = FocusPoint(*focus_measure(operator, self._images, self._halves()))
            for files in task.files:
                if files.method not in JOINT_METHODS and files.place == place:
                    pilot = pilots[place] if pilots else None
                    solution = solve(operator, self._images, files.method, task.solver, pilot)
                    self._save(task, files, solution, focus[place], selected[place])
        joint = [method for method in JOINT_METHODS if any(files.method == method for files in task.files)]
        if joint:
            solved = solve_together(self._factory, self._images, task.grids, joint, task.solver, pilots)
            for files in task.files:
                if files.method in joint:
                    place = files.place
                    self._save(task, files, solved[files.method][place], focus[place], selected[place])
        return messages

    def _operator(self, place: Place, grid: PlaneGrid) -> PlaneOperator:
        try:
            return self._factory.at(place, grid)
        except GeometryMismatch as failure:
            raise GeometryMismatch(f"plane at {self._describe(place)}: {failure}") from failure

    def _save(
        self,
        task: PlaneTask,
        files: PlaneFiles,
        solution: Solution,
        focus: FocusPoint | None,
        selected: PixelSelection | None,
    ) -> None:
        place, grid = files.place, task.grids[files.place]
        arrays = {"plane": solution.plane, **solution.sidecars}
        if selected is not None:
            arrays = selected.applied(arrays, float(np.mean(self._images.known_variance_e2())))
        tilted = place if isinstance(place, TiltedPlane) else None
        px_per_sample = grid.pitch_mm * self._set.settings.camera.fx_px / depth_of(place)  # on the axis
        cosine = abs(float(tilted.normal[2])) if tilted else 1.0
        record = PlaneRecord(
            name=tilted.name if tilted else UNSET,
            depth_mm=depth_of(place),
            rt_ref_plane=tilted.rt_ref_plane if tilted else UNSET,
            method=files.method,
            channel=self._layout.name,
            file=files.path.name,
            shape=grid.shape,
            pitch_mm=grid.pitch_mm,
            origin_mm=grid.origin_mm,
            **structs.asdict(solution.record),
            mean_e=float(np.nanmean(arrays["plane"], dtype=np.float64)),
            flux_e=float(np.nansum(arrays["plane"], dtype=np.float64)) * (px_per_sample**2 * cosine),
            saturated_share=selected.saturated_share if selected else UNSET,
            unknown_share=selected.unknown_share if selected else UNSET,
        )
        light = light_per_e(self._set)
        if light != 1:
            arrays |= {name: light * arrays[name] for name in ("plane", "sigma", "proposal") if name in arrays}
        focus = in_units(self._set, focus) if focus else None
        files.save_part(self._layout.name, arrays, in_units(self._set, record), focus)

    def _describe(self, place: Place) -> str:
        return f"'{place.name}'" if isinstance(place, TiltedPlane) else self._set.depth_text(place)

    def _halves(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the views on both colours of a checkerboard of nodes; even and odd ones if no nodes are stated."""
        views = self._set.settings.view
        odd = np.array([(sum(view.node) if view.node else index) % 2 for index, view in enumerate(views)])
        odd = np.repeat(odd, len(self._layout.lattices))
        return np.flatnonzero(odd == 0), np.flatnonzero(odd == 1)


def do_task(task: PlaneTask, opened: Callable[[ChannelLayout], Channel]) -> list[str]:
    """Do a task, given what opens a colour, and return messages for the user.

    If colours are compared, total variation gives the planes of all of them first. One is opened after the other, so
    that only one has to be in memory.
    """
    if len(task.layouts) == 1:
        return opened(task.layouts[0]).do(task)
    planes = {layout.name: opened(layout).total_variation(task) for layout in task.layouts}
    messages: list[str] = []
    for layout in reversed(task.layouts):  # the last is still open
        messages += opened(layout).do(task, {place: _pilot(planes, layout.name, place) for place in task.grids})
    return messages


def _pilot(planes: Mapping[str, Mapping[Place, Solution]], name: str, place: Place) -> Pilot:
    """Return one colour of a plane, and the light of the others."""
    # Weights by the colours' noise were no better on photographs than the sum
    others = [found[place].plane for other, found in planes.items() if other != name]
    return Pilot(planes[name][place], np.sum(others, axis=0))


def run_serially(
    elemental_set: ElementalSet, out: Path, tasks: Sequence[PlaneTask]
) -> Generator[tuple[PlaneTask, list[str]]]:
    """Do tasks in this process with all its threads, one colour at a time, from a file if memory is short."""
    held: list[tuple[ChannelLayout, Channel]] = []

    def opened(layout: ChannelLayout) -> Channel:
        if not held or held[0][0] is not layout:
            held.clear()  # frees the previous channel before the next is read
            held.append(
                (layout, Channel(elemental_set, layout, load_channel(elemental_set, layout, memory_or_file(out))))
            )
        return held[0][1]

    for task in tasks:
        yield task, do_task(task, opened)


@dataclass(frozen=True)
class Sweep:
    """The planes of one call: those missing are made, and each is written as soon as all its colours are there.

    `plan` is the task of all planes. `origins` are the provenances of all planes of a method together, and `finished`
    the planes that are there.
    """

    elemental_set: ElementalSet
    plan: PlaneTask
    origins: dict[Method, Origin]
    finished: dict[tuple[Method, Place], PlaneFileRecord] = field(default_factory=dict)

    def needed_bytes(self) -> int:
        """Return about how much is to be written: missing planes, and the stack, previews and report of all."""
        plan, float_bytes, shown_bytes = self.plan, np.dtype(np.float32).itemsize, 3
        stacked = np.prod(np.max([grid.shape for grid in plan.grids.values()], axis=0)) if plan.with_focus else 0
        total = 0
        for files in plan.files:
            rows, columns = plan.grids[files.place].shape
            arrays = 1 + plan.solver.uncertainty + 2 * plan.solver.proposal + (files.method == "occlusion")
            is_missing = (files.method, files.place) not in self.finished
            per_sample = arrays * (is_missing * float_bytes + shown_bytes)
            total += len(plan.layouts) * (rows * columns * per_sample + int(stacked) * float_bytes)
        return total

    def part(self, part: Part) -> "Sweep":
        """Return the sweep of a part of the planes, with all their colours and methods."""
        plan = self.plan
        places = list(plan.grids)[part.number - 1 :: part.count]
        grids = {place: plan.grids[place] for place in places}
        return replace(self, plan=replace(plan, grids=grids, files=tuple(f for f in plan.files if f.place in grids)))

    def keep_finished(self) -> None:
        """Find the planes that are there, made from the same inputs."""
        planned = self.plan.files
        for files in planned:
            if record := files.finished():
                self.finished[files.method, files.place] = record
        if self.finished:
            inform(f"{len(self.finished)} of {len(planned)} planes are there, made from the same inputs; they are kept")

    def run(self, runner: Runner, out: Path) -> None:
        """Run the missing tasks, and write each plane at once (FileFailed: a colour cannot be read back)."""
        planned = self.plan.files
        tasks = self.tasks()
        self._write_complete(planned)
        with closing(runner(self.elemental_set, out, tasks)) as done:
            cost = sum(task.cost for task in tasks)
            for task, messages in progress(
                done, "reconstructing planes", len(tasks), cost=lambda result: result[0].cost, total_cost=cost
            ):
                for message in messages:
                    inform(message)
                self._write_complete(task.files)
        for files in planned:
            if (files.method, files.place) not in self.finished:
                raise FileFailed(
                    f"{files.path}: one of its colours cannot be read back after it was written; see to its disk, and "
                    "run the same command again"
                )

    def tasks(self) -> list[PlaneTask]:
        """Return the missing tasks, one channel after the other; with all channels in each if a prior compares them."""
        plan, tasks = self.plan, []
        wanted = [files for files in plan.files if (files.method, files.place) not in self.finished]
        missing = [(files, files.missing()) for files in wanted]
        for layouts in [plan.layouts] if plan.solver.has_prior else [(layout,) for layout in plan.layouts]:
            names = {layout.name for layout in layouts}
            left = [files for files, channels in missing if names.intersection(channels)]
            single = [files for files in left if files.method not in JOINT_METHODS]
            for place, grid in plan.grids.items():
                of_plane = tuple(files for files in single if files.place == place)
                tasks.append(replace(plan, layouts=layouts, grids={place: grid}, files=of_plane))
            joint = tuple(files for files in left if files.method in JOINT_METHODS)
            tasks.append(replace(plan, layouts=layouts, files=joint))
        return [task for task in tasks if task.files]

    def _write_complete(self, candidates: Sequence[PlaneFiles]) -> None:
        for files in candidates:
            key = (files.method, files.place)
            if key not in self.finished and not files.missing():
                self.finished[key] = files.finish()

    @property
    def records(self) -> list[PlaneRecord]:
        """The records of all planes: by channel, plane, method."""
        return [
            self.finished[method, place].planes[index]
            for index in range(len(self.plan.layouts))
            for place in self.plan.grids
            for method in self.origins
        ]

    @property
    def written(self) -> dict[tuple[Method, float], Path]:
        """The files of the planes of constant depth."""
        return {
            (files.method, files.place): files.path
            for files in self.plan.files
            if not isinstance(files.place, TiltedPlane)
        }

    def focus(self) -> FocusCurve | None:
        """Return the focus curve of a sweep and the depths of its peaks, None if not asked for."""
        if not self.plan.with_focus:
            return None
        method = self.plan.files[0].method
        depths = [place for place in self.plan.grids if not isinstance(place, TiltedPlane)]
        curve = [_sum(self.finished[method, depth].focus) for depth in depths]
        stated = self.elemental_set.stated_depth
        return FocusCurve(
            depth_mm=[stated(depth) for depth in depths],
            detail_e2=[point.detail_e2 for point in curve],
            sigma_e2=[point.sigma_e2 for point in curve],
            sharp_mm=[stated(depth) for depth in sharp_depths_mm(depths, curve)],
        )


def _sum(points: Sequence[FocusPoint | None]) -> FocusMeasure:
    known = [point for point in points if point is not None]
    return FocusMeasure(
        sum(point.detail_e2 for point in known), float(np.linalg.norm([point.sigma_e2 for point in known]))
    )
