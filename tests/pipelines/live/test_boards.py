"""Board sweeps followed while they are captured: corners, verdicts, and the geometry that is solved in the end."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import tifffile
from msgspec.structs import replace

from faintfield.calib.board import Board
from faintfield.calib.errors import PoorFit
from faintfield.calib.geometry import BoardObservation
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.geometry import CameraPoses, GeometryRecord, read_geometry
from faintfield.pipelines.live.board_process import BoardWatch
from faintfield.pipelines.live.board_progress import BoardFrame, BoardNews, BoardOrder, BoardProgress
from faintfield.pipelines.live.board_verdict import SweepPlan, judge
from faintfield.pipelines.live.planes_client import BoardPoses, LiveFrame, LiveNews, LiveOrder, LiveStatus
from faintfield.pipelines.live.planes_process import LivePlanes
from faintfield.pipelines.live.planes_scene import live_scene
from faintfield.pipelines.workflows.geometry import measure_stage
from faintfield.rig.plan import grid_nodes, nominal_poses_rt_cam_ref
from faintfield.rig.session.session import read_plan, taken_frames
from faintfield.rig.simulation.boards import SimulatedBoard, six_boards
from tests.calib.geometry.simulated import BOARDS, OPTICS, simulated
from tests.calib.geometry.test_calibrate import FACING
from tests.pipelines.sessions import captured, rig_toml

_NODES, _SWEEPS = 9, 3
_SIX = six_boards(6, 8, 40.0)


class Line:
    """A connection that holds all news in advance, and keeps what is sent."""

    def __init__(self, *news: object) -> None:
        self.sent: list[object] = []
        self._news = list(news)

    def poll(self) -> bool:
        return False

    def recv(self) -> object:
        if not self._news:
            raise EOFError
        return self._news.pop(0)

    def send(self, message: object) -> None:
        self.sent.append(message)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    steps = ["charuco"] * _SWEEPS + ["dark_scene"]
    return captured(tmp_path_factory.mktemp("boards"), rig_toml(steps, checks="transfer_px = 0.001"))


def frames_of(session: Path) -> list[BoardFrame]:
    return [
        BoardFrame(planned.number, taken.intent, taken.file, 1)
        for planned, taken, _ in taken_frames(session)
        if planned.kind == "charuco"
    ]


def followed(session: Path, out: Path, *news: BoardNews) -> list[BoardProgress]:
    """Return all that is told of a session when these news come, each after the work on the last is done."""
    line = Line(*news)
    with pytest.raises(EOFError):
        BoardWatch(BoardOrder(session, out, (500.0,), 0.001), line).run()
    return [message for message in line.sent if isinstance(message, BoardProgress)]


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def told(session: Path, tmp_path_factory: pytest.TempPathFactory) -> list[BoardProgress]:
    """What is told of a whole session, whose news come around the end of each sweep."""
    before, frames = content(session), frames_of(session)
    counts = [1, *(_NODES * sweep + more for sweep in range(1, _SWEEPS) for more in (-1, 0, 1)), len(frames)]
    told = followed(session, tmp_path_factory.mktemp("told"), *(BoardNews(tuple(frames[:count])) for count in counts))
    assert content(session) == before
    return told


def test_boards_in_turn_end_in_geometry_of_command(session: Path, told: list[BoardProgress], tmp_path: Path) -> None:
    first_verdicts = [next(it for it in told if it.after_sweep == sweep) for sweep in range(1, _SWEEPS + 1)]
    assert [it.frames for it in first_verdicts] == [_NODES, 2 * _NODES, 3 * _NODES]
    assert all(it.verdict is not None and it.verdict.words for it in first_verdicts)
    assert all(it.verdict is None for it in told if it.frames < _NODES)

    last = told[-1]
    measure_stage(session, tmp_path / "command", depth_mm=[500.0])
    command = read_geometry(tmp_path / "command", GeometryRecord)
    poses = read_geometry(Path(last.geometry), CameraPoses)
    assert [node.node for node in poses.nodes] == [node.node for node in command.nodes]
    for node, expected in zip(poses.nodes, command.nodes, strict=True):
        np.testing.assert_allclose(node.rt_cam_ref, expected.rt_cam_ref, atol=1e-6)
    assert last.verdict is not None
    assert last.verdict.error_px == pytest.approx(command.transfer_sigma_px["500"], rel=0.02)
    assert "no board sweep is left" in last.verdict.words
    assert sum(map(sum, last.cells)) == sum(it.corners for it in last.sweeps) > 700
    # As the simulated person holds the board
    assert [(it.direction, it.nodes) for it in last.sweeps] == [("down", 9), ("up", 9), ("left", 9)]
    np.testing.assert_allclose([it.tilt_deg or 0 for it in last.sweeps], [22.4, 24.7, 28.4], atol=0.5)
    np.testing.assert_allclose([it.distance_mm or 0 for it in last.sweeps], [540, 560, 560], atol=5)
    # The board of the third sweep is told by its first view
    first = next(it for it in told if it.frames == 2 * _NODES + 1).sweeps[-1]
    assert (first.sweep, first.direction, first.nodes) == (3, "left", 1)
    assert first.tilt_deg == pytest.approx(28.4, abs=2.0)
    assert first.distance_mm == pytest.approx(560, abs=15)
    assert last.last is not None
    assert last.last.frame == "00026_charuco_2_r2_c2"
    assert last.last.size_px == (320, 240)
    corners = np.load(tmp_path / "command" / "geometry_corners.npz")
    same = (corners["node"] == (2, 2)).all(axis=1) & (corners["sweep"] == 2)
    np.testing.assert_allclose(np.array(last.last.points), corners["pixels"][same], atol=0.006)


@pytest.mark.deep
def test_void_frames_are_judged_again(session: Path, tmp_path: Path) -> None:
    frames = frames_of(session)
    retaken = [*frames[:-1], replace(frames[-1], intent=999)]
    told = followed(
        session, tmp_path, BoardNews(tuple(frames)), BoardNews(tuple(frames[:-1])), BoardNews(tuple(retaken))
    )
    paths = list(dict.fromkeys(it.geometry for it in told if it.geometry))
    assert [Path(path).name for path in paths] == ["geometry_1.json", "geometry_2.json"]
    assert read_geometry(Path(paths[0]), CameraPoses) == read_geometry(Path(paths[1]), CameraPoses)


def test_boards_that_do_not_suffice_give_reason(session: Path, tmp_path: Path) -> None:
    planned = {planned.number: planned for planned, _, _ in taken_frames(session)}
    frames = [frame for frame in frames_of(session) if planned[frame.number].stop.node in ((1, 1), (1, 2))]
    skipped = {frame.number for frame in frames_of(session)} - {frame.number for frame in frames}
    last = followed(session, tmp_path, BoardNews(tuple(frames), tuple(skipped)))[-1]
    assert last.geometry == ""
    assert last.refusal.startswith("2 node(s) show the boards")
    assert last.poses.startswith("nominal, as the boards gave none: 2 node(s) show")
    assert last.problem.startswith("2 node(s)")


def test_unreadable_frame_is_named_and_passed_over(session: Path, tmp_path: Path) -> None:
    shutil.copytree(session, tmp_path / "session")
    frames = frames_of(session)
    (tmp_path / "session" / "frames" / frames[4].file).write_bytes(b"II*\0")
    told = followed(tmp_path / "session", tmp_path, BoardNews(tuple(frames[:6])))
    assert told[-1].frames == 6
    assert frames[4].file in told[-1].problem


@pytest.mark.deep
def test_frame_of_another_size_that_is_void_does_no_harm(session: Path, tmp_path: Path) -> None:
    shutil.copytree(session, tmp_path / "session")
    odd, *frames = frames_of(session)
    tifffile.imwrite(tmp_path / "session" / "frames" / odd.file, np.zeros((10, 16), np.uint16))
    news = BoardNews((odd,)), BoardNews(tuple(frames), (odd.number,))
    last = followed(tmp_path / "session", tmp_path, *news)[-1]
    assert (last.frames, bool(last.geometry)) == (len(frames), True)


def test_files_of_unknown_kind_give_reason(session: Path, tmp_path: Path) -> None:
    shutil.copytree(session, tmp_path / "session")
    frames = frames_of(session)
    for frame in frames:
        (tmp_path / "session" / "frames" / frame.file).write_bytes(b"raw")
    last = followed(tmp_path / "session", tmp_path, BoardNews(tuple(frames)))[-1]
    assert last.refusal == "no frame of a board can be decoded here"


def judged(standing: Sequence[SimulatedBoard], wanted_px: float, to_come: int = 0) -> tuple[str, bool, float | None]:
    """Return the verdict in words, whether it is reached, and the error, with some nodes of the last sweep to come."""
    truth = simulated(3, standing=list(standing), miss_mm=0.01, noise_px=0.05)
    nodes = grid_nodes(3, 3)
    kept = truth.observations[: len(truth.observations) - to_come]
    plan = SweepPlan(
        dict(zip(nodes, nominal_poses_rt_cam_ref(3, 3, 100.0), strict=True)),
        (1, 1),
        (500.0,),
        wanted_px,
        {len(standing) - 1: nodes[len(nodes) - to_come :]},
        1,
    )
    verdict, _ = judge(BOARDS, kept, OPTICS.size_px, plan)
    return verdict.words, verdict.reached, verdict.error_px


def test_verdict_states_error_wish_and_advice() -> None:
    words, reached, error_px = judged(_SIX[:2], 0.1)
    assert words.startswith(f"predicted transfer error {error_px:.2g} px at 500 mm, wanted 0.1: next, put the board ")
    assert "tilted by about 25° to the " in words
    assert not reached
    assert judged(_SIX, 0.5)[1]
    assert judged(_SIX, 0.5)[0].endswith("reached, the boards are good enough; sweeps that are left may be skipped")


def test_facing_board_leads_to_advice_without_lens() -> None:
    words, reached, error_px = judged([FACING], 0.5)
    assert words.startswith("the boards so far do not determine the lens")
    assert "% of the picture), tilted by about 25° " in words
    assert " mm)" not in words
    assert (reached, error_px) == (False, None)


def test_half_a_sweep_predicts_its_end() -> None:
    words, _, half_px = judged(_SIX[:3], 0.01, to_come=5)
    assert words.startswith("predicted transfer error once all frames of sweep 3 count, ")
    assert ": after it, put the board " in words
    assert half_px == pytest.approx(judged(_SIX[:3], 0.01)[2], rel=0.2)


@pytest.mark.deep
def test_contradicting_corners_are_no_advice() -> None:
    truth = simulated(16)
    swap = {(0, 0): (0, 1), (0, 1): (0, 0)}
    views = [
        BoardObservation(swap.get(it.node, it.node), it.target, it.corners, it.pixels, it.sigma_px)
        if it.target.board == "board-0"
        else it
        for it in truth.observations
    ]
    boards: dict[str, Board] = BOARDS
    with pytest.raises(PoorFit, match="% of the corners disagree"):
        judge(boards, views, OPTICS.size_px, SweepPlan({}, (1, 1), (500.0,), 0.5, {}, 0))


def test_live_planes_take_poses_of_boards(
    session: Path, told: list[BoardProgress], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(LivePlanes, "_refine", lambda *_: None)  # PMLEM takes long
    dark = tuple(
        LiveFrame(taken.intent, taken.file, planned.stop.node, planned.exposure_s)
        for planned, taken, _ in taken_frames(session)
        if planned.kind == "dark_scene"
    )[:2]
    order = LiveOrder(session, tmp_path / "rig.toml", (500.0,))
    measured = BoardPoses(Path(told[-1].geometry))
    line = Line(LiveNews(dark, 0), LiveNews(dark, 0, measured))
    with pytest.raises(EOFError):
        LivePlanes(order, line).run()
    poses = list(dict.fromkeys(it.poses for it in line.sent if isinstance(it, LiveStatus) and it.poses))
    assert poses[0].startswith("nominal, as the stage is told; ")
    assert poses[1:] == ["measured, of the boards of this session"]
    frozen, frame = read_plan(session), read_frame(session / "frames" / dark[0].file)
    refused = live_scene(order, frozen, frame, BoardPoses(refusal="too few nodes"))
    assert refused.poses.endswith("; the boards of this session gave none: too few nodes")
