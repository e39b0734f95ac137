"""Before a capture: boards to print, and a prediction of what the capture will show."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import msgspec

from faintfield.calib.board import Board
from faintfield.calib.estimate import Estimate
from faintfield.pipelines.arguments import PaperName
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.board_pdf import FOOT_MM, MARGIN_MM, board_pdf
from faintfield.pipelines.formats.files import write_whole
from faintfield.pipelines.formats.results.geometry import GEOMETRY_FILE
from faintfield.pipelines.formats.results.noise import NOISE_FILE
from faintfield.pipelines.formats.toml_files import read_rig
from faintfield.pipelines.planning.known import calibration_file, known_lens, known_pace, known_sensor, planned_light
from faintfield.pipelines.planning.options import PlanOptions
from faintfield.pipelines.planning.predict import Predictor, parse_grids, scene_view
from faintfield.pipelines.planning.prediction import PredictionRecord, print_prediction
from faintfield.rig.settings import BoardSettings

# Width and height, the long side across.
_PAPERS_MM = {"A4": (297.0, 210.0), "A3": (420.0, 297.0), "A2": (594.0, 420.0), "letter": (279.4, 215.9)}

# Edge of a marker over that of its square.
_MARKER_SHARE = 0.74


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
    made = _boards(boards, across, down, square_mm, dictionary)
    write_whole(out, board_pdf(made, _PAPERS_MM[paper]))
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
    max_across = int((width_mm - 2 * MARGIN_MM) // square_mm)
    max_down = int((height_mm - 2 * MARGIN_MM - FOOT_MM) // square_mm)
    across, down = columns or max_across, rows or max_down
    if across > max_across or down > max_down:
        raise WrongUsage(
            f"{across} x {down} squares of {square_mm:g} mm do not fit {paper}, which holds {max_across} x {max_down}; "
            "take fewer, smaller squares or larger paper"
        )
    return across, down


def predict_capture(rig: Path, options: PlanOptions) -> PredictionRecord:
    """Return and print what a capture by a rig.toml will show."""
    settings = read_rig(rig)
    sensor = known_sensor(
        settings,
        calibration_file(options.noise, NOISE_FILE, rig.parent),
        read_noise_e=options.read_noise_e,
        dark_current_e_per_s=options.dark_current_e_per_s,
        quantum_efficiency=options.quantum_efficiency,
    )
    lens = known_lens(settings, sensor, calibration_file(options.geometry, GEOMETRY_FILE, rig.parent), options.fx_px)
    exposure_s, view = scene_view(settings, options)
    depths_mm = options.depth_mm or settings.scene.depth_mm
    sides_px = [*(options.feature_px or []), *_in_px(options.feature_mm or [], depths_mm, lens.f_px)] or [10.0]
    grids = parse_grids(options.grids or [])
    light = planned_light(options, exposure_s, sensor)
    pace = known_pace(settings)
    predictor = Predictor(settings, options, sensor, lens, pace, light, exposure_s, view, depths_mm, sides_px, grids)
    record = predictor.record(str(rig))
    print_prediction(record)
    return record


def _in_px(sides_mm: list[float], depths_mm: Sequence[float], f_px: Estimate) -> list[float]:
    if not sides_mm:
        return []
    if not depths_mm or f_px.value is None:
        raise WrongUsage(
            f"--feature-mm {sides_mm[0]:g}: pixels of it are not known without a depth and a focal length; give "
            "--depth-mm and --fx-px or --geometry, or --feature-px"
        )
    return [side_mm * f_px.value / depths_mm[0] for side_mm in sides_mm]
