"""Plan a capture: its grid, all positions and all frames, computed once, before anything moves."""

from collections import Counter
from collections.abc import Sequence
from itertools import product
from typing import Literal

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from faintfield.rig.stages.motion import one_sided_path, path_duration_s
from faintfield.rig.stages.protocol import MotionLimits, Point


def grid_nodes(rows: int, columns: int) -> list[tuple[int, int]]:
    """Return the nodes (row, column) in raster order; row 0 is the top, column 0 the left."""
    return [(row, column) for row in range(rows) for column in range(columns)]


def centre_node(rows: int, columns: int) -> tuple[int, int]:
    """Return the node of the reference camera; of two in the middle, the lower or right one."""
    return rows // 2, columns // 2


def nominal_poses_rt_cam_ref(rows: int, columns: int, pitch_mm: float) -> NDArray[np.float64]:
    """Return the poses (view, 6) of a perfect grid; a camera moved by c right and down shifts points by −c."""
    row_0, column_0 = centre_node(rows, columns)
    poses = np.zeros((rows * columns, 6))
    for view, (row, column) in enumerate(grid_nodes(rows, columns)):
        poses[view, 3:5] = (column_0 - column) * pitch_mm, (row_0 - row) * pitch_mm
    return poses


type Order = Literal["serpentine", "raster"]
type StepKind = Literal["charuco", "bright", "dark_scene", "noise_reference", "dark", "flat"]

# A plan has at most this many frames: their names give the number five digits.
MAX_FRAMES = 100_000
# No exposure is longer: a day, and more.
MAX_EXPOSURE_S = 100_000.0
# No quantity of a rig is larger, and computing with numbers up to it does not overflow.
MAX_NUMBER = 1e12
# Time in s to verify that the stage has arrived: two status reports, and a motion that takes longer than predicted.
_ARRIVAL_S = 0.15


class Grid(Struct, frozen=True, forbid_unknown_fields=True):
    """Grid of camera positions (nodes): columns along the first axis of the stage, rows along the second.

    Parameters
    ----------
    rows, columns : int
        Number of rows and of columns.
    pitch_mm : float
        Distance of neighbouring nodes along both axes.
    origin_mm : Point
        Position of node (0, 0) in the machine coordinates of the stage.
    order : {"serpentine", "raster"}
        "serpentine" reverses every second row, "raster" begins every row at column 0.

    Raises
    ------
    ValueError
        There is no row or column, the pitch is not positive, or there are more than 100 000 nodes.

    Examples
    --------
    >>> from faintfield import Grid, Point
    >>> grid = Grid(rows=2, columns=3, pitch_mm=50.0, origin_mm=Point(-250.0, -250.0))
    >>> [stop.node for stop in grid.stops()]
    [(0, 0), (0, 1), (0, 2), (1, 2), (1, 1), (1, 0)]
    >>> print(grid.position(row=1, column=2))
    (-150.000, -200.000) mm
    """

    rows: int
    columns: int
    pitch_mm: float
    origin_mm: Point
    order: Order = "serpentine"

    def __post_init__(self) -> None:
        nodes = self.rows * self.columns
        if min(self.rows, self.columns) < 1 or not self.pitch_mm > 0.0:
            size = f"{self.rows} x {self.columns} at {self.pitch_mm:g} mm"
            raise ValueError(f"a grid has at least one row and column and a positive pitch; got {size}")
        if nodes > MAX_FRAMES:
            raise ValueError(f"a grid of {nodes} nodes, at most {MAX_FRAMES} are possible; take fewer rows or columns")

    def position(self, row: int, column: int) -> Point:
        """Return the position of a node."""
        x_mm, y_mm = self.origin_mm
        return Point(x_mm + column * self.pitch_mm, y_mm + row * self.pitch_mm)

    def stops(self) -> "tuple[Stop, ...]":
        """Return the nodes in the order in which they are visited."""
        columns = range(self.columns)
        return tuple(
            Stop((row, column), self.position(row, column))
            for row in range(self.rows)
            for column in (reversed(columns) if self.order == "serpentine" and row % 2 else columns)
        )

    def centre(self) -> "Stop":
        """Return the centre node, whose camera is the reference frame."""
        node = centre_node(self.rows, self.columns)
        return Stop(node, self.position(*node))


class Stop(Struct, frozen=True, forbid_unknown_fields=True):
    """A node and its position.

    Attributes
    ----------
    node : (int, int)
        Row and column of the node.
    target : Point
        Position of the stage.
    """

    node: tuple[int, int]
    target: Point

    def __post_init__(self) -> None:
        if not all(0 <= index < MAX_FRAMES for index in self.node):
            raise ValueError(f"a node has a row and a column from 0 to {MAX_FRAMES - 1}; got {self.node}")


class Until(Struct, frozen=True, forbid_unknown_fields=True):
    """End of a step in rounds.

    Parameters
    ----------
    sigma_e : float
        Noise to reach: the standard deviation of a sample, as wide as a pixel, of the unpenalised estimate, in
        electrons of one frame of the step's first exposure.
    at_most_rounds : int
        Largest number of rounds.
    """

    sigma_e: float
    at_most_rounds: int

    def __post_init__(self) -> None:
        if not 0.0 < self.sigma_e < MAX_NUMBER:
            raise ValueError(f"until.sigma_e = {self.sigma_e:g}; a noise in electrons is positive")
        if not 1 <= self.at_most_rounds <= MAX_FRAMES:
            raise ValueError(f"until.at_most_rounds = {self.at_most_rounds}; give 1 to {MAX_FRAMES} rounds")


class CaptureStep(Struct, frozen=True, forbid_unknown_fields=True):
    """One step of the experiment: the same exposures at every node, or at the centre node only.

    Parameters
    ----------
    kind : {"charuco", "bright", "dark_scene", "noise_reference", "dark", "flat"}
        "charuco" shows boards, "bright" and "dark_scene" the scene in light and in the dark, "noise_reference" no light
        at all; "dark" and "flat" are for the noise, with the lens covered and evenly lit.
    exposure_s : tuple of float
        Exposure times, in the order in which they are taken at each stop.
    frames_per_node : int
        Number of frames of each exposure time at each stop.
    at : {"grid", "centre"}
        All nodes, or the centre node only.
    lights : tuple of str, optional
        Names of the lights that are on, while all others are off. By default a person switches the light.
    until : Until, optional
        End of a step in rounds, which repeat the whole grid; for "dark_scene" at the grid.

    Raises
    ------
    ValueError
        There is no exposure time, one is not above 0 s or longer than 100 000 s, there is no frame, or `until` is
        given for another kind of step.

    Examples
    --------
    Eight dark frames of each of three exposure times, at the centre node:

    >>> from faintfield import CaptureStep
    >>> step = CaptureStep("dark", exposure_s=(0.1, 1.0, 10.0), frames_per_node=8, at="centre")
    >>> step.frames_per_stop()
    24
    """

    kind: StepKind
    exposure_s: tuple[float, ...]
    frames_per_node: int = 1
    at: Literal["grid", "centre"] = "grid"
    lights: tuple[str, ...] | None = None
    until: Until | None = None

    def __post_init__(self) -> None:
        if self.until is not None and (self.kind, self.at) != ("dark_scene", "grid"):
            raise ValueError(f"until in a {self.kind} step at the {self.at}; only dark_scene steps at the grid have it")
        if not self.exposure_s or not all(time_s > 0.0 for time_s in self.exposure_s) or self.frames_per_node < 1:
            raise ValueError(f"a step needs exposure times above 0 s and at least one frame; got {self}")
        if max(self.exposure_s) > MAX_EXPOSURE_S:
            raise ValueError(f"exposure_s = {max(self.exposure_s):g}; an exposure lasts {MAX_EXPOSURE_S:g} s at most")

    @property
    def rounds(self) -> int:
        """Number of times that all stops are visited, at most."""
        return 1 if self.until is None else self.until.at_most_rounds

    def frames_per_stop(self) -> int:
        """Return the number of frames at each stop in one round."""
        return len(self.exposure_s) * self.frames_per_node


class CapturePlan(Struct, frozen=True, forbid_unknown_fields=True):
    """Plan of a whole capture. It does not change once it is made.

    `CapturePlan.of` makes it from a `Grid` and its steps.

    Parameters
    ----------
    stops : tuple of Stop
        Nodes and their positions, in the order in which they are visited.
    centre : Stop
        The centre node, which is the only stop of some steps.
    steps : tuple of CaptureStep
        The steps in order.
    approach_mm : float
        Distance below a position at which an axis turns, so that it arrives from below.
    frame_bytes : int
        Size of a frame on disk.
    settle_s : float
        Rest at each stop before the first exposure.
    readout_s : float
        Duration of a frame besides its exposure.

    Raises
    ------
    ValueError
        A distance, time or size is negative, or there are more than 100 000 frames.

    Examples
    --------
    >>> from faintfield import CapturePlan, CaptureStep, Grid, Point
    >>> grid = Grid(rows=7, columns=7, pitch_mm=50.0, origin_mm=Point(-350.0, -350.0))
    >>> dark_scene = CaptureStep("dark_scene", exposure_s=(0.1,))
    >>> darks = CaptureStep("dark", exposure_s=(0.1, 1.0, 10.0), frames_per_node=8, at="centre")
    >>> plan = CapturePlan.of(grid, [dark_scene, darks], approach_mm=2.0, frame_bytes=48_000_000)
    >>> plan.frame_count()
    73
    >>> round(plan.disk_bytes() / 1e9, 1)  # GB
    3.5
    """

    stops: tuple[Stop, ...]
    centre: Stop
    steps: tuple[CaptureStep, ...]
    approach_mm: float
    frame_bytes: int
    settle_s: float = 0.0
    readout_s: float = 0.0

    def __post_init__(self) -> None:
        if min(self.approach_mm, self.frame_bytes, self.settle_s, self.readout_s) < 0:
            raise ValueError("distances, times and sizes of a plan are not negative; correct them")
        check_frame_count(self.frame_count())

    @classmethod
    def of(cls, grid: Grid, steps: Sequence[CaptureStep], **rest: float) -> "CapturePlan":
        """Return the plan of `steps` over `grid`; `rest` holds the remaining parameters by name."""
        return msgspec.convert(
            {"stops": grid.stops(), "centre": grid.centre(), "steps": tuple(steps), **rest}, cls, from_attributes=True
        )

    def stops_of(self, step: CaptureStep) -> tuple[Stop, ...]:
        """Return the stops of `step` in order."""
        return self.stops if step.at == "grid" else (self.centre,)

    def frame_count(self) -> int:
        """Return the number of frames; of steps in rounds, the largest."""
        return sum(step.rounds * len(self.stops_of(step)) * step.frames_per_stop() for step in self.steps)

    def disk_bytes(self) -> int:
        """Return the size of all frames on disk."""
        return self.frame_count() * self.frame_bytes

    def wanted_room_bytes(self) -> int:
        """Return the free room on disk that a capture should have: frames taken again keep their earlier file."""
        return round(1.5 * self.disk_bytes())

    def path(self) -> tuple[Point, ...]:
        """Return all points of the stage's path in order, turning points included."""
        targets = [stop.target for step in self.steps for stop in self.stops_of(step) * step.rounds]
        points = targets[:1]
        for target in targets[1:]:
            if target != points[-1]:
                points.extend(one_sided_path(points[-1], target, self.approach_mm))
        return tuple(points)

    def duration_s(self, motion: MotionLimits, feed_mm_per_s: float) -> float:
        """Return the longest duration without prompts, from the controller's rates and accelerations."""
        total_s = path_duration_s(self.path(), motion, feed_mm_per_s)
        for step in self.steps:
            exposing_s = step.frames_per_node * sum(step.exposure_s) + step.frames_per_stop() * self.readout_s
            total_s += step.rounds * len(self.stops_of(step)) * (_ARRIVAL_S + self.settle_s + exposing_s)
            if step.lights:  # a frame with all lights off, see `rig.capture.lighting`
                total_s += sum(step.exposure_s) + len(step.exposure_s) * self.readout_s
        return total_s


def check_frame_count(count: int) -> None:
    """Raise `ValueError` for a plan with too many frames; call it before they are listed."""
    if count > MAX_FRAMES:
        raise ValueError(f"the plan has {count} frames, at most {MAX_FRAMES} are possible; take fewer at a node")


class PlannedFrame(Struct, frozen=True):
    """One frame that the plan asks for.

    Attributes
    ----------
    number, step : int
        Index of the frame in the plan; index of its step.
    kind : {"charuco", "bright", "dark_scene", "noise_reference", "dark", "flat"}
        Kind of the step.
    sweep : int
        Number of earlier steps of the same kind: the sweep of a board, the light level of a flat.
    stop : Stop
        Node at which it is taken.
    exposure_s : float
        Exposure time.
    repeat : int
        Index among the frames of the same exposure time at the same stop, in all rounds.
    round : int
        Index of the round over the grid.
    """

    number: int
    step: int
    kind: StepKind
    sweep: int
    stop: Stop
    exposure_s: float
    repeat: int
    round: int = 0

    @property
    def name(self) -> str:
        """Name of the frame in messages, and the beginning of its file name."""
        row, column = self.stop.node
        return f"{self.number:05d}_{self.kind}_{self.sweep}_r{row}_c{column}"


def planned_frames(plan: CapturePlan) -> tuple[PlannedFrame, ...]:
    """Return all frames of `plan`, in order."""
    frames: list[PlannedFrame] = []
    seen: Counter[StepKind] = Counter()
    for index, step in enumerate(plan.steps):
        repeats = range(step.frames_per_node)
        places = product(range(step.rounds), plan.stops_of(step), step.exposure_s, repeats)
        for of_round, stop, exposure_s, repeat in places:
            number, repeat_of_all = len(frames), of_round * step.frames_per_node + repeat
            frame = PlannedFrame(number, index, step.kind, seen[step.kind], stop, exposure_s, repeat_of_all, of_round)
            frames.append(frame)
        seen[step.kind] += 1
    return tuple(frames)
