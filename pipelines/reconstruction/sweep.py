"""Planes of all colours, depths and methods: the tasks they fall into, each done once, wherever it is done."""

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.formats.large_arrays import memory_or_file
from faintfield.pipelines.formats.plane_poses import Place, TiltedPlane, words_of
from faintfield.pipelines.formats.results.plane_files import PlaneFiles
from faintfield.pipelines.formats.sets.elemental_set import LoadedSet
from faintfield.pipelines.reconstruction.channels import ChannelLayout, OperatorFactory, channel_layouts, load_channel
from faintfield.pipelines.reconstruction.joint import solve_together
from faintfield.pipelines.reconstruction.planes import TOGETHER, Method, Settings, Solution, solve
from faintfield.recon.depth.focus import FocusMeasure, focus_measure, sharp_depths_mm
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator


@dataclass(frozen=True)
class PlaneTask:
    """One colour of one plane, by the methods by which it is not there yet: paths and options, no pixels.

    By methods that find all planes together, one colour of all planes.

    Attributes
    ----------
    layout : ChannelLayout
        The colour.
    grids : dict of Place to PlaneGrid
        The samples of each plane.
    files : tuple of PlaneFiles
        Where the result of each method and plane goes.
    settings : Settings
        Of the methods.
    with_focus : bool
        Whether the power of detail is wanted, too.
    """

    layout: ChannelLayout
    grids: dict[Place, PlaneGrid]
    files: tuple[PlaneFiles, ...]
    settings: Settings
    with_focus: bool


class Channel:
    """One colour of a set, read: what all of its tasks share."""

    def __init__(self, loaded: LoadedSet, layout: ChannelLayout, images: ElementalImages) -> None:
        self._loaded = loaded
        self._images = images
        self._phases = len(layout.lattices)
        self._factory = OperatorFactory(loaded, layout, images)

    def do(self, task: PlaneTask) -> list[str]:
        """Reconstruct what a task asks for, save it, and return what there is to say of it.

        Raises
        ------
        GeometryMismatch, NotConverged
            Of the task's depth, or method.
        """
        words: list[str] = []
        focus: dict[Place, dict[str, Any] | None] = dict.fromkeys(task.grids)
        for place, grid in task.grids.items():
            operator = self._operator(place, grid)
            words += self._blind_views(operator, place)
            if task.with_focus:
                focus[place] = focus_measure(operator, self._images, self._halves())._asdict()
            for files in task.files:
                if files.method not in TOGETHER and files.place == place:
                    self._save(task, files, solve(operator, self._images, files.method, task.settings), focus[place])
        together = [method for method in TOGETHER if any(files.method == method for files in task.files)]
        solved = solve_together(self._factory, self._images, task.grids, together, task.settings) if together else {}
        for files in task.files:
            if files.method in together:
                self._save(task, files, solved[files.method][files.place], focus[files.place])
        return words

    def _operator(self, place: Place, grid: PlaneGrid) -> PlaneOperator:
        try:
            return self._factory.at(place, grid)
        except GeometryMismatch as failure:
            raise GeometryMismatch(f"plane at {words_of(place)}: {failure}") from failure

    def _save(self, task: PlaneTask, files: PlaneFiles, solution: Solution, focus: dict[str, Any] | None) -> None:
        """Save one plane of this colour with its entry."""
        grid = task.grids[files.place]
        record = {
            **_where(files.place),
            "method": files.method,
            "channel": task.layout.name,
            "file": files.path.name,
            **asdict(grid),
            **solution.record,
            "flux_e": float(solution.plane.sum(dtype=np.float64)) * self._samples_per_px(files.place, grid),
        }
        arrays = {"plane": solution.plane, **solution.beside}
        files.save_part(task.layout.name, arrays, {"record": record, "focus": focus})

    def _samples_per_px(self, place: Place, grid: PlaneGrid) -> float:
        """Return how many pixels of the reference view a sample takes, on the axis."""
        depth_mm, foreshortened = (
            (place.depth_mm, abs(place.normal[2])) if isinstance(place, TiltedPlane) else (place, 1.0)
        )
        return float((grid.pitch_mm * self._loaded.settings.camera.fx_px / depth_mm) ** 2 * foreshortened)

    def _halves(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the views of either colour of a checkerboard of nodes; of either parity where nodes are not stated."""
        views = self._loaded.settings.view
        odd = np.array([(sum(view.node) if view.node else index) % 2 for index, view in enumerate(views)])
        odd = np.repeat(odd, self._phases)
        return np.flatnonzero(odd == 0), np.flatnonzero(odd == 1)

    def _blind_views(self, operator: PlaneOperator, place: Place) -> list[str]:
        """Return words on views that see nothing of a plane: a pose may be wrong."""
        blind = {int(view) // self._phases for view in np.setdiff1d(operator.all_views, operator.seeing_views)}
        if not blind:
            return []
        first = self._loaded.settings.view[min(blind)].image
        return [
            f"{words_of(place)}: {len(blind)} views see nothing of the plane, {first} for one; are their poses right?"
        ]


# Who does the tasks of a set and a folder, in any order; yields each when it is saved, with what there is to say of it.
type Crew = Callable[[LoadedSet, Path, Sequence[PlaneTask]], Generator[tuple[PlaneTask, list[str]]]]


def one_by_one(loaded: LoadedSet, out: Path, tasks: Sequence[PlaneTask]) -> Generator[tuple[PlaneTask, list[str]]]:
    """Do tasks in this process, by all its threads, one colour at a time; it is in a file where memory is short."""
    layout: ChannelLayout | None = None
    for task in tasks:
        if task.layout is not layout:
            channel = None  # the channel before goes before the next is read
            channel = Channel(loaded, task.layout, load_channel(loaded, task.layout, memory_or_file(out)))
            layout = task.layout
        assert channel is not None
        yield task, channel.do(task)


class Sweep:
    """The planes of one call: those that are not there yet are made, and written as soon as all their colours are.

    Parameters
    ----------
    loaded : LoadedSet
        The set.
    grids : dict of Place to PlaneGrid
        The samples of each plane.
    files : sequence of PlaneFiles
        Of each method and plane.
    origins : dict of Method to dict
        The provenance of all planes of a method together.
    settings : Settings
        Of the methods.
    with_focus : bool
        Whether a curve of focus against depth is wanted.
    """

    def __init__(
        self,
        loaded: LoadedSet,
        grids: dict[Place, PlaneGrid],
        files: Sequence[PlaneFiles],
        origins: dict[Method, dict[str, Any]],
        settings: Settings,
        *,
        with_focus: bool,
    ) -> None:
        self._loaded = loaded
        self._layouts = channel_layouts(loaded)
        self._grids = grids
        self._files = files
        self.origins = origins
        self._settings = settings
        self._with_focus = with_focus
        self._finished: dict[tuple[Method, Place], dict[str, Any]] = {}

    def needed_bytes(self) -> int:
        """Return about how much disk the results take: planes, previews, and the report that shows them again."""
        samples = sum(grid.shape[0] * grid.shape[1] for grid in self._grids.values()) * len(self._layouts)
        files = len(self.origins) * (2 if self._settings.uncertainty else 1) + ("occlusion" in self.origins)
        return samples * files * (np.dtype(np.float32).itemsize + 3)

    def run(self, crew: Crew, out: Path) -> None:
        """Have the tasks done that are not, and finish each plane at once."""
        for files in self._files:
            if record := files.finished():
                self._finished[files.method, files.place] = record
        if self._finished:
            inform(f"{len(self._finished)} of {len(self._files)} planes are there, made of the same; they stay")
        tasks = self._tasks()
        self._finish_whole(self._files)
        with closing(crew(self._loaded, out, tasks)) as done:
            for task, words in progress(done, "reconstructing planes", len(tasks)):
                for line in words:
                    inform(line)
                self._finish_whole(task.files)

    def _tasks(self) -> list[PlaneTask]:
        """Return what is to be done, one channel after the other."""
        wanted = [files for files in self._files if (files.method, files.place) not in self._finished]
        missing = [files.missing() for files in wanted]
        tasks = []
        for layout in self._layouts:
            left = [files for files, channels in zip(wanted, missing, strict=True) if layout.name in channels]
            alone = [files for files in left if files.method not in TOGETHER]
            for place, grid in self._grids.items():
                of_plane = tuple(files for files in alone if files.place == place)
                tasks.append(PlaneTask(layout, {place: grid}, of_plane, self._settings, self._with_focus))
            together = tuple(files for files in left if files.method in TOGETHER)
            tasks.append(PlaneTask(layout, self._grids, together, self._settings, self._with_focus))
        return [task for task in tasks if task.files]

    def _finish_whole(self, candidates: Sequence[PlaneFiles]) -> None:
        """Write the planes whose colours are complete."""
        for files in candidates:
            key = (files.method, files.place)
            if key not in self._finished and not files.missing():
                self._finished[key] = files.finish(self._grids[files.place].pitch_mm)

    @property
    def records(self) -> list[dict[str, Any]]:
        """The entries of reconstruction.json: by channel, plane, method."""
        methods = list(dict.fromkeys(files.method for files in self._files))
        return [
            self._finished[method, place]["planes"][index]
            for index in range(len(self._layouts))
            for place in self._grids
            for method in methods
        ]

    @property
    def written(self) -> dict[tuple[Method, float], Path]:
        """The files of the planes that have a depth."""
        return {
            (files.method, files.place): files.path for files in self._files if not isinstance(files.place, TiltedPlane)
        }

    def focus(self) -> dict[str, Any] | None:
        """Return the focus curve of a sweep and the depths it marks, None without a sweep."""
        if not self._with_focus:
            return None
        method = self._files[0].method
        depths = [place for place in self._grids if not isinstance(place, TiltedPlane)]
        curve = [_sum(self._finished[method, depth]["focus"]) for depth in depths]
        return {
            "depth_mm": depths,
            "detail_e2": [point.detail_e2 for point in curve],
            "sigma_e2": [point.sigma_e2 for point in curve],
            "sharp_mm": sharp_depths_mm(depths, curve),
        }


def _where(place: Place) -> dict[str, Any]:
    """Return what reconstruction.json says of where a plane is."""
    if isinstance(place, TiltedPlane):
        return {"name": place.name, "depth_mm": place.depth_mm, "rt_ref_plane": list(place.rt_ref_plane)}
    return {"depth_mm": place}


def _sum(of_channels: Sequence[dict[str, float]]) -> FocusMeasure:
    """Return what all channels together say of a depth."""
    detail_e2 = sum(focus["detail_e2"] for focus in of_channels)
    return FocusMeasure(detail_e2, float(np.linalg.norm([focus["sigma_e2"] for focus in of_channels])))
