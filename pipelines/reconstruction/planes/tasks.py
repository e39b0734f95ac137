"""One plane of a set, in one colour or all: a task, done with the images of its colours in whatever process."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from msgspec import UNSET, structs
from numpy.typing import NDArray

from faintfield.pipelines.formats.plane_poses import Place, TiltedPlane, depth_of
from faintfield.pipelines.formats.results.plane_files import PlaneFiles
from faintfield.pipelines.formats.results.records import JOINT_METHODS, FocusPoint, PlaneRecord
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.formats.sets.stated import in_units, light_per_e
from faintfield.pipelines.reconstruction.channels import ChannelLayout
from faintfield.pipelines.reconstruction.operators import OperatorFactory
from faintfield.pipelines.reconstruction.planes.joint import solve_together
from faintfield.pipelines.reconstruction.planes.solutions import Pilot, Settings, Solution
from faintfield.pipelines.reconstruction.planes.solve import solve
from faintfield.recon.depth.focus import focus_measure
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator


@dataclass(frozen=True)
class PlaneTask:
    """One plane by the methods that still lack it; holds paths and options, no pixels.

    For methods that reconstruct all planes together: all planes. One colour, or all colours if a prior compares them.

    Attributes
    ----------
    layouts : tuple of ChannelLayout
        The colours.
    grids : dict of Place to PlaneGrid
        The samples of each plane.
    files : tuple of PlaneFiles
        Where the result of each method and plane goes.
    settings : Settings
        Settings of the methods.
    with_focus : bool
        Measure the power of detail, too.
    """

    layouts: tuple[ChannelLayout, ...]
    grids: dict[Place, PlaneGrid]
    files: tuple[PlaneFiles, ...]
    settings: Settings
    with_focus: bool


class Channel:
    """One colour of a set in memory: what all of its tasks share."""

    def __init__(self, elemental_set: ElementalSet, layout: ChannelLayout, images: ElementalImages) -> None:
        self._loaded = elemental_set
        self._layout = layout
        self._images = images
        self._phases = len(layout.lattices)
        self._factory = OperatorFactory(elemental_set, layout, images)

    def total_variation(self, task: PlaneTask) -> dict[Place, Solution]:
        """Return the planes from which the priors of a task begin."""
        settings = replace(task.settings, prior="tv", uncertainty=False)
        if any(files.method in JOINT_METHODS for files in task.files):
            return solve_together(self._factory, self._images, task.grids, ["joint"], settings)["joint"]
        operators = {place: self._operator(place, grid) for place, grid in task.grids.items()}
        return {place: solve(operator, self._images, "pmlem", settings) for place, operator in operators.items()}

    def do(self, task: PlaneTask, pilots: Mapping[Place, Pilot] | None = None) -> list[str]:
        """Reconstruct and save this colour of what a task asks for, and return messages for the user.

        Raises
        ------
        GeometryMismatch, NotConverged
            Of the task's depth, or method.
        """
        messages: list[str] = []
        focus: dict[Place, FocusPoint | None] = dict.fromkeys(task.grids)
        for place, grid in task.grids.items():
            operator = self._operator(place, grid)
            messages += self._blind_views(operator, place)
            if task.with_focus:
                focus[place] = FocusPoint(*focus_measure(operator, self._images, self._halves()))
            for files in task.files:
                if files.method not in JOINT_METHODS and files.place == place:
                    pilot = pilots[place] if pilots else None
                    solution = solve(operator, self._images, files.method, task.settings, pilot)
                    self._save(task, files, solution, focus[place])
        joint = [method for method in JOINT_METHODS if any(files.method == method for files in task.files)]
        if joint:
            solved = solve_together(self._factory, self._images, task.grids, joint, task.settings, pilots)
            for files in task.files:
                if files.method in joint:
                    self._save(task, files, solved[files.method][files.place], focus[files.place])
        return messages

    def _operator(self, place: Place, grid: PlaneGrid) -> PlaneOperator:
        """Return H of a plane; a failure names the plane."""
        try:
            return self._factory.at(place, grid)
        except GeometryMismatch as failure:
            raise GeometryMismatch(f"plane at {self._describe(place)}: {failure}") from failure

    def _save(self, task: PlaneTask, files: PlaneFiles, solution: Solution, focus: FocusPoint | None) -> None:
        """Save one plane of this colour with its record."""
        place, grid = files.place, task.grids[files.place]
        tilted = place if isinstance(place, TiltedPlane) else None
        px_per_sample = grid.pitch_mm * self._loaded.settings.camera.fx_px / depth_of(place)  # on the axis
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
            flux_e=float(solution.plane.sum(dtype=np.float64)) * (px_per_sample**2 * cosine),
        )
        arrays = {"plane": solution.plane, **solution.sidecars}
        light = light_per_e(self._loaded)
        if light != 1:
            arrays |= {name: light * arrays[name] for name in ("plane", "sigma", "proposal") if name in arrays}
        focus = in_units(self._loaded, focus) if focus else None
        files.save_part(self._layout.name, arrays, in_units(self._loaded, record), focus)

    def _describe(self, place: Place) -> str:
        """Return the name of a plane in messages."""
        return f"'{place.name}'" if isinstance(place, TiltedPlane) else self._loaded.depth_text(place)

    def _halves(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the views on both colours of a checkerboard of nodes; even and odd ones if no nodes are stated."""
        views = self._loaded.settings.view
        odd = np.array([(sum(view.node) if view.node else index) % 2 for index, view in enumerate(views)])
        odd = np.repeat(odd, self._phases)
        return np.flatnonzero(odd == 0), np.flatnonzero(odd == 1)

    def _blind_views(self, operator: PlaneOperator, place: Place) -> list[str]:
        """Return a message on views that see nothing of a plane: a pose may be wrong."""
        blind = {int(view) // self._phases for view in np.setdiff1d(operator.all_views, operator.seeing_views)}
        if not blind:
            return []
        first, count = self._loaded.settings.view[min(blind)].image, len(blind)
        place_words = self._describe(place)
        return [f"{place_words}: {count} views see nothing of the plane, {first} for one; are their poses right?"]


def do_task(task: PlaneTask, opened: Callable[[ChannelLayout], Channel]) -> list[str]:
    """Do a task, given what opens a colour, and return messages for the user.

    If colours are compared, total variation gives the planes of all of them first. One is opened after the other, so
    that only one has to be in memory.
    """
    pilots: dict[str, dict[Place, Pilot]] = {}
    if len(task.layouts) > 1:
        planes = {layout.name: opened(layout).total_variation(task) for layout in task.layouts}
        pilots = {name: {place: _pilot(planes, name, place) for place in task.grids} for name in planes}
    messages: list[str] = []
    for layout in reversed(task.layouts):  # the last is still open
        messages += opened(layout).do(task, pilots.get(layout.name))
    return messages


def _pilot(planes: Mapping[str, Mapping[Place, Solution]], name: str, place: Place) -> Pilot:
    """Return one colour of a plane, and the light of the others."""
    # Weights by the colours' noise were no better on photographs than the sum
    others = [found[place].plane for other, found in planes.items() if other != name]
    return Pilot(planes[name][place], np.sum(others, axis=0))
