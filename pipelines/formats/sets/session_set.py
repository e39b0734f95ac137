"""The frames of one kind of a session as an elemental set, in the session's own files."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.homography import rotation_matrix
from faintfield.calib.lens import Lens
from faintfield.pipelines.arguments import SceneKind as SceneKind
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.files import sha256
from faintfield.pipelines.formats.reading import is_file, is_folder
from faintfield.pipelines.formats.results.geometry import GEOMETRY_FILE, CameraPoses, PosesOfSession, read_geometry
from faintfield.pipelines.formats.results.noise import NOISE_FILE, NOISE_MAPS, read_fitted_noise
from faintfield.pipelines.formats.sets.aligned_poses import (
    alignment_of,
    check_match,
    with_alignment,
    with_poses_of_views,
)
from faintfield.pipelines.formats.sets.elemental_file import Camera, ElementalSetFile, View
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from faintfield.pipelines.formats.units import Pose
from faintfield.rig.plan import CapturePlan, StepKind, Stop, planned_frames
from faintfield.rig.session.homings import read_homing_groups
from faintfield.rig.session.session import PLAN, has_session, read_plan, taken_frames

RECONSTRUCTIONS = "reconstructions"

# Files that state the poses from which an alignment of a session starts.
_SOURCES = (PLAN, GEOMETRY_FILE)

_NAMES: dict[SceneKind, str] = {"dark_scene": "dark-scene", "bright": "bright"}


def load_session(
    folder: Path, kind: SceneKind = "dark_scene", geometry: Path | None = None, *, aligned: bool = True
) -> ElementalSet:
    """Return a session's views of the scene, with the noise of its noise.json and the poses of its geometry.json.

    All frames of a node are added up to one view, whatever their exposures. `geometry` is another geometry.json than
    the session's own, or its folder. Without one, the poses are those by which the views were `aligned`, if they were.
    """
    measured = with_measured_geometry(nominal_session(folder, kind, geometry), geometry or folder)
    return measured if geometry is not None or not aligned else with_alignment(measured, *_SOURCES)


def load_set_or_session(folder: Path) -> ElementalSet:
    """Return an elemental set, or the dark scene of a session."""
    return load_session(folder) if has_session(folder) else load_set(folder)


def nominal_session(folder: Path, kind: SceneKind = "dark_scene", geometry: Path | None = None) -> ElementalSet:
    """Return a session's views with the measured lens, but with the poses that the stage was told."""
    plan = read_plan(folder).plan
    exposure_s, frames = _frames_of_views(folder, plan, kind)
    measured_in = geometry or folder / GEOMETRY_FILE
    for path, command in ((measured_in, "geometry"), (folder / NOISE_FILE, "noise")):
        if not (is_file(path) or is_folder(path)):
            raise MissingFile(
                f"{path}: no such file; run `faintfield {command} {folder}` first, or `faintfield run {folder}` for all"
            )
    lens = read_geometry(measured_in, CameraPoses).camera_lens()
    noise = read_fitted_noise(folder / NOISE_FILE, lens.size_px)
    camera = Camera(lens.size_px, lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, lens.distortion, mosaic=noise.mosaic)
    homings = _homings_apart(folder, measured_in)
    _tell_of_mixed(folder, frames, homings)
    views = [nominal_view(stop, plan.centre, names, homings.get(names[0], 0)) for stop, names in frames]
    reference = [view.node for view in views].index(plan.centre.node)
    return ElementalSet(
        folder,
        ElementalSetFile(
            format=1, exposure_s=exposure_s, reference_view=reference, camera=camera, noise=NOISE_FILE, view=views
        ),
        noise.model,
        flat=None if noise.response is None else relative_to_axis(noise.response, noise.unusable, lens),
        unusable=noise.unusable,
        measured_in=measured_in / GEOMETRY_FILE if is_folder(measured_in) else measured_in,
        poses="nominal",
        described_in=PLAN,
        noise_reference=tuple(path for path, _ in _at_centre(folder, "noise_reference")),
        bright_view=next(iter(_at_centre(folder, "bright")), None),
    )


def files_of_scene(folder: Path, kind: SceneKind = "dark_scene") -> list[str]:
    """Return the names of all files that a reconstruction of a session reads."""
    _, frames = _frames_of_views(folder, read_plan(folder).plan, kind)
    aligned = alignment_of(folder, [names[0] for _, names in frames], _SOURCES)
    geometry = GEOMETRY_FILE if aligned is None else aligned.relative_to(folder).as_posix()
    return [PLAN, NOISE_FILE, NOISE_MAPS, geometry, *(name for _, names in frames for name in names)]


def _frames_of_views(folder: Path, plan: CapturePlan, kind: SceneKind) -> tuple[float, list[tuple[Stop, list[str]]]]:
    """Return the exposure of a view, and its frames' names at every node that has all of them, in raster order.

    Of a step in rounds, those are the frames of its first rounds, each of which one node of ten may lack, or one.
    """
    planned = [frame for frame in planned_frames(plan) if frame.kind == kind]
    at_centre = [frame for frame in planned if frame.stop == plan.centre]
    wanted = Counter(frame.round for frame in at_centre)
    stops: dict[tuple[int, int], Stop] = {}
    taken: defaultdict[tuple[int, int], defaultdict[int, list[str]]] = defaultdict(lambda: defaultdict(list))
    for frame, _, path in taken_frames(folder):
        if frame.kind == kind:
            if not is_file(path):
                raise MissingFile(f"{path}: is in the journal but missing; restore it from a copy")
            stops[frame.stop.node] = frame.stop
            taken[frame.stop.node][frame.round].append(path.relative_to(folder).as_posix())

    whole_rounds = {
        node: next(number for number in count() if len(names.get(number, ())) != wanted.get(number))
        for node, names in taken.items()
    }
    counts = sorted(whole_rounds.values(), reverse=True)
    views = sum(number > 0 for number in counts)
    fewest = max(views - max(1, views // 10), 1)  # of few views more than one is much
    rounds = min(counts[fewest - 1], whole_rounds.get(plan.centre.node, 0)) if views else 0
    nodes = sorted(node for node, number in whole_rounds.items() if number >= max(rounds, 1))
    whole = [(stops[node], [name for number in range(rounds) for name in taken[node][number]]) for node in nodes]
    if not at_centre or plan.centre not in [stop for stop, _ in whole]:
        raise BadValue(
            f"{folder}: has no {_NAMES[kind]} frame of the centre node {list(plan.centre.node)}, whose camera is the "
            f"reference; take it by a {kind} step of the rig.toml"
        )
    if lacking := len({frame.stop.node for frame in planned}) - len(whole):
        inform(f"{folder}: {lacking} nodes lack {_NAMES[kind]} frames and are left out; capture again to take them")
    if further := sum(
        len(names) for of_node in taken.values() for number, names in of_node.items() if number >= rounds
    ):
        inform(f"{folder}: {further} frames of a round that is not whole are left out; capture again to complete it")
    return sum(frame.exposure_s for frame in at_centre if frame.round < rounds), whole


def _at_centre(folder: Path, kind: StepKind) -> list[tuple[Path, float]]:
    centre = read_plan(folder).plan.centre
    taken = [(frame, path) for frame, _, path in taken_frames(folder) if frame.kind == kind and frame.stop == centre]
    return [(path, frame.exposure_s) for frame, path in taken if is_file(path)]


def relative_to_axis(response: NDArray[np.float32], unusable: NDArray[np.bool_], lens: Lens) -> NDArray[np.float32]:
    """Return the response (row, column) relative to the pixels around the lens's axis, to which planes refer."""
    near = max(lens.size_px) // 20 + 1
    row, column = round(lens.cy_px), round(lens.cx_px)
    window = (slice(max(row - near, 0), row + near), slice(max(column - near, 0), column + near))
    about_axis = response[window][~unusable[window]]
    level = float(about_axis.mean(dtype=np.float64)) if about_axis.size else 0.0
    return (response / np.float32(level)) if level > 0 else response


def _homings_apart(folder: Path, measured_in: Path) -> dict[str, int]:
    """Return the homing of each frame by name; of none where all homings are known to lead to one place.

    Where the geometry is that of another session, whose homings are others, the numbers are negative: their shifts are
    not known.
    """
    homings, geometry = read_homing_groups(folder), read_geometry(measured_in, PosesOfSession)
    own = geometry.inputs.get(PLAN) == sha256(folder / PLAN)
    if homings.repeat() and not (own and geometry.homings):
        return {}
    frames = [(path.relative_to(folder).as_posix(), taken.intent) for _, taken, path in taken_frames(folder)]
    return {name: (homings.groups.get(intent) or 0) * (1 if own else -1) for name, intent in frames}


def _tell_of_mixed(folder: Path, frames: Sequence[tuple[Stop, list[str]]], homings: Mapping[str, int]) -> None:
    """Name the views whose frames were taken after different homings, and may not lie upon one another."""
    mixed = [stop.node for stop, names in frames if len({homings.get(name, 0) for name in names}) > 1]
    if mixed:
        inform(
            f"{folder}: the stage homed between the frames of {len(mixed)} of {len(frames)} nodes ({list(mixed[0])} is "
            "the first); they are added up at the pose of the first, and may be off by as much as the switches repeat"
        )


def nominal_view(stop: Stop, centre: Stop, names: list[str], homing: int) -> View:
    """Return the view of a node, with the pose that the stage was told."""
    right_mm, down_mm = stop.target.x_mm - centre.target.x_mm, stop.target.y_mm - centre.target.y_mm
    return View(names[0], (0.0, 0.0, 0.0, -right_mm, -down_mm, 0.0), stop.node, repeats=tuple(names[1:]), homing=homing)


def with_measured_geometry(elemental_set: ElementalSet, path: Path) -> ElementalSet:
    """Return a set with the lens of a geometry.json, each view at its node's measured pose; BadValue if one lacks.

    Poses that were found by the views include what homings shifted.
    """
    path = path / GEOMETRY_FILE if is_folder(path) else path
    geometry, settings = read_geometry(path, CameraPoses), elemental_set.settings
    if geometry.source == "views":
        return with_poses_of_views(elemental_set, path)
    check_match(path, geometry, elemental_set, [view.node for view in settings.view])
    poses = {entry.node: entry.rt_cam_ref for entry in geometry.nodes}
    camera = settings.camera.with_lens(geometry.camera_lens())
    shifts_mm = _homing_shifts_mm(path, geometry, elemental_set)
    views = [
        msgspec.structs.replace(
            view, rt_cam_ref=_shifted(poses[view.node], shifts_mm[view.homing]), cx_px=None, cy_px=None
        )
        for view in settings.view
        if view.node is not None
    ]
    measured = msgspec.structs.replace(settings, camera=camera, view=views)
    return replace(elemental_set, settings=measured, measured_in=path, poses="measured")


def _homing_shifts_mm(path: Path, geometry: CameraPoses, elemental_set: ElementalSet) -> dict[int, NDArray[np.float64]]:
    views = elemental_set.settings.view
    of_reference = views[elemental_set.settings.reference_view].homing
    shifts = {homing: geometry.homing_shift_mm(of_reference, homing) for homing in {view.homing for view in views}}
    unknown = [view for view in views if shifts[view.homing] is None]
    if unknown:
        inform(
            f"{elemental_set.folder}: the stage homed while the views were taken; {path} knows no shift by that, so "
            f"{len(unknown)} of {len(views)} views ({unknown[0].image} is the first) may be off by as much as the "
            "switches repeat; show boards before and after within one sweep, or take the scene again"
        )
    return {homing: np.zeros(3) if shift is None else np.array(shift) for homing, shift in shifts.items()}


def _shifted(rt_cam_ref: Pose, shift_mm: NDArray[np.float64]) -> Pose:
    """Return the pose of a camera whose centre is shifted in the reference frame."""
    if not shift_mm.any():
        return rt_cam_ref
    turned = rotation_matrix(np.array(rt_cam_ref)) @ shift_mm
    a, b, c, x, y, z = (np.array(rt_cam_ref) - np.append(np.zeros(3), turned)).tolist()
    return a, b, c, x, y, z
