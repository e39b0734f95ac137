"""Commands at the rig, from its description to a verified session."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from faintfield.pipelines.arguments import Count, PaperName, Positive
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import OutputExists
from faintfield.pipelines.planning.options import PlanOptions

if TYPE_CHECKING:
    from faintfield.pipelines.formats.board_pdf import BoardSheets
    from faintfield.pipelines.planning.prediction import PredictionRecord
    from faintfield.pipelines.workflows.capture import Captured
    from faintfield.pipelines.workflows.check import RigCheck
    from faintfield.pipelines.workflows.verify import Verified

_PLAN = PlanOptions()

type Prediction = PredictionRecord
type Check = RigCheck
type Capture = Captured
type Sheets = BoardSheets
type Verification = Verified


def init(rig: Path = Path("rig.toml"), /) -> dict[str, str]:
    """Write a commented configuration, which describes a simulated rig until you change it.

    Parameters
    ----------
    rig
        File to write; an existing one is left alone.
    """
    from faintfield.pipelines.formats.toml_files import write_template

    if rig.exists():
        raise OutputExists(f"{rig}: exists and is not overwritten; name another file, or edit this one")
    write_template(rig)
    inform(f"wrote {rig}; describe your rig in it, then: faintfield check {rig}")
    return {"rig": str(rig)}


def check(rig: Path, /, *, remember: bool = False, session: Path | None = None) -> Check:
    """Check a configuration against the rig, without any motion.

    Parameters
    ----------
    rig
        The rig.toml.
    remember
        Store the stage's settings beside the file; later checks say what has changed since.
    session
        Folder of a session: also say which settings have changed since it was begun, and whether it can be resumed.
    """
    from faintfield.pipelines.workflows.check import check_rig

    return check_rig(rig, remember, session)


def plan(rig: Path, /, *, options: PlanOptions = _PLAN) -> Prediction:
    """Predict what a capture will show: SNR, noise of the planes, smallest contrast, depth, and time.

    Stage and camera are asked for their speeds, and nothing moves. A table compares exposures, grids and frames per
    node, and with --sigma-e names the shortest session that reaches a wanted noise. What is not known is said to be
    unknown, and why. docs/how-to/predict_a_capture.md explains the numbers, and compares them with simulated captures.

    An option with several values takes them one after another, such as --exposures-ms 100 200 --grids 3x3 5x5.

    Parameters
    ----------
    rig
        The rig.toml.
    """
    from faintfield.pipelines.planning.predict import predict_capture

    return predict_capture(rig, options)


def board(
    out: Path,
    /,
    *,
    paper: PaperName = "A3",
    boards: Count = 1,
    columns: Count | None = None,
    rows: Count | None = None,
    square_mm: Positive = 27.0,
    dictionary: str = "DICT_5X5_1000",
) -> Sheets:
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
    from faintfield.pipelines.formats.board_pdf import write_boards

    return write_boards(out, paper, boards, columns, rows, square_mm, dictionary)


def capture(
    rig: Path,
    session: Path,
    /,
    *,
    yes: bool = False,
    page: bool = False,
    live_depth_mm: Annotated[list[Positive] | None, Parameter(consume_multiple=True)] = None,
    live_sweep_mm: str | None = None,
    noise: Path | None = None,
    geometry: Path | None = None,
    fx_px: Positive | None = None,
    light_e: Positive | None = None,
) -> Capture:
    """Capture a session, step by step; run it again to go on where it stopped.

    Keys: t test frame before a step, p pause, r take the last frame again, s skip, q stop. Ctrl-C stops after the
    present frame, a second one at once.

    Parameters
    ----------
    rig
        The rig.toml.
    session
        Folder of the session.
    yes
        Answer every prompt with its usual answer: for scripts.
    page
        Also serve a local web page, on this computer alone.
    live_depth_mm
        Show planes at these depths on the page, of the dark frames so far; without it there are none.
    live_sweep_mm
        The same, at FIRST:LAST:COUNT depths.
    noise
        For these planes, the light and steps with `until`: noise.json or its folder; by default that of the session,
        or beside the rig.toml.
    geometry
        For these planes and steps with `until`: geometry.json or its folder; by default that of the session, or
        beside the rig.toml.
    fx_px
        The same: focal length in pixels, where there is no geometry.json.
    light_e
        Planned light of the dark scene, which is compared with the measured one: as in `faintfield plan`.
    """
    from faintfield.pipelines.workflows.capture import capture_or_resume

    known = (noise, geometry, fx_px)
    return capture_or_resume(
        rig,
        session,
        yes=yes,
        page=page,
        live_depth_mm=live_depth_mm,
        live_sweep_mm=live_sweep_mm,
        known=known,
        light_e=light_e,
    )


def verify(path: Path, /, *, inputs: Path | None = None, repair: bool = False) -> Verification:
    """Verify a session or results; unless a session is to be repaired, not a byte of them is changed.

    Of a session: its plan, its journal and the SHA-256 of every frame, then the results in its folder. Of results:
    every record against its own digest, the files that it vouches for, and the inputs that it was made from.

    Parameters
    ----------
    path
        A session, a folder of results, or one record such as noise.json, geometry.json or reconstruction.json.
    inputs
        Folder of the session or set that the results were made from; searched for around them by default. Inputs that
        are not found are named as not checked, which is no failure.
    repair
        Seal a session again that faintfield 0.2.0 sealed while another program read its journal, or whose sealing was
        interrupted; whatever else is wrong, nothing is changed.
    """
    from faintfield.pipelines.workflows.verify import verify_folder

    return verify_folder(path, inputs, repaired=repair)
