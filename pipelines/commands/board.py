"""`faintfield board`: ChArUco boards to print, as vectors and true to size."""

from pathlib import Path
from typing import Any, Literal

from faintfield.calib.board import Board, black_rectangles_mm
from faintfield.pipelines.arguments import Count, Positive
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.files import write_whole
from faintfield.pipelines.formats.sets.board_set import BoardEntry

_POINTS_PER_MM = 72 / 25.4
_PAPERS_MM = {"A4": (297.0, 210.0), "A3": (420.0, 297.0), "A2": (594.0, 420.0), "letter": (279.4, 215.9)}

# What printers leave white, and room beneath for the scale bar and the words.
_MARGIN_MM, _FOOT_MM = 10.0, 14.0
_MARKER_SHARE = 0.74
_SCALE_BAR_MM = 100.0


def board(
    out: Path,
    /,
    *,
    paper: Literal["A4", "A3", "A2", "letter"] = "A3",
    boards: Count = 1,
    columns: Count | None = None,
    rows: Count | None = None,
    square_mm: Positive = 27.0,
    dictionary: str = "DICT_5X5_1000",
) -> dict[str, Any]:
    """Write ChArUco boards as PDF, a page each, that share no marker and can be in view together.

    Print at 100 % ("actual size"), measure the scale bar, glue the sheet to something flat and stiff. The [[board]]
    entries for charuco.toml are printed beneath each board.

    Parameters
    ----------
    out
        File to write.
    paper
        Its format, across.
    boards
        How many.
    columns
        Of squares; as many as fit by default.
    rows
        Of squares; as many as fit by default.
    square_mm
        Edge of a square.
    dictionary
        Of markers, one of OpenCV's.
    """
    width_mm, height_mm = _PAPERS_MM[paper]
    most = (
        int((width_mm - 2 * _MARGIN_MM) // square_mm),
        int((height_mm - 2 * _MARGIN_MM - _FOOT_MM) // square_mm),
    )
    across, down = columns or most[0], rows or most[1]
    if across > most[0] or down > most[1]:
        raise WrongUsage(
            f"{across} x {down} squares of {square_mm:g} mm do not fit {paper}, which holds {most[0]} x {most[1]}; "
            "take fewer, smaller squares or larger paper"
        )
    made = []
    for index in range(boards):
        try:
            marker_mm = round(_MARKER_SHARE * square_mm, 1)
            made.append(
                Board(f"board-{index}", across, down, square_mm, marker_mm, dictionary, index * (across * down // 2))
            )
        except ValueError as failure:
            raise WrongUsage(f"{failure}") from failure
    write_whole(out, _document([_page(each, width_mm, height_mm) for each in made], (width_mm, height_mm)))
    inform(f"{out}: {boards} board(s) of {across} x {down} squares; print at 100 % and measure the scale bar")
    entries = [{name: getattr(each, name) for name in BoardEntry.__struct_fields__} for each in made]
    return {"out": str(out), "paper": paper, "board": entries}


def _page(board: Board, width_mm: float, height_mm: float) -> str:
    """Return the drawing of one page in PDF's operators: y goes up, the unit is set to mm."""
    left = (width_mm - board.columns * board.square_mm) / 2
    top = height_mm - _MARGIN_MM
    lines = [f"{_POINTS_PER_MM:.9f} 0 0 {_POINTS_PER_MM:.9f} 0 0 cm", "0 g"]
    for x, y, across, down in black_rectangles_mm(board):
        lines.append(f"{left + x:.5f} {top - y - down:.5f} {across:.5f} {down:.5f} re")
    lines.append("f")
    lines += _scale_bar(_MARGIN_MM, _MARGIN_MM)
    words = (
        f'[[board]] name = "{board.name}"  columns = {board.columns}  rows = {board.rows}  '
        f"square_mm = {board.square_mm:g}  marker_mm = {board.marker_mm:g}  "
        f'dictionary = "{board.dictionary}"  first_marker_id = {board.first_marker_id}'
    )
    lines.append(_text(_MARGIN_MM + _SCALE_BAR_MM + 8, _MARGIN_MM + 3.2, 2.6, words))
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


def _text(x_mm: float, y_mm: float, size_mm: float, words: str) -> str:
    escaped = words.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
    return f"BT /F1 {size_mm:g} Tf {x_mm:.3f} {y_mm:.3f} Td ({escaped}) Tj ET"


def _document(pages: list[str], size_mm: tuple[float, float]) -> bytes:
    """Return a PDF of pages: a catalogue, the list of pages, one font, and for each page itself and its drawing."""
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
