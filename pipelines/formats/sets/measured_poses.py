"""A set whose lens and poses are those that were measured, not those that the stage was told.

Reading what was measured needs none of the calibration, which is heavy to load.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from faintfield.calib.lens import Lens
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet

GEOMETRY_FILE = "geometry.json"
COVARIANCE_FILE = "geometry_covariance.npz"
CORNERS_FILE = "geometry_corners.npz"
GEOMETRY_PAGE = "geometry.html"
CAMERA_FILE = "cameras/node_r{}_c{}.cameramodel"


def files_beside(content: dict[str, Any]) -> list[str]:
    """Return the names of the files that lie beside a geometry.json, from what it says."""
    cameras = [CAMERA_FILE.format(*entry["node"]) for entry in content["nodes"]]
    return [COVARIANCE_FILE, CORNERS_FILE, GEOMETRY_PAGE, *cameras]


class LensEntry(msgspec.Struct, frozen=True):
    """The `lens` of geometry.json."""

    model: str
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...]


class NodeEntry(msgspec.Struct, frozen=True):
    """One of the `nodes` of geometry.json."""

    node: tuple[int, int]
    rt_cam_ref: tuple[float, float, float, float, float, float]
    sigma_mm: float
    sigma_rad: float


class GeometryFile(msgspec.Struct, frozen=True):
    """What others read of geometry.json; the rest of it is for people."""

    lens: LensEntry
    size_px: tuple[int, int]
    nodes: list[NodeEntry]
    reference_node: tuple[int, int]

    def camera_lens(self) -> Lens:
        """Return the lens."""
        lens = self.lens
        return Lens(self.size_px, lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, lens.distortion)


def read_geometry(path: Path) -> GeometryFile:
    """Read geometry.json, or that of a folder.

    Raises
    ------
    MissingFile, BadValue
        There is none, or it is no result of `faintfield geometry`.
    """
    path = path / GEOMETRY_FILE if path.is_dir() else path
    if not path.is_file():
        raise MissingFile(f"{path}: no such file; run `faintfield geometry` on the board set first")
    try:
        geometry = msgspec.json.decode(path.read_bytes(), type=GeometryFile)
        geometry.camera_lens()
    except (msgspec.DecodeError, ValueError) as failure:
        raise BadValue(f"{path}: is not the result of `faintfield geometry` ({failure}); run that again") from failure
    return geometry


def with_measured_geometry(loaded: ElementalSet, path: Path) -> ElementalSet:
    """Return a set with the lens of a geometry.json and each view at its node's measured pose.

    Raises
    ------
    BadValue
        A view has no node, a node was not measured, the reference is another, or the image has another size.
    """
    path = path / GEOMETRY_FILE if path.is_dir() else path
    geometry = read_geometry(path)
    settings = loaded.settings
    if tuple(geometry.size_px) != tuple(settings.camera.size_px):
        raise BadValue(
            f"{path}: is of {geometry.size_px} px images, the set has {settings.camera.size_px}; use its own"
        )
    poses = {tuple(entry.node): entry.rt_cam_ref for entry in geometry.nodes}
    missing = [view.image for view in settings.view if view.node is None or tuple(view.node) not in poses]
    if missing:
        raise BadValue(
            f"{path}: has no pose for {len(missing)} of {len(settings.view)} views ({missing[0]} is the first); "
            "state the node of every view, and show a board at every node"
        )
    if settings.view[settings.reference_view].node != tuple(geometry.reference_node):
        raise BadValue(
            f"{path}: its reference is node {list(geometry.reference_node)}, the set's is "
            f"{settings.view[settings.reference_view].node}; set reference_view to the view of that node"
        )
    lens = geometry.camera_lens()
    camera = msgspec.structs.replace(
        settings.camera,
        fx_px=lens.fx_px,
        fy_px=lens.fy_px,
        cx_px=lens.cx_px,
        cy_px=lens.cy_px,
        distortion=lens.distortion,
    )
    views = [
        msgspec.structs.replace(view, rt_cam_ref=poses[view.node], cx_px=None, cy_px=None)
        for view in settings.view
        if view.node is not None
    ]
    measured = msgspec.structs.replace(settings, camera=camera, view=views)
    return replace(loaded, settings=measured, lens=lens, measured_in=path, poses="measured")
