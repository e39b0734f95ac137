"""What is made of a session after its capture lies in it and leaves the session whole."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from pipelines.board_set import load_board_set
from pipelines.errors import BadValue, MissingFile
from pipelines.geometry import geometry
from rig.session.opening import taken_frames
from rig.session.verify import verify
from tests.pipelines.sessions import SWEEPS, captured, rig_toml


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A captured session without results, to be read only."""
    return captured(tmp_path_factory.mktemp("recorded"), rig_toml())


@pytest.fixture(scope="module")
def session(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session to which results are added."""
    return Path(shutil.copytree(recorded, tmp_path_factory.mktemp("results") / "session"))


def test_the_geometry_of_a_session_is_where_its_camera_was(session: Path) -> None:
    geometry(session)
    assert verify(session).problems == ()
    content = json.loads((session / "geometry.json").read_text())
    assert len(list((session / "cameras").glob("*.cameramodel"))) == 9
    assert content["reference_node"] == [1, 1]
    frames = {f"frames/{path.name}" for planned, _, path in taken_frames(session) if planned.kind == "charuco"}
    assert set(content["inputs"]) == frames | {"plan.json"}
    for entry in content["nodes"]:
        told_mm = -100.0 * (np.array(entry["node"][::-1]) - 1)  # the lab's gantry goes where it is told
        np.testing.assert_allclose(entry["rt_cam_ref"][3:5], told_mm, atol=0.15)
    assert {(board["name"], board["sweep"]) for board in content["boards"]} == {("large", sweep) for sweep in range(4)}
    assert content["stage"]["scale_x"]["value"] == pytest.approx(1, abs=1e-3)


def test_a_session_without_boards_is_told_from_one_whose_frames_are_gone(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(BadValue, match=r"has no charuco frame yet; capture"):
        load_board_set(captured(tmp_path, rig_toml(["dark_scene"], rows=1, columns=2)))
    session = Path(shutil.copytree(recorded, tmp_path / "copy"))
    assert len(load_board_set(session).views) == 9 * len(SWEEPS)
    next((session / "frames").glob("*_charuco_2_r1_c0_*")).unlink()
    with pytest.raises(MissingFile, match=r"charuco_2_r1_c0.*restore it from a copy"):
        load_board_set(session)
