"""ChArUco boards as a PDF to print: vectors, true to size, a page per board."""

from dataclasses import asdict
from pathlib import Path

import msgspec

from faintfield.calib.board import Board, black_rectangles_mm
from faintfield.pipelines.arguments import PaperName
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.files import write_whole
from faintfield.rig.settings import BoardSettings

# Width and height, the long side across.
_PAPERS_MM = {"A4": (297.0, 210.0), "A3": (420.0, 297.0), "A2": (594.0, 420.0), "letter": (279.4, 215.9)}

# Edge of a marker over that of its square.
_MARKER_SHARE = 0.74

_POINTS_PER_MM = 72 / 25.4

# Printers leave this much white at each edge; the foot holds the scale bar and the words beneath a board.
_MARGIN_MM, _FOOT_MM = 10.0, 14.0
_SCALE_BAR_MM = 100.0


class BoardSheets(msgspec.Struct, frozen=True):
    """The result of `faintfield board`: the file, its paper, and the entries for charuco.toml."""

    out: str
    paper: str
    board: list[BoardSettings]


def write_boards(
    out: Path,
    paper: PaperName,
    boards: int,
    columns: int | None,
    rows: int | None,
    square_mm: float,
    dictionary: str,
) -> BoardSheets:
    """Write boards as PDF, a page each; see `faintfield board`."""
    across, down = _squares(paper, columns, rows, square_mm)
    size_mm = _PAPERS_MM[paper]
    made = _boards(boards, across, down, square_mm, dictionary)
    write_whole(out, _document([_page(board, *size_mm) for board in made], size_mm))
    inform(f"{out}: {boards} board(s) of {across} x {down} squares; print at 100 % and measure the scale bar")
    entries = [BoardSettings(**asdict(each)) for each in made]
    return BoardSheets(str(out), paper, entries)


def _boards(count: int, across: int, down: int, square_mm: float, dictionary: str) -> list[Board]:
    marker_mm, markers = round(_MARKER_SHARE * square_mm, 1), across * down // 2
    try:
        return [
            Board(f"board-{index}", across, down, square_mm, marker_mm, dictionary, index * markers)
            for index in range(count)
        ]
    except ValueError as failure:
        raise WrongUsage(f"{failure}") from failure


def _squares(paper: str, columns: int | None, rows: int | None, square_mm: float) -> tuple[int, int]:
    """Return how many squares a board has across and down: as many as asked for, or as fit the paper."""
    width_mm, height_mm = _PAPERS_MM[paper]
    max_across = int((width_mm - 2 * _MARGIN_MM) // square_mm)
    max_down = int((height_mm - 2 * _MARGIN_MM - _FOOT_MM) // square_mm)
    across, down = columns or max_across, rows or max_down
    if across > max_across or down > max_down:
        raise WrongUsage(
            f"{across} x {down} squares of {square_mm:g} mm do not fit {paper}, which holds {max_across} x {max_down}; "
            "take fewer, smaller squares or larger paper"
        )
    return across, down


def _page(board: Board, width_mm: float, height_mm: float) -> str:
    """Return the drawing of one page in PDF's operators; y points up, the unit is the mm."""
    left = (width_mm - board.columns * board.square_mm) / 2
    top = height_mm - _MARGIN_MM
    lines = [f"{_POINTS_PER_MM:.9f} 0 0 {_POINTS_PER_MM:.9f} 0 0 cm", "0 g"]
    for x, y, across, down in black_rectangles_mm(board):
        lines.append(f"{left + x:.5f} {top - y - down:.5f} {across:.5f} {down:.5f} re")
    lines.append("f")
    lines += _scale_bar(_MARGIN_MM, _MARGIN_MM)
    entry = (
        f'[[board]] name = "{board.name}"  columns = {board.columns}  rows = {board.rows}  '
        f"square_mm = {board.square_mm:g}  marker_mm = {board.marker_mm:g}  "
        f'dictionary = "{board.dictionary}"  first_marker_id = {board.first_marker_id}'
    )
    lines.append(_text(_MARGIN_MM + _SCALE_BAR_MM + 8, _MARGIN_MM + 3.2, 2.6, entry))
    lines.append(_text(_MARGIN_MM + _SCALE_BAR_MM + 8, _MARGIN_MM - 0.8, 2.6, "Print at 100 %. If the bar is not "
                       f"{_SCALE_BAR_MM:g} mm long, correct square_mm and marker_mm in the same ratio."))  # fmt: skip
    return "\n".join(lines)


def _scale_bar(x_mm: float, y_mm: float) -> list[str]:
    """Return a bar of known length with a tick every 10 mm."""
    drawing = ["0.2 w", f"{x_mm:.3f} {y_mm:.3f} m {x_mm + _SCALE_BAR_MM:.3f} {y_mm:.3f} l S"]
    for tick in range(0, int(_SCALE_BAR_MM) + 1, 10):
        length = 3.0 if tick % 50 == 0 else 1.5
        drawing.append(f"{x_mm + tick:.3f} {y_mm:.3f} m {x_mm + tick:.3f} {y_mm + length:.3f} l S")
    return [*drawing, _text(x_mm + 1, y_mm + 4, 3.0, f"{_SCALE_BAR_MM:g} mm")]


def _text(x_mm: float, y_mm: float, size_mm: float, caption: str) -> str:
    escaped = caption.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
    return f"BT /F1 {size_mm:g} Tf {x_mm:.3f} {y_mm:.3f} Td ({escaped}) Tj ET"


def _document(pages: list[str], size_mm: tuple[float, float]) -> bytes:
    """Return a PDF: a catalogue, the list of pages, one font, then an object and a drawing for each page."""
    width, height = (f"{side * _POINTS_PER_MM:.5f}" for side in size_mm)
    kids = " ".join(f"{4 + 2 * index} 0 R" for index in range(len(pages)))
    objects = [
        "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        f"<< /Type /Pages /Kids [{kids}] /Count {len(pages)} >>",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    for index, drawing in enumerate(pages):
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width} {height}] /Contents {5 + 2 * index} 0 R "
            "/Resources << /Font << /F1 3 0 R >> >> >>"
        )
        objects.append(f"<< /Length {len(drawing)} >>\nstream\n{drawing}\nendstream")
    content, places = "%PDF-1.6\n", []
    for number, body in enumerate(objects, start=1):
        places.append(len(content))
        content += f"{number} 0 obj\n{body}\nendobj\n"
    table = "".join(f"{place:010d} 00000 n \n" for place in places)
    start = len(content)
    content += f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}"
    content += f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{start}\n%%EOF\n"
    return content.encode("ascii")
