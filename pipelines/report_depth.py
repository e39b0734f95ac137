"""What a report shows of a sweep's depth map."""

from pathlib import Path
from typing import Any

from pipelines.pages import data_uri


def depth_section(folder: Path, found: dict[str, Any]) -> dict[str, Any]:
    """Return what the page shows of a sweep's depth map: its pictures, where they are still there."""
    pictures = {
        key: data_uri(path.read_bytes(), ".png")
        if (path := (folder / Path(found[key]).name).with_suffix(".png")).is_file()
        else None
        for key in ("all_in_focus", "file", "confidence")
    }
    return {**found, "pictures": pictures}
