"""Depth map in a report."""

from dataclasses import dataclass
from pathlib import Path

from faintfield.pipelines.formats.limits import MAX_PREVIEW_BYTES
from faintfield.pipelines.formats.reading import read_content
from faintfield.pipelines.formats.results.records import DepthMapRecord, ReconstructionRecord
from faintfield.pipelines.pages.page import data_uri


@dataclass(frozen=True)
class DepthSection:
    """A depth map with its pictures as data URIs; None if the file is missing."""

    title: str
    record: DepthMapRecord
    all_in_focus: str | None
    map: str | None
    confidence: str | None


def depth_sections(directory: Path, results: dict[Path, ReconstructionRecord]) -> list[DepthSection]:
    """Return what the page shows of each depth map."""
    return [
        DepthSection(
            folder.relative_to(directory).as_posix(),
            found,
            all_in_focus=_preview(folder / Path(found.all_in_focus).name),
            map=_preview(folder / Path(found.file).name),
            confidence=_preview(folder / Path(found.confidence).name),
        )
        for folder, result in results.items()
        if (found := result.depth_map)
    ]


def _preview(path: Path) -> str | None:
    """Return the preview of a map."""
    preview = path.with_suffix(".png")
    return data_uri(read_content(preview, MAX_PREVIEW_BYTES), ".png") if preview.is_file() else None
