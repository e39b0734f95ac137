"""The rig.toml that `faintfield init` writes, with few nodes, pixels and frames, and the geometry of a grid."""

from pathlib import Path

import msgspec

from faintfield.pipelines import cli
from faintfield.pipelines.formats.results.geometry import CameraPoses, LensRecord, NodeRecord
from faintfield.rig.plan import Grid, nominal_poses_rt_cam_ref


def write_small_rig(path: Path, rows: int = 1, columns: int = 2, frames: int = 1) -> Path:
    """Write a rig.toml of a small simulated rig, and return its path."""
    assert cli.run(["init", str(path)]) == 0
    text = path.read_text()
    for old, new in (
        ("size_px = [640, 480]", "size_px = [64, 48]"),
        ("rows = 7\ncolumns = 7", f"rows = {rows}\ncolumns = {columns}"),
        ("frames_per_node = 10", f"frames_per_node = {frames}"),
    ):
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path


def write_geometry(folder: Path, grid: Grid, lens: LensRecord, size_px: tuple[int, int]) -> Path:
    """Write a geometry.json with the nominal poses of a grid, and return its path."""
    poses = nominal_poses_rt_cam_ref(grid.rows, grid.columns, grid.pitch_mm).tolist()
    nodes = [NodeRecord(divmod(view, grid.columns), tuple(pose), 0.0, 0.0) for view, pose in enumerate(poses)]
    geometry = CameraPoses(lens=lens, size_px=size_px, reference_node=grid.centre().node, nodes=nodes)
    folder.mkdir(exist_ok=True)
    (folder / "geometry.json").write_bytes(msgspec.json.encode(geometry))
    return folder / "geometry.json"
