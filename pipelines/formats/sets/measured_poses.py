"""A set with the lens and the poses that `faintfield geometry` measured, instead of those stated or told the stage."""

from dataclasses import replace
from pathlib import Path

import msgspec

from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.results.geometry import GEOMETRY_FILE, read_geometry
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet


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
