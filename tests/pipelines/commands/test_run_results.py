"""Results of a session that lie in its folder and leave the session whole."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from faintfield.pipelines.commands.capture import verify as verify_all
from faintfield.pipelines.commands.exports import export_colmap, export_mrcal
from faintfield.pipelines.commands.reconstruction import reconstruct, run
from faintfield.pipelines.errors import BadValue, MissingFile, ResultDamaged, WrongUsage
from faintfield.pipelines.formats.exchange.colmap import read_model
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.sets.board_set import load_board_set
from faintfield.pipelines.formats.sets.session_set import load_session
from faintfield.pipelines.reconstruction.options import Options
from faintfield.rig.errors import SessionCorrupt
from faintfield.rig.session.session import taken_frames
from faintfield.rig.session.verify import verify
from tests.pipelines.forms import flip_last_bit
from tests.pipelines.sessions import SWEEPS, captured, rig_toml, steps_run

PLANE = Options(depth_mm=[700.0], method=["backprojection"])
OTHER_PLANE = replace(PLANE, depth_mm=[500.0])
REFUSE = mock.Mock(side_effect=BadValue("begun; wait"))


def test_geometry_of_session_is_where_its_camera_was(calibrated_session: Path) -> None:
    session = calibrated_session
    assert verify(session).problems == ()
    content = json.loads((session / "geometry.json").read_text())
    assert len(list((session / "cameras").glob("*.cameramodel"))) == 9
    assert content["reference_node"] == [1, 1]
    frames = {f"frames/{path.name}" for planned, _, path in taken_frames(session) if planned.kind == "charuco"}
    assert set(content["inputs"]) == frames | {"plan.json"}
    for entry in content["nodes"]:
        commanded_mm = -100.0 * (np.array(entry["node"][::-1]) - 1)  # the lab's gantry goes where it is told
        np.testing.assert_allclose(entry["rt_cam_ref"][3:5], commanded_mm, atol=0.15)
    assert {(board["name"], board["sweep"]) for board in content["boards"]} == {("large", sweep) for sweep in range(4)}
    assert content["stage"]["scale_x"]["value"] == pytest.approx(1, abs=1e-3)
    for axis in "xy":  # the gantry comes from below, whatever the order: its play cannot show
        assert content["stage"][f"backlash_{axis}_mm"]["value"] is None
        assert "approach_mm = 0" in content["stage"][f"backlash_{axis}_mm"]["why"]


def test_exports_have_poses_of_session(calibrated_session: Path, tmp_path: Path) -> None:
    export_mrcal(calibrated_session, tmp_path / "mrcal")
    export_colmap(calibrated_session, tmp_path / "colmap")
    entries = json.loads((calibrated_session / "geometry.json").read_text())["nodes"]
    images = read_model(tmp_path / "colmap")
    assert len(list((tmp_path / "mrcal").iterdir())) == len(images) == len(entries) == 9
    poses = {tuple(np.round(image.rt_cam_world, 6)) for image in images}
    assert poses == {tuple(np.round(entry["rt_cam_ref"], 6)) for entry in entries}


def test_missing_frames_and_results_are_named(session: Path, tmp_path: Path) -> None:
    with pytest.raises(BadValue, match=r"has no charuco frame yet; capture"):
        load_board_set(captured(tmp_path / "dark", rig_toml(["dark_scene"], rows=1, columns=2)))
    assert len(load_board_set(session).views) == 9 * len(SWEEPS)
    for name in ("noise", "geometry"):  # the geometry is missed first
        (session / f"{name}.json").unlink()
        with pytest.raises(MissingFile, match=rf"{name}.json: no such file; run `faintfield {name}"):
            reconstruct(session, options=PLANE)
    with pytest.raises(BadValue, match=r"no bright frame of the centre node \[1, 1\]"):
        load_session(session, "bright")
    load: Callable[[Path], object]
    for load, frame in ((load_board_set, "charuco_2_r1_c0"), (load_session, "dark_scene_0_r0_c2")):
        next((session / "frames").glob(f"*_{frame}_*")).unlink()
        with pytest.raises(MissingFile, match=rf"{frame}.*restore it from a copy"):
            load(session)


class TestRun:
    """`faintfield run`: only what is out of date, by hash."""

    def test_exactly_dependent_steps_run_again(self, session: Path) -> None:
        assert steps_run(session, PLANE) == []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("faintfield.pipelines.pages.report.write_report", REFUSE)
            with pytest.raises(BadValue, match="begun"):
                steps_run(session, OTHER_PLANE)
        assert steps_run(session, OTHER_PLANE) == ["report"], "that of the earlier planes is outdated"
        next((session / "frames").glob("*_dark_scene_0_r0_c0_*")).touch()
        assert steps_run(session, OTHER_PLANE) == []

    def test_altered_frame_is_named_and_begins_its_step(
        self, session: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for kind in ("dark_scene", "flat"):
            frame = sorted((session / "frames").glob(f"*_{kind}_0_*"))[0]
            pixels = read_frame(frame).pixels_dn.copy()
            pixels[10, 20] += 7
            write_frame(frame, pixels)
            if kind == "dark_scene":
                assert steps_run(session, PLANE) == ["reconstruct"]
                assert f"warning: frames/{frame.name} and 0 other frames are not what was" in capsys.readouterr().err
        monkeypatch.setattr("faintfield.pipelines.workflows.session.measure_sensor", REFUSE)
        with pytest.raises(BadValue, match="still to be done: noise, reconstruct, report"):
            steps_run(session, PLANE)

    def test_missing_and_unreadable_results_are_made_again(self, session: Path) -> None:
        (session / "reconstructions" / "report.html").unlink()
        assert steps_run(session, PLANE) == ["report"]
        for damaged in ('{"format": 1,', '{"inputs": 3}'):
            (session / "reconstructions" / "reconstruction.json").write_text(damaged)
            assert steps_run(session, PLANE) == ["reconstruct"]
        flip_last_bit(session / "reconstructions" / "plane_00700.0.tiff")
        assert steps_run(session, PLANE) == ["reconstruct"]
        assert verify(session).problems == ()

    @pytest.mark.deep
    def test_altered_results_are_made_again(
        self, calibrated_session: Path, session: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        results = ("noise.json", "geometry.json", "reconstructions/plane_00700.0.json", "reconstructions/overview.json")
        for name in results:
            path = session / name
            path.write_text(path.read_text().replace("0", "1"))
            with pytest.raises(ResultDamaged, match=name):
                verify_all(path)
        (session / "cameras" / "node_r0_c1.cameramodel").unlink()
        beside = ("noise_maps.npz", "reconstructions/plane_00700.0.tiff")
        for name in beside:
            flip_last_bit(session / name)
        assert steps_run(session, PLANE) == ["noise", "geometry", "reconstruct"]
        assert "noise: noise.json: was altered after it was written" in capsys.readouterr().err
        assert verify_all(session).results is not None
        for name in (*results[:3], *beside, "cameras/node_r0_c1.cameramodel"):
            assert (session / name).read_bytes() == (calibrated_session / name).read_bytes()

    def test_other_lens_or_maps_begin_their_step(self, session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        with monkeypatch.context() as patch:
            patch.setattr("faintfield.pipelines.workflows.session.measure_stage", REFUSE)
            with pytest.raises(BadValue, match="begun"):
                run(session, options=PLANE, lens="opencv4")
        flip_last_bit(session / "noise_maps.npz")
        monkeypatch.setattr("faintfield.pipelines.workflows.session.measure_sensor", REFUSE)
        with pytest.raises(BadValue, match="begun"):
            steps_run(session, PLANE)

    def test_failed_step_skips_only_its_dependents(self, session: Path, capsys: pytest.CaptureFixture[str]) -> None:
        for path in (session / "geometry.json", *(session / "frames").glob("*_charuco_*")):
            path.unlink()
        with pytest.raises(MissingFile, match=r"run `faintfield run .*still to be done: geometry, reconstruct, report"):
            steps_run(session, OTHER_PLANE)
        assert "reconstruct: skipped, because it needs geometry" in capsys.readouterr().err

    def test_call_without_depths_or_session_is_refused(self, recorded_session: Path, tmp_path: Path) -> None:
        with pytest.raises(WrongUsage, match=r"give --depth-mm or --sweep-mm"):
            run(recorded_session)
        with pytest.raises(MissingFile, match="holds no session"):
            run(tmp_path, options=PLANE)


def test_session_is_verified_with_its_results(recorded_session: Path, session: Path) -> None:
    assert verify_all(recorded_session).results is None
    found = verify_all(session)
    assert found.session is not None
    assert found.results is not None
    assert found.session.present == found.session.planned
    assert (found.results.problems, found.results.unchecked) == ((), ())
    assert found.results.inputs > found.session.planned
    for name in ("noise_maps.npz", "reconstructions/plane_00700.0.tiff"):
        flip_last_bit(session / name)
        with pytest.raises(ResultDamaged, match=f"{name}: was altered"):
            verify_all(session)
        flip_last_bit(session / name)
    next((session / "frames").glob("*_flat_0_*")).write_bytes(b"another")
    with pytest.raises(ResultDamaged, match=r"_flat_0_.* was altered since it was made from it"):
        verify_all(session / "noise.json")
    with pytest.raises(SessionCorrupt, match=r"is damaged: .*_flat_0_.*; restore these files from a copy"):
        verify_all(session)
