"""What a report shows of a sweep's depth map."""

from pathlib import Path
from typing import Any

from faintfield.pipelines.pages.page import data_uri

_PICTURES = ("all_in_focus", "file", "confidence")


def depth_sections(directory: Path, results: dict[Path, dict[str, Any]]) -> list[dict[str, Any]]:
    """Return what the page shows of each depth map: what is recorded of it, and its pictures, where they are there."""
    sections = []
    for folder, result in results.items():
        if found := result.get("depth_map"):
            pictures = {key: _picture(folder / Path(found[key]).name) for key in _PICTURES}
            title = folder.relative_to(directory).as_posix()
            sections.append({**found, "title": title, "pictures": pictures})
    return sections


def _picture(path: Path) -> str | None:
    """Return the preview of a map."""
    preview = path.with_suffix(".png")
    return data_uri(preview.read_bytes(), ".png") if preview.is_file() else None
