"""Poses of a set by its views, from the geometry.json that `faintfield align` wrote."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.files import sha256
from faintfield.pipelines.formats.reading import is_file
from faintfield.pipelines.formats.results.geometry import (
    ALIGNMENT_FOLDER,
    GEOMETRY_FILE,
    CameraPoses,
    PosesOfSession,
    read_geometry,
)
from faintfield.pipelines.formats.units import Node

if TYPE_CHECKING:
    from faintfield.pipelines.formats.sets.elemental_set import ElementalSet


def with_alignment(elemental_set: "ElementalSet", *sources: str) -> "ElementalSet":
    """Return a set at the poses that `faintfield align` found in its own folder; as it is if there are none.

    `sources` are files that state the poses from which the alignment started: it holds as long as they do.
    """
    path = alignment_of(elemental_set.folder, [view.image for view in elemental_set.settings.view], sources)
    if path is None:
        return elemental_set
    inform(f"poses by the views: {path}")
    return with_poses_of_views(elemental_set, path)


def alignment_of(folder: Path, images: Sequence[str], sources: Sequence[str]) -> Path | None:
    """Return the geometry.json of an alignment of these images, None if there is none, or it is of other `sources`."""
    path = folder / ALIGNMENT_FOLDER / GEOMETRY_FILE
    if not is_file(path):
        return None
    inputs = read_geometry(path, PosesOfSession).inputs
    if not set(images) <= set(inputs):  # those of another scene of the session
        return None
    if changed := [name for name in sources if inputs.get(name) != sha256(folder / name)]:
        inform(f"{path}: is not used, as {changed[0]} has changed since; run `faintfield align {folder}` again")
        return None
    return path


def with_poses_of_views(elemental_set: "ElementalSet", path: Path) -> "ElementalSet":
    """Return a set at the poses of a geometry.json that were found by the views; BadValue if it does not fit.

    The poses include what homings shifted.
    """
    geometry, settings = read_geometry(path, CameraPoses), elemental_set.settings
    check_match(path, geometry, elemental_set, elemental_set.nodes)
    poses = {entry.node: entry.rt_cam_ref for entry in geometry.nodes}
    views = [
        msgspec.structs.replace(view, rt_cam_ref=poses[node])
        for view, node in zip(settings.view, elemental_set.nodes, strict=True)
    ]
    aligned = msgspec.structs.replace(settings, view=views, camera=settings.camera.with_lens(geometry.camera_lens()))
    sigma = geometry.inverse_depth_sigma or 0.0
    return replace(elemental_set, settings=aligned, measured_in=path, poses="aligned", inverse_depth_sigma=sigma)


def check_match(path: Path, geometry: CameraPoses, elemental_set: "ElementalSet", nodes: Sequence[Node | None]) -> None:
    """Refuse a geometry.json of other images, or without the nodes (view,) of a set (BadValue)."""
    settings, known = elemental_set.settings, {entry.node for entry in geometry.nodes}
    if geometry.size_px != settings.camera.size_px:
        raise BadValue(
            f"{path}: is of {geometry.size_px} px images, the set has {settings.camera.size_px}; use its own"
        )
    missing = [view.image for view, node in zip(settings.view, nodes, strict=True) if node not in known]
    if missing:
        raise BadValue(
            f"{path}: has no pose for {len(missing)} of {len(settings.view)} views ({missing[0]} is the first); "
            "state the node of every view, and show a board at every node"
        )
    reference = nodes[settings.reference_view]
    if reference != geometry.reference_node:
        raise BadValue(
            f"{path}: its reference is node {list(geometry.reference_node)}, the set's is {reference}; "
            "set reference_view to the view of that node"
        )
