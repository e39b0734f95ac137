"""Progress of the board sweeps, and the messages to and from the process that follows them."""

from pathlib import Path

from msgspec import Struct


class BoardOrder(Struct, frozen=True):
    """Request to follow the board sweeps of a session: the first message to the process.

    The geometry that it solves in the end is written into the folder `out`. `depths_mm` are those of the planes,
    between whose views the transfer is to be known to `wanted_px`, by default the limit of `faintfield geometry`.
    """

    session: Path
    out: Path
    depths_mm: tuple[float, ...]
    wanted_px: float | None = None


class BoardFrame(Struct, frozen=True):
    """A valid frame of a board sweep: its number in the plan, that of its exposure, its file, and its homing."""

    number: int
    intent: int
    file: str
    homing: int


class BoardNews(Struct, frozen=True):
    """All valid frames of board sweeps now, and the numbers of those that were left out: every further message."""

    frames: tuple[BoardFrame, ...]
    skipped: tuple[int, ...] = ()


class SweepProgress(Struct, frozen=True):
    """A board in a sweep: distance of its middle and tilt if they are known, its corners, and the nodes that saw them.

    The tilt is against the detector, `direction` the edge that is turned away from the camera (left, right, up, down).
    """

    sweep: int
    board: str
    corners: int
    nodes: int
    distance_mm: float | None = None
    tilt_deg: float | None = None
    direction: str = ""


class FrameCorners(Struct, frozen=True):
    """Corners in a frame as column and row in pixels; the frame has its name in the plan, and its width and height."""

    frame: str
    size_px: tuple[int, int]
    points: tuple[tuple[float, float], ...]


class BoardVerdict(Struct, frozen=True):
    """Transfer error predicted for the end of the present sweep, in px at a depth, and what to do, in one sentence.

    The error is None while the lens is not known, and `reached` if it is no larger than wanted.
    """

    words: str
    error_px: float | None = None
    depth_mm: float | None = None
    reached: bool = False


class BoardProgress(Struct, frozen=True):
    """State of the board sweeps, as page and terminal show it.

    `frames` of the `planned` ones were searched; `cells` has the corners in each cell of the detector, 6 rows of 8;
    `covered` is the share of cells with corners. `after_sweep` is the last sweep, from 1, whose end the verdict knows;
    `poses` are the path of the geometry that was solved in the end, or why there is none.
    """

    doing: str
    frames: int = 0
    planned: int = 0
    wanted_px: float = 0.0
    sweeps: tuple[SweepProgress, ...] = ()
    cells: tuple[tuple[int, ...], ...] = ()
    covered: float = 0.0
    verdict: BoardVerdict | None = None
    after_sweep: int = 0
    last: FrameCorners | None = None
    geometry: str = ""
    refusal: str = ""
    problem: str = ""

    @property
    def poses(self) -> str:
        """Source of the nodes' poses in words: measured, or why not."""
        if self.geometry:
            return "measured, of the boards of this session"
        return (
            f"nominal, as the boards gave none: {self.refusal}" if self.refusal else "nominal until the boards are done"
        )
