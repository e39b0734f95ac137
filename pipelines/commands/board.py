"""`faintfield board`: ChArUco boards to print, as vectors and true to size."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import msgspec

from faintfield.pipelines.arguments import Count, Positive
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import WrongUsage

if TYPE_CHECKING:
    from faintfield.calib.board import Board
    from faintfield.pipelines.formats.sets.board_set import BoardEntry


# Width and height, the long side across.
_PAPERS_MM = {"A4": (297.0, 210.0), "A3": (420.0, 297.0), "A2": (594.0, 420.0), "letter": (279.4, 215.9)}

# Edge of a marker over that of its square.
_MARKER_SHARE = 0.74


class BoardSheets(msgspec.Struct, frozen=True):
    """The result of `faintfield board`: the file, its paper, and the entries for charuco.toml."""

    out: str
    paper: str
    board: "list[BoardEntry]"


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
) -> BoardSheets:
    """Write ChArUco boards as PDF, a page each; they share no marker and can be in view together.

    Print at 100 % ("actual size"), measure the scale bar, glue the sheet to something flat and stiff. The [[board]]
    entries for charuco.toml are printed beneath each board.

    Parameters
    ----------
    out
        File to write.
    paper
        Paper format; the long side goes across.
    boards
        Number of boards.
    columns
        Number of squares across; as many as fit by default.
    rows
        Number of squares down; as many as fit by default.
    square_mm
        Edge of a square.
    dictionary
        OpenCV's dictionary of the markers.
    """
    from faintfield.pipelines.formats.board_pdf import board_pdf
    from faintfield.pipelines.formats.files import write_whole
    from faintfield.pipelines.formats.sets.board_set import BoardEntry

    across, down = _squares(paper, columns, rows, square_mm)
    made = _boards(boards, across, down, square_mm, dictionary)
    write_whole(out, board_pdf(made, _PAPERS_MM[paper]))
    inform(f"{out}: {boards} board(s) of {across} x {down} squares; print at 100 % and measure the scale bar")
    entries = [BoardEntry(**asdict(each)) for each in made]
    return BoardSheets(str(out), paper, entries)


def _boards(count: int, across: int, down: int, square_mm: float, dictionary: str) -> "list[Board]":
    """Return boards of one size that share no marker."""
    from faintfield.calib.board import Board

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
    from faintfield.pipelines.formats.board_pdf import FOOT_MM, MARGIN_MM

    width_mm, height_mm = _PAPERS_MM[paper]
    max_across = int((width_mm - 2 * MARGIN_MM) // square_mm)
    max_down = int((height_mm - 2 * MARGIN_MM - FOOT_MM) // square_mm)
    across, down = columns or max_across, rows or max_down
    if across > max_across or down > max_down:
        raise WrongUsage(
            f"{across} x {down} squares of {square_mm:g} mm do not fit {paper}, which holds {max_across} x {max_down}; "
            "take fewer, smaller squares or larger paper"
        )
    return across, down
