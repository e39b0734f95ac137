"""Messages from the capture to the process of live planes, and from there to the page."""

import re
from typing import Literal, get_args

from msgspec import Struct

type PictureKind = Literal["view", "mean", "pmlem"]

PICTURE_KINDS: tuple[PictureKind, ...] = get_args(PictureKind.__value__)

# State of the live planes, in their folder.
STATUS_FILE = "status.json"

# Most planes: each takes about 40 MB.
MAX_DEPTHS = 32

_PICTURE_NAME = re.compile(r"plane_(\d{3})_(?:view|mean|pmlem)\.png|node_r\d{1,6}_c\d{1,6}\.png")


class LiveOrder(Struct, frozen=True, forbid_unknown_fields=True):
    """Request for live planes: the first line that their process reads.

    Parameters
    ----------
    out : str
        Folder for pictures and status, outside of the session.
    session, rig : str
        Folder of the session, and its rig.toml.
    depths_mm : tuple of float
        Depths of the planes.
    noise, geometry : str, optional
        Results of `faintfield noise` and `faintfield geometry`; by default those in the session or beside rig.toml.
    fx_px : float, optional
        Focal length in pixels, where no geometry.json is found.
    """

    out: str
    session: str
    rig: str
    depths_mm: tuple[float, ...]
    noise: str | None = None
    geometry: str | None = None
    fx_px: float | None = None


class LiveFrame(Struct, frozen=True, forbid_unknown_fields=True):
    """A valid frame of the dark scene; `intent` is the number of its exposure, which no other frame has."""

    intent: int
    file: str
    node: tuple[int, int]
    exposure_s: float


class LiveNews(Struct, frozen=True, forbid_unknown_fields=True):
    """All valid frames of the dark scene now, and the index of the depth that the page shows: every further line."""

    frames: tuple[LiveFrame, ...]
    depth: int


class PictureStatus(Struct, frozen=True, forbid_unknown_fields=True):
    """A picture that is there: from how many nodes, and the electrons per pixel that are black and white in it."""

    version: int
    nodes: int
    black: float
    white: float


class PlaneStatus(Struct, frozen=True, forbid_unknown_fields=True):
    """One depth: its pictures, and the power of the detail that two halves of the views agree on, with its σ."""

    depth_mm: float
    pictures: dict[str, PictureStatus] = {}
    focus: float = 0.0
    focus_sigma: float = 0.0


class LiveStatus(Struct, frozen=True, forbid_unknown_fields=True):
    """State of the live planes.

    Parameters
    ----------
    doing : str
        What their process does now.
    frames, nodes, planned_nodes : int
        Frames added up so far, nodes that they are of, and all nodes of the dark scene.
    poses, noise : str
        Which are used, and where they are from.
    pmlem : str
        Up to how many nodes PMLEM has come, or why it is left out.
    unit : str
        Unit of the pictures.
    bins : int
        Width in pixels of the bins that are added up before anything else.
    planes : tuple of PlaneStatus
        The depths, in the order of `LiveOrder`.
    with_picture : tuple of (int, int)
        Nodes whose latest frame is there as a picture.
    problems : tuple of str
        What is not as it should be.
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


def picture_name(plane: int, kind: PictureKind) -> str:
    """Return the name of a plane's picture."""
    return f"plane_{plane:03d}_{kind}.png"


def node_picture_name(node: tuple[int, int]) -> str:
    """Return the name of the picture of a node's latest frame."""
    return f"node_r{node[0]}_c{node[1]}.png"


def is_picture_name(name: str) -> bool:
    """Return whether a name is one that `picture_name` or `node_picture_name` gives."""
    return name.isascii() and _PICTURE_NAME.fullmatch(name) is not None


def plane_of(name: str) -> int | None:
    """Return the index of the plane that a picture shows, None if it shows a node."""
    found = _PICTURE_NAME.fullmatch(name)
    return int(found[1]) if found is not None and found[1] is not None else None
