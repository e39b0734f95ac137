"""What will be captured: every position and every frame, laid down before anything moves and never computed again."""

from collections.abc import Sequence
from typing import Literal

import msgspec
from msgspec import Struct

from faintfield.rig.grid import centre_node
from faintfield.rig.stages.motion import one_sided, path_duration_s
from faintfield.rig.stages.protocol import MotionLimits, Point
from faintfield.rig.stages.workspace import StageWorkspace

type Order = Literal["serpentine", "raster"]
type StepKind = Literal["charuco", "bright", "dark_scene", "noise_reference", "dark", "flat"]

# Two status reports at five a second, and half a wait for the first.
_ARRIVAL_S = 0.3


class Grid(Struct, frozen=True, forbid_unknown_fields=True):
    """The nodes: columns along the stage's first axis, rows along its second.

    Parameters
    ----------
    rows, columns : int
        How many.
    pitch_mm : float
        Distance of neighbours, both ways.
    origin_mm : Point
        Where node (0, 0) is, in the stage's machine coordinates.
    order : str
        `serpentine` goes back and forth, `raster` begins every row at column 0.
    """

    rows: int
    columns: int
    pitch_mm: float
    origin_mm: Point
    order: Order = "serpentine"

    def __post_init__(self) -> None:
        if self.rows < 1 or self.columns < 1 or not self.pitch_mm > 0.0:
            raise ValueError(
                f"a grid has at least one row and column and a positive pitch; got {self.rows} x {self.columns} "
                f"at {self.pitch_mm:g} mm"
            )

    def position(self, row: int, column: int) -> Point:
        """Return where a node is."""
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
        row, column = centre_node(self.rows, self.columns)
        return Stop((row, column), self.position(row, column))


class Stop(Struct, frozen=True, forbid_unknown_fields=True):
    """A node and where it is."""

    node: tuple[int, int]
    target: Point


class Step(Struct, frozen=True, forbid_unknown_fields=True):
    """One step of the experiment: the same exposures at every stop, or at the centre alone.

    Parameters
    ----------
    kind : str
        What the frames are for.
    exposure_s : tuple of float
        Exposure times, one after the other at each stop.
    frames_per_node : int
        Frames of each exposure time.
    at : str
        `grid` or `centre`.
    """

    kind: StepKind
    exposure_s: tuple[float, ...]
    frames_per_node: int = 1
    at: Literal["grid", "centre"] = "grid"

    def __post_init__(self) -> None:
        if not self.exposure_s or min(self.exposure_s) <= 0.0 or self.frames_per_node < 1:
            raise ValueError(f"a step needs exposure times above 0 s and at least one frame; got {self}")


class CapturePlan(Struct, frozen=True, forbid_unknown_fields=True):
    """The whole capture, frozen.

    Parameters
    ----------
    stops : tuple of Stop
        The nodes in the order in which every step visits them.
    centre : Stop
        Where steps `at = "centre"` stand.
    steps : tuple of Step
        The steps in order.
    approach_mm : float
        How far past a position an axis goes before it arrives from below.
    frame_bytes : int
        Size of one frame on disk.
    settle_s : float
        Rest at each stop before the first exposure.
    readout_s : float
        Time of a frame besides its exposure.
    """

    stops: tuple[Stop, ...]
    centre: Stop
    steps: tuple[Step, ...]
    approach_mm: float
    frame_bytes: int
    settle_s: float = 0.0
    readout_s: float = 0.0

    @classmethod
    def of(cls, grid: Grid, steps: Sequence[Step], **rest: float) -> "CapturePlan":
        """Return the plan of `steps` over `grid`; `rest` are the remaining parameters."""
        return msgspec.convert(
            {"stops": grid.stops(), "centre": grid.centre(), "steps": tuple(steps), **rest}, cls, from_attributes=True
        )

    def stops_of(self, step: Step) -> tuple[Stop, ...]:
        """Return where `step` stops, in order."""
        return self.stops if step.at == "grid" else (self.centre,)

    def frames(self) -> int:
        """Return how many frames will be taken."""
        return sum(len(self.stops_of(s)) * len(s.exposure_s) * s.frames_per_node for s in self.steps)

    def disk_bytes(self) -> int:
        """Return how much room the frames need."""
        return self.frames() * self.frame_bytes

    def path(self, start: Point | None = None) -> tuple[Point, ...]:
        """Return every point that the stage goes through, turning points included, from `start` if it is known."""
        targets = [stop.target for step in self.steps for stop in self.stops_of(step)]
        points = [targets.pop(0) if start is None else start] if targets else []
        for target in targets:
            if target != points[-1]:
                points.extend(one_sided(points[-1], target, self.approach_mm))
        return tuple(points)

    def check(self, workspace: StageWorkspace, start: Point | None = None) -> None:
        """Refuse the plan if any of its positions, or the way between two, is not allowed.

        Raises
        ------
        OutsideTravel, KeepOutCrossed
            Before anything moves.
        """
        workspace.check_path(self.path(start))

    def duration_s(self, motion: MotionLimits, feed_mm_per_s: float, start: Point | None = None) -> float:
        """Return how long the capture will take, by the controller's own rates and accelerations, prompts aside."""
        stops = sum(len(self.stops_of(step)) for step in self.steps)
        exposing_s = sum(
            len(self.stops_of(s)) * s.frames_per_node * (sum(s.exposure_s) + len(s.exposure_s) * self.readout_s)
            for s in self.steps
        )
        moving_s = path_duration_s(self.path(start), motion, feed_mm_per_s)
        return moving_s + stops * (_ARRIVAL_S + self.settle_s) + exposing_s
