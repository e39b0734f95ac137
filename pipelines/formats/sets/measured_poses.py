"""An elemental set with the lens and the poses that `faintfield geometry` measured."""

from dataclasses import replace
from pathlib import Path

import msgspec

from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.results.geometry import GEOMETRY_FILE, CameraPoses, read_geometry
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet


def with_measured_geometry(loaded: ElementalSet, path: Path) -> ElementalSet:
    """Return a set with the lens of a geometry.json and each view at its node's measured pose.

    Raises
    ------
    BadValue
        A view has no node, a node was not measured, the reference is another, or the image has another size.
    """
    path = path / GEOMETRY_FILE if path.is_dir() else path
    geometry, settings = read_geometry(path, CameraPoses), loaded.settings
    poses = {entry.node: entry.rt_cam_ref for entry in geometry.nodes}
    _check_match(path, geometry, loaded)
    lens = geometry.camera_lens()
    stated = ("fx_px", "fy_px", "cx_px", "cy_px", "distortion")
    camera = msgspec.structs.replace(settings.camera, **{name: getattr(lens, name) for name in stated})
    views = [
        msgspec.structs.replace(view, rt_cam_ref=poses[view.node], cx_px=None, cy_px=None)
        for view in settings.view
        if view.node is not None
    ]
    measured = msgspec.structs.replace(settings, camera=camera, view=views)
    return replace(loaded, settings=measured, lens=lens, measured_in=path, poses="measured")


def _check_match(path: Path, geometry: CameraPoses, loaded: ElementalSet) -> None:
    """Refuse a geometry of images of another size, of other nodes, or with another reference than the set."""
    settings, nodes = loaded.settings, {entry.node for entry in geometry.nodes}
    if geometry.size_px != settings.camera.size_px:
        raise BadValue(
            f"{path}: is of {geometry.size_px} px images, the set has {settings.camera.size_px}; use its own"
        )
    missing = [view.image for view in settings.view if view.node not in nodes]
    if missing:
        raise BadValue(
            f"{path}: has no pose for {len(missing)} of {len(settings.view)} views ({missing[0]} is the first); "
            "state the node of every view, and show a board at every node"
        )
    reference = settings.view[settings.reference_view].node
    if reference != geometry.reference_node:
        raise BadValue(
            f"{path}: its reference is node {list(geometry.reference_node)}, the set's is {reference}; "
            "set reference_view to the view of that node"
        )
