"""The page that shows the paper's figures with their numbers."""

from pathlib import Path

import msgspec

from faintfield.pipelines.formats.files import write_whole
from faintfield.pipelines.pages.page import data_uri, template
from faintfield.pipelines.paper.figure4 import PAPERS_AXIS
from faintfield.pipelines.paper.figure_methods import METHODS, OURS
from faintfield.pipelines.paper.figure_records import ErrorPoint, Figure2, Figure3, Figure4Curves

PAGE_FILE = "figures.html"
CURVES_FILE = "figure4_curves.json"

# By the number of a figure, the type of its JSON file.
_KINDS = {2: Figure2, 3: Figure3, 4: list[ErrorPoint]}


class _Origin(msgspec.Struct):
    """What the page shows of a figure's provenance."""

    options: dict[str, object]
    versions: dict[str, str]
    wall_time_s: float


class _FoundFigure(msgspec.Struct):
    """A figure that lies in the folder."""

    src: str
    numbers: object
    provenance: _Origin


def provenance_file(number: int) -> str:
    """Return the name of a figure's provenance, which is written last: it says that the figure is whole."""
    return f"figure{number}_provenance.json"


def write_page(folder: Path) -> Path:
    """Write figures.html of the figures that are in a folder, and return its path."""
    found = {number: _read(folder, number) for number in _KINDS if (folder / provenance_file(number)).is_file()}
    curves = None
    if 4 in found:
        curves = msgspec.json.decode((folder / CURVES_FILE).read_bytes(), type=Figure4Curves)
    page = template(PAGE_FILE).render(
        found=found,
        curves=curves,
        methods=[method for method in METHODS if curves is None or method.name in curves.monotone],
        ours=OURS,
        papers_axis=PAPERS_AXIS,
    )
    path = folder / PAGE_FILE
    write_whole(path, page)
    return path


def _read(folder: Path, number: int) -> _FoundFigure:
    """Return a figure's picture, numbers and origin."""
    return _FoundFigure(
        src=data_uri((folder / f"figure{number}.png").read_bytes(), ".png"),
        numbers=msgspec.json.decode((folder / f"figure{number}.json").read_bytes(), type=_KINDS[number]),
        provenance=msgspec.json.decode((folder / provenance_file(number)).read_bytes(), type=_Origin),
    )
