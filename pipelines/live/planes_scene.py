"""Scene of live planes before it is complete: nodes, lens, poses and noise, with their sources."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from faintfield.calib.lens import Lens
from faintfield.calib.noise_model import NoiseModel
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.frames import ChannelLayout, Frame, Lattice, mosaic_period
from faintfield.pipelines.formats.results.geometry import GEOMETRY_FILE, CameraPoses, read_geometry
from faintfield.pipelines.formats.results.noise import NOISE_FILE, FittedNoise, read_fitted_noise
from faintfield.pipelines.formats.sets.elemental_file import Camera, ElementalSetFile
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.formats.sets.session_set import nominal_view, relative_to_axis, with_measured_geometry
from faintfield.pipelines.live.planes_client import NO_POSES, BoardPoses, LiveOrder
from faintfield.pipelines.planning.known import KnownLens, Sensor, calibration_file, known_lens, known_sensor
from faintfield.rig.plan import CapturePlan, PlannedFrame, planned_frames
from faintfield.rig.session.session import FrozenPlan

# Most pixels of a view after binning: planes of about a million samples are computed as frames arrive, and fill a
# screen.
_MAX_PIXELS = 1_100_000

type Node = tuple[int, int]


@dataclass(frozen=True)
class LiveScene:
    """The views of one round of a dark scene that is planned, as an elemental set without images.

    The set has a view per node; the names of its images mean nothing. `rounds_s` are the exposure times of the frames
    of a view, by round. `layout` has the pixels that count, of RGB the
    green ones; `bins` are so many pixels wide; `view_of` has the index of each node's view. `poses` and `noise` are
    their sources, in words. Unless it `knows_noise`, light is in DN and PMLEM has no likelihood.
    """

    elemental_set: ElementalSet
    rounds_s: tuple[tuple[float, ...], ...]
    layout: ChannelLayout
    bins: int
    view_of: dict[Node, int]
    poses: str
    noise: str
    knows_noise: bool


def live_scene(order: LiveOrder, frozen: FrozenPlan, frame: Frame, boards: BoardPoses = NO_POSES) -> LiveScene:
    """Return what is known of the dark scene of a session that is being captured, given any of its frames.

    Poses are the measured ones of a geometry.json if it has all nodes, else those that the stage is told. A geometry
    that is given, or lies in the session, precedes that of its `boards`, and this one that beside rig.toml. Raises
    `RigError` or `InputError` if no lens is known, or a file cannot be used; the message says what to give.
    """
    height, width = frame.pixels_dn.shape[:2]
    size_px = (width, height)
    folders = order.session, order.rig.parent
    geometry = calibration_file(order.geometry, GEOMETRY_FILE, order.session)
    of_boards = geometry is None and boards.path is not None
    if geometry is None:
        geometry = boards.path or calibration_file(None, GEOMETRY_FILE, order.rig.parent)
    sensor = known_sensor(frozen.rig, calibration_file(order.noise, NOISE_FILE, *folders))
    known = known_lens(frozen.rig, sensor, geometry, order.fx_px)
    lens, lens_source = _lens(geometry, known, size_px, "as given" if order.fx_px else "of the simulated camera")
    fitted = _noise(sensor, known, size_px)
    mosaic = fitted.mosaic or frozen.rig.mosaic or frame.mosaic
    rounds_s = _rounds_s(order.session, frozen.plan)
    planned = _planned_set(order.session, frozen.plan, rounds_s[0], lens, fitted)
    elemental_set, poses = _with_poses(planned, geometry, lens_source)
    if of_boards and elemental_set.poses == "measured":
        poses = "measured, of the boards of this session"
    elif boards.refusal and elemental_set.poses != "measured":
        poses += f"; the boards of this session gave none: {boards.refusal}"
    plane_of_colour = 1 if frame.pixels_dn.ndim == 3 else None
    return LiveScene(
        elemental_set,
        rounds_s,
        ChannelLayout("grey", plane_of_colour, (Lattice((0, 0), (1, 1), (height, width)),)),
        bins_of(size_px, int(np.lcm(*mosaic_period(mosaic)))),
        {view.node: index for index, view in enumerate(elemental_set.settings.view) if view.node is not None},
        poses,
        sensor.source,
        sensor.path is not None or sensor.model is not None,
    )


def bins_of(size_px: tuple[int, int], period_px: int) -> int:
    """Return the width of bins that leave about a million: 1, or whole periods of a mosaic."""
    needed = int(np.ceil(np.sqrt(size_px[0] * size_px[1] / _MAX_PIXELS)))
    return -(-needed // period_px) * period_px


def dark_frames(plan: CapturePlan) -> list[PlannedFrame]:
    """Return the planned frames of the dark scene."""
    return [frame for frame in planned_frames(plan) if frame.kind == "dark_scene"]


def _lens(path: Path | None, known: KnownLens, size_px: tuple[int, int], origin: str) -> tuple[Lens, str]:
    """Return the lens, and its source in words."""
    if path is not None:
        return read_geometry(path, CameraPoses).camera_lens(), f"lens of {path}"
    f_px = known.f_px.value
    if f_px is None:
        raise MissingFile(
            "no lens is known, and live planes need one; run `faintfield geometry` on the boards of this session, or "
            "give --geometry or --fx-px"
        )
    centre_px = known.centre_px if known.size_px == size_px else None
    cx_px, cy_px = centre_px or ((size_px[0] - 1) / 2, (size_px[1] - 1) / 2)
    return Lens(size_px, f_px, f_px, cx_px, cy_px, ()), f"focal length of {f_px:g} px {origin}, no distortion"


def _noise(sensor: Sensor, lens: KnownLens, size_px: tuple[int, int]) -> FittedNoise:
    """Return the noise of the sensor; DN are taken for electrons where it is not known."""
    if sensor.path is not None:
        return read_fitted_noise(sensor.path, size_px)
    unusable = np.zeros(size_px[::-1], bool)
    if sensor.model is None:
        return FittedNoise(NoiseModel(0.0, 1.0, 0.0), unusable, None)
    response = lens.response
    known = response is not None and response.shape == unusable.shape
    return FittedNoise(sensor.model, unusable, np.asarray(response, np.float32) if known else None)


def _rounds_s(session: Path, plan: CapturePlan) -> tuple[tuple[float, ...], ...]:
    """Return the exposure times of the frames of a view in each round."""
    rounds: dict[int, list[float]] = {}
    for frame in dark_frames(plan):
        if frame.stop == plan.centre:
            rounds.setdefault(frame.round, []).append(frame.exposure_s)
    if not rounds:
        raise BadValue(
            f"{session}: no dark_scene frame is planned at the centre node {list(plan.centre.node)}, whose camera is "
            "the reference; take the dark scene at the grid"
        )
    return tuple(tuple(exposures_s) for _, exposures_s in sorted(rounds.items()))


def _planned_set(
    session: Path, plan: CapturePlan, exposures_s: Sequence[float], lens: Lens, fitted: FittedNoise
) -> ElementalSet:
    """Return the set of all planned views, at the poses that the stage is told, with frames of these exposures."""
    stops = sorted({frame.stop.node: frame.stop for frame in dark_frames(plan)}.items())
    nodes = [node for node, _ in stops]
    names = ["frame"] * len(exposures_s)
    camera = Camera(lens.size_px, lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, lens.distortion)
    settings = ElementalSetFile(
        format=1,
        exposure_s=sum(exposures_s),
        reference_view=nodes.index(plan.centre.node),
        camera=camera,
        noise=NOISE_FILE,
        view=[nominal_view(stop, plan.centre, names, 0) for _, stop in stops],
    )
    flat = None if fitted.response is None else relative_to_axis(fitted.response, fitted.unusable, lens)
    return ElementalSet(
        session,
        settings,
        fitted.model,
        flat=flat,
        unusable=fitted.unusable,
        poses="nominal",
    )


def _with_poses(planned: ElementalSet, path: Path | None, lens_source: str) -> tuple[ElementalSet, str]:
    """Return the set at measured poses if there are any for all of its nodes, and which poses it has."""
    if path is None:
        return planned, f"nominal, as the stage is told; {lens_source}"
    try:
        return with_measured_geometry(planned, path), f"measured, of {path}"
    except BadValue as failure:
        return planned, f"nominal, as the stage is told, because {failure}"
