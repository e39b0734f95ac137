"""Planes of all colours, depths and methods: the tasks they consist of, each done once, in whatever process."""

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import FileFailed
from faintfield.pipelines.formats.large_arrays import memory_or_file
from faintfield.pipelines.formats.plane_poses import Place, TiltedPlane
from faintfield.pipelines.formats.results.plane_files import Origin, PlaneFiles
from faintfield.pipelines.formats.results.records import (
    JOINT_METHODS,
    FocusCurve,
    FocusPoint,
    Method,
    PlaneFileRecord,
    PlaneRecord,
)
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.channels import ChannelLayout, load_channel
from faintfield.pipelines.reconstruction.planes.solutions import Settings
from faintfield.pipelines.reconstruction.planes.tasks import Channel, PlaneTask, do_task
from faintfield.recon.depth.focus import FocusMeasure, sharp_depths_mm
from faintfield.recon.operator.grid import PlaneGrid

# Does the tasks of a set in any order, with a folder for temporary files; yields each when saved, with its messages.
type Runner = Callable[[ElementalSet, Path, Sequence[PlaneTask]], Generator[tuple[PlaneTask, list[str]]]]


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

    Attributes
    ----------
    elemental_set : ElementalSet
        The set.
    layouts : list of ChannelLayout
        Its colours.
    grids : dict of Place to PlaneGrid
        The samples of each plane.
    files : sequence of PlaneFiles
        One per method and plane.
    origins : dict of Method to Provenance
        The provenance of all planes of a method together.
    settings : Settings
        Settings of the methods.
    with_focus : bool
        Make a curve of focus against depth.
    finished : dict of (Method, Place) to PlaneFileRecord
        The planes that are there.
    """

    elemental_set: ElementalSet
    layouts: list[ChannelLayout]
    grids: dict[Place, PlaneGrid]
    files: Sequence[PlaneFiles]
    origins: dict[Method, Origin]
    settings: Settings
    with_focus: bool
    finished: dict[tuple[Method, Place], PlaneFileRecord] = field(default_factory=dict)

    def needed_bytes(self) -> int:
        """Return about how much disk the results take: planes, previews, and the report that shows them again."""
        samples = sum(grid.shape[0] * grid.shape[1] for grid in self.grids.values()) * len(self.layouts)
        beside = self.settings.uncertainty + 2 * self.settings.proposal
        files = len(self.origins) * (1 + beside) + ("occlusion" in self.origins)
        return samples * files * (np.dtype(np.float32).itemsize + 3)

    def run(self, runner: Runner, out: Path) -> None:
        """Run the missing tasks, and write each plane at once.

        Raises
        ------
        FileFailed
            A colour that was written cannot be read back.
        """
        for files in self.files:
            if record := files.finished():
                self.finished[files.method, files.place] = record
        if self.finished:
            inform(
                f"{len(self.finished)} of {len(self.files)} planes are there, made from the same inputs; they are kept"
            )
        tasks = self._tasks()
        self._write_complete(self.files)
        with closing(runner(self.elemental_set, out, tasks)) as done:
            for task, messages in progress(done, "reconstructing planes", len(tasks)):
                for message in messages:
                    inform(message)
                self._write_complete(task.files)
        for files in self.files:
            if (files.method, files.place) not in self.finished:
                raise FileFailed(
                    f"{files.path}: one of its colours cannot be read back after it was written; see to its disk, and "
                    "run the same command again"
                )

    def _tasks(self) -> list[PlaneTask]:
        """Return the missing tasks, one channel after the other; with all channels in each if a prior compares them."""
        wanted = [files for files in self.files if (files.method, files.place) not in self.finished]
        missing = [files.missing() for files in wanted]
        tasks = []
        for layouts in [self.layouts] if self.settings.prior != "tv" else [[layout] for layout in self.layouts]:
            names = {layout.name for layout in layouts}
            left = [files for files, channels in zip(wanted, missing, strict=True) if names.intersection(channels)]
            single = [files for files in left if files.method not in JOINT_METHODS]
            for place, grid in self.grids.items():
                of_plane = tuple(files for files in single if files.place == place)
                tasks.append(PlaneTask(tuple(layouts), {place: grid}, of_plane, self.settings, self.with_focus))
            joint = tuple(files for files in left if files.method in JOINT_METHODS)
            tasks.append(PlaneTask(tuple(layouts), self.grids, joint, self.settings, self.with_focus))
        return [task for task in tasks if task.files]

    def _write_complete(self, candidates: Sequence[PlaneFiles]) -> None:
        """Write the planes whose colours are complete."""
        for files in candidates:
            key = (files.method, files.place)
            if key not in self.finished and not files.missing():
                self.finished[key] = files.finish()

    @property
    def records(self) -> list[PlaneRecord]:
        """The records of all planes: by channel, plane, method."""
        methods = list(dict.fromkeys(files.method for files in self.files))
        return [
            self.finished[method, place].planes[index]
            for index in range(len(self.layouts))
            for place in self.grids
            for method in methods
        ]

    @property
    def written(self) -> dict[tuple[Method, float], Path]:
        """The files of the planes of constant depth."""
        return {
            (files.method, files.place): files.path for files in self.files if not isinstance(files.place, TiltedPlane)
        }

    def focus(self) -> FocusCurve | None:
        """Return the focus curve of a sweep and the depths of its peaks, None if not asked for."""
        if not self.with_focus:
            return None
        method = self.files[0].method
        depths = [place for place in self.grids if not isinstance(place, TiltedPlane)]
        curve = [_sum(self.finished[method, depth].focus) for depth in depths]
        stated = self.elemental_set.stated_depth
        return FocusCurve(
            depth_mm=[stated(depth) for depth in depths],
            detail_e2=[point.detail_e2 for point in curve],
            sigma_e2=[point.sigma_e2 for point in curve],
            sharp_mm=[stated(depth) for depth in sharp_depths_mm(depths, curve)],
        )


def _sum(points: Sequence[FocusPoint | None]) -> FocusMeasure:
    """Return the focus of all channels together at one depth."""
    known = [point for point in points if point is not None]
    return FocusMeasure(
        sum(point.detail_e2 for point in known), float(np.linalg.norm([point.sigma_e2 for point in known]))
    )
