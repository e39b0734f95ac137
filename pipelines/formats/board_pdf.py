"""ChArUco boards as a PDF to print: vectors, true to size, a page per board."""

from collections.abc import Sequence

from faintfield.calib.board import Board, black_rectangles_mm

_POINTS_PER_MM = 72 / 25.4

# Printers leave this much white at each edge; the foot holds the scale bar and the words beneath a board.
MARGIN_MM, FOOT_MM = 10.0, 14.0
_SCALE_BAR_MM = 100.0


def board_pdf(boards: Sequence[Board], size_mm: tuple[float, float]) -> bytes:
    """Return a PDF with a page of a width and height per board, which fits between its margins above the foot."""
    return _document([_page(board, *size_mm) for board in boards], size_mm)


def _page(board: Board, width_mm: float, height_mm: float) -> str:
    """Return the drawing of one page in PDF's operators; y points up, the unit is the mm."""
    left = (width_mm - board.columns * board.square_mm) / 2
    top = height_mm - MARGIN_MM
    lines = [f"{_POINTS_PER_MM:.9f} 0 0 {_POINTS_PER_MM:.9f} 0 0 cm", "0 g"]
    for x, y, across, down in black_rectangles_mm(board):
        lines.append(f"{left + x:.5f} {top - y - down:.5f} {across:.5f} {down:.5f} re")
    lines.append("f")
    lines += _scale_bar(MARGIN_MM, MARGIN_MM)
    words = (
        f'[[board]] name = "{board.name}"  columns = {board.columns}  rows = {board.rows}  '
        f"square_mm = {board.square_mm:g}  marker_mm = {board.marker_mm:g}  "
        f'dictionary = "{board.dictionary}"  first_marker_id = {board.first_marker_id}'
    )
    lines.append(_text(MARGIN_MM + _SCALE_BAR_MM + 8, MARGIN_MM + 3.2, 2.6, words))
    lines.append(_text(MARGIN_MM + _SCALE_BAR_MM + 8, MARGIN_MM - 0.8, 2.6, "Print at 100 %. If the bar is not "
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
