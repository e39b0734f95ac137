"""The capture's side of live planes: the messages to and from the process that computes them, and its pictures.

The process sends states and pictures, which are pairs of a name and a PNG.
"""

import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Literal

from msgspec import Struct

from faintfield.pipelines.live.side_process import SideProcess, running

type PictureKind = Literal["view", "mean", "pmlem"]

# Most planes: each takes about 40 MB.
MAX_DEPTHS = 32


class LiveOrder(Struct, frozen=True):
    """Request for live planes: the first message to their process.

    Without `noise` and `geometry`, results of `faintfield noise` and `faintfield geometry` are taken from the session
    or from beside its rig.toml; the focal length is for the case that no geometry.json is found.
    """

    session: Path
    rig: Path
    depths_mm: tuple[float, ...]
    noise: Path | None = None
    geometry: Path | None = None
    fx_px: float | None = None


class LiveFrame(Struct, frozen=True):
    """A valid frame of the dark scene; `intent` is the number of its exposure, which no other frame has."""

    intent: int
    file: str
    node: tuple[int, int]
    exposure_s: float
    round: int = 0


class BoardPoses(Struct, frozen=True):
    """Measured poses of the session's boards, a geometry.json, or why there are none; neither while there may be."""

    path: Path | None = None
    refusal: str = ""


NO_POSES = BoardPoses()


class LiveNews(Struct, frozen=True):
    """All valid frames of the dark scene, the index of the depth that the page shows, and poses: further messages."""

    frames: tuple[LiveFrame, ...]
    depth: int
    poses: BoardPoses = NO_POSES


class PictureStatus(Struct, frozen=True):
    """A picture that is there: from how many nodes and rounds, and the electrons per pixel that are black and white.

    Electrons are those of one round.
    """

    version: int
    nodes: int
    black: float
    white: float
    rounds: int = 1


class PlaneStatus(Struct, frozen=True):
    """One depth: its pictures, and the power of the detail that two halves of the views agree on, with its σ."""

    depth_mm: float
    pictures: dict[str, PictureStatus] = {}
    focus: float = 0.0
    focus_sigma: float = 0.0


class LiveStatus(Struct, frozen=True):
    """State of the live planes, as the page shows it.

    `frames` and `nodes` are those added up so far, `poses` and `noise` name kinds and sources, `pmlem` is the progress
    of PMLEM or why it is left out, `bins` are so many pixels wide, and the nodes `with_picture` have one of their
    latest frame. `planes` are in the order of `LiveOrder`.
    """

    doing: str
    frames: int = 0
    nodes: int = 0
    planned_nodes: int = 0
    poses: str = ""
    noise: str = ""
    pmlem: str = ""
    unit: str = "e⁻/px"
    bins: int = 1
    planes: tuple[PlaneStatus, ...] = ()
    with_picture: tuple[tuple[int, int], ...] = ()
    problems: tuple[str, ...] = ()


class PlanesClient(SideProcess):
    """Live planes, as the capture and its page see them; `frames`, called in another thread, returns the valid ones.

    `status` is the latest state of the process; None before the first. `poses` returns the poses that boards gave.
    """

    def __init__(
        self,
        order: LiveOrder,
        frames: Callable[[], tuple[LiveFrame, ...]],
        poses: Callable[[], BoardPoses] = lambda: NO_POSES,
    ) -> None:
        self.status: LiveStatus | None = None
        self._frames, self._poses = frames, poses
        self._pictures: dict[str, bytes] = {}
        self._depth = 0
        super().__init__("planes_process", "live planes", order)

    def news(self) -> LiveNews:
        """Return the valid frames, the depth that the page shows, and the poses that boards gave."""
        return LiveNews(self._frames(), self._depth, self._poses())

    def receive(self, message: LiveStatus | tuple[str, bytes]) -> None:
        """Take a state or a picture."""
        if isinstance(message, LiveStatus):
            self.status = message
        else:
            name, png = message
            self._pictures[name] = png

    def frame_count(self) -> int:
        """Return the number of valid frames of the dark scene."""
        return len(self._frames())

    def picture(self, name: str) -> bytes | None:
        """Return a picture as PNG, None if there is none of that name; its plane is computed first from now on."""
        match = re.match(r"plane_(\d{3})_", name)
        if match is not None and int(match[1]) != self._depth:
            self._depth = int(match[1])
            self._changed.set()
        return self._pictures.get(name)


def live_planes(
    order: LiveOrder, frames: Callable[[], tuple[LiveFrame, ...]], poses: Callable[[], BoardPoses] = lambda: NO_POSES
) -> AbstractContextManager[PlanesClient | None]:
    """Compute live planes while the block runs; None if that fails to begin, which is said and harms nothing else."""
    return running(lambda: PlanesClient(order, frames, poses), "live planes")
