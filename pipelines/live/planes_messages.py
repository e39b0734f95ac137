"""Messages between the capture and the process of live planes, whose pictures are pairs of a name and a PNG."""

from pathlib import Path
from typing import Literal, get_args

from msgspec import Struct

type PictureKind = Literal["view", "mean", "pmlem"]

PICTURE_KINDS: tuple[PictureKind, ...] = get_args(PictureKind.__value__)

# Most planes: each takes about 40 MB.
MAX_DEPTHS = 32


class LiveOrder(Struct, frozen=True):
    """Request for live planes: the first message to their process.

    Parameters
    ----------
    session, rig : Path
        Folder of the session, and its rig.toml.
    depths_mm : tuple of float
        Depths of the planes.
    noise, geometry : Path, optional
        Results of `faintfield noise` and `faintfield geometry`; by default those in the session or beside rig.toml.
    fx_px : float, optional
        Focal length in pixels, where no geometry.json is found.
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


class LiveNews(Struct, frozen=True):
    """All valid frames of the dark scene now, and the index of the depth that the page shows: every further message."""

    frames: tuple[LiveFrame, ...]
    depth: int


class PictureStatus(Struct, frozen=True):
    """A picture that is there: from how many nodes, and the electrons per pixel that are black and white in it."""

    version: int
    nodes: int
    black: float
    white: float


class PlaneStatus(Struct, frozen=True):
    """One depth: its pictures, and the power of the detail that two halves of the views agree on, with its σ."""

    depth_mm: float
    pictures: dict[str, PictureStatus] = {}
    focus: float = 0.0
    focus_sigma: float = 0.0


class LiveStatus(Struct, frozen=True):
    """State of the live planes.

    Parameters
    ----------
    doing, pmlem : str
        Present work, and progress of PMLEM or the reason for leaving it out.
    frames, nodes, planned_nodes : int
        Frames added up so far, their nodes, and all nodes of the dark scene.
    poses, noise : str
        Their kinds and sources.
    bins : int
        Width in pixels of the bins that are added up before anything else.
    planes : tuple of PlaneStatus
        The depths, in the order of `LiveOrder`.
    with_picture : tuple of (int, int)
        Nodes whose latest frame is there as a picture.
    problems : tuple of str
        Failures of calibrations and frames.
    seconds_per_plane : float
        Time to add one view to one plane, mean of all so far.
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
    seconds_per_plane: float = 0.0
