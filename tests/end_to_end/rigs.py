"""The rig.toml that `faintfield init` writes, with few nodes, pixels and frames."""

from pathlib import Path

from faintfield.pipelines import cli


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
