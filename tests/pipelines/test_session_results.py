"""What is made of a session after its capture lies in it and leaves the session whole."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from faintfield.pipelines.commands.exports.colmap import export_colmap
from faintfield.pipelines.commands.exports.mrcal import export_mrcal
from faintfield.pipelines.commands.geometry import geometry
from faintfield.pipelines.commands.noise import noise
from faintfield.pipelines.commands.reconstruct import reconstruct
from faintfield.pipelines.commands.run import run
from faintfield.pipelines.commands.verify import verify as verify_all
from faintfield.pipelines.errors import BadValue, MissingFile, ResultDamaged, WrongUsage
from faintfield.pipelines.formats.exchange.colmap import read_model
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.sets.board_set import load_board_set
from faintfield.pipelines.formats.sets.session_set import load_session
from faintfield.pipelines.reconstruction.channels import channel_layouts, load_channel
from faintfield.pipelines.reconstruction.options import Options
from faintfield.rig.errors import SessionCorrupt
from faintfield.rig.session.session import taken_frames
from faintfield.rig.session.verify import verify
from tests.pipelines.sessions import SWEEPS, captured, rig_toml

# The prior makes no difference to what is out of date, and this one takes the least time
_AT_700_MM = Options(depth_mm=[700.0], passes=5, prior="tv")


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
    for axis in "xy":  # the gantry comes from below, whatever the order: its play cannot show
        assert content["stage"][f"backlash_{axis}_mm"]["value"] is None
        assert "approach_mm = 0" in content["stage"][f"backlash_{axis}_mm"]["why"]


def test_what_was_measured_goes_out_to_other_programs(session: Path, tmp_path: Path) -> None:
    run(session, options=_AT_700_MM)
    export_mrcal(session, tmp_path / "mrcal")
    export_colmap(session, tmp_path / "colmap")
    entries = json.loads((session / "geometry.json").read_text())["nodes"]
    model = read_model(tmp_path / "colmap")
    assert len(list((tmp_path / "mrcal").iterdir())) == len(model.images) == len(entries) == 9
    poses = {tuple(np.round(image.rt_cam_world, 6)) for image in model.images}
    assert poses == {tuple(np.round(entry["rt_cam_ref"], 6)) for entry in entries}


def test_a_session_without_boards_is_told_from_one_whose_frames_are_gone(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(BadValue, match=r"has no charuco frame yet; capture"):
        load_board_set(captured(tmp_path, rig_toml(["dark_scene"], rows=1, columns=2)))
    session = Path(shutil.copytree(recorded, tmp_path / "copy"))
    assert len(load_board_set(session).views) == 9 * len(SWEEPS)
    next((session / "frames").glob("*_charuco_2_r1_c0_*")).unlink()
    with pytest.raises(MissingFile, match=r"charuco_2_r1_c0.*restore it from a copy"):
        load_board_set(session)


def test_what_is_missing_is_named_with_the_command_that_makes_it(recorded: Path, tmp_path: Path) -> None:
    session = Path(shutil.copytree(recorded, tmp_path / "copy"))
    with pytest.raises(MissingFile, match=r"geometry.json: no such file; run `faintfield geometry"):
        reconstruct(session, options=Options(depth_mm=[500.0]))
    (session / "geometry.json").write_text("{}")
    with pytest.raises(MissingFile, match=r"noise.json: no such file; run `faintfield noise"):
        reconstruct(session, options=Options(depth_mm=[500.0]))
    with pytest.raises(BadValue, match=r"no bright frame of the centre node \[1, 1\]"):
        load_session(session, "bright")
    next((session / "frames").glob("*_dark_scene_0_r0_c2_*")).unlink()
    with pytest.raises(MissingFile, match=r"dark_scene_0_r0_c2.*restore it from a copy"):
        load_session(session)


class TestRun:
    """`faintfield run`: only what is out of date, by hash."""

    def ran(self, session: Path, depth_mm: float = 500.0) -> list[str]:
        return [step.step for step in run(session, options=replace(_AT_700_MM, depth_mm=[depth_mm])).steps if step.ran]

    def test_exactly_the_dependent_steps_run_again(self, recorded: Path, tmp_path: Path) -> None:
        session = Path(shutil.copytree(recorded, tmp_path / "copy"))
        assert self.ran(session) == ["noise", "geometry", "reconstruct"]
        assert verify(session).problems == ()
        assert self.ran(session) == []
        assert self.ran(session, 700.0) == ["reconstruct"]
        next((session / "frames").glob("*_dark_scene_0_r0_c0_*")).touch()
        assert self.ran(session, 700.0) == []

    @pytest.mark.parametrize(
        ("kind", "steps"),
        [
            ("dark_scene", ["reconstruct"]),
            pytest.param("charuco", ["geometry", "reconstruct"], marks=pytest.mark.slow),
            ("flat", ["noise", "reconstruct"]),
        ],
    )
    def test_a_frame_that_is_not_what_was_captured_is_named(
        self, kind: str, steps: list[str], session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        self.ran(session, 700.0)
        copy = Path(shutil.copytree(session, tmp_path / "copy"))
        frame = sorted((copy / "frames").glob(f"*_{kind}_0_*"))[0]
        pixels = read_frame(frame).pixels_dn.copy()
        pixels[10, 20] += 7
        write_frame(frame, pixels)
        assert self.ran(copy, 700.0) == steps
        assert f"warning: frames/{frame.name} and 0 other frames are not what was captured" in capsys.readouterr().err

    def test_what_is_missing_or_damaged_is_made_again(self, session: Path, tmp_path: Path) -> None:
        self.ran(session, 700.0)
        copy = Path(shutil.copytree(session, tmp_path / "copy"))
        (copy / "reconstructions" / "plane_00700.0.tiff").unlink()
        assert self.ran(copy, 700.0) == ["reconstruct"]
        (copy / "reconstructions" / "report.html").unlink()
        assert self.ran(copy, 700.0) == ["report"]
        (copy / "cameras" / "node_r0_c1.cameramodel").unlink()
        assert self.ran(copy, 700.0)[0] == "geometry"
        for damaged in ('{"format": 1,', "[]", '{"inputs": 3}'):
            (copy / "reconstructions" / "reconstruction.json").write_text(damaged)
            assert self.ran(copy, 700.0) == ["reconstruct"]
        assert verify(copy).problems == ()

    def test_results_that_were_altered_are_made_again(
        self, session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        self.ran(session, 700.0)
        copy = Path(shutil.copytree(session, tmp_path / "copy"))
        results = ("noise.json", "geometry.json", "reconstructions/plane_00700.0.json", "reconstructions/overview.json")
        for name, key in zip(results, ("likelihood", "corners", "sha256", "views"), strict=True):
            content = json.loads((session / name).read_text())
            for altered in ({**content, key: 1}, {key: content[key]}):
                (copy / name).write_text(json.dumps(altered, indent=2))
                with pytest.raises(ResultDamaged, match=name):
                    verify_all(copy / name)
            (copy / name).write_text(json.dumps(content, indent=2).replace("0", "1"))
        capsys.readouterr()
        assert self.ran(copy, 700.0) == ["noise", "geometry", "reconstruct"]
        said = capsys.readouterr().err
        assert "noise: noise.json: was altered after it was written" in said
        assert "geometry: geometry.json: was altered after it was written" in said
        assert verify_all(copy).results is not None
        for name in results[:3]:
            assert (copy / name).read_bytes() == (session / name).read_bytes()

    def test_files_beside_a_result_that_were_altered_are_made_again(self, session: Path, tmp_path: Path) -> None:
        self.ran(session, 700.0)
        copy = Path(shutil.copytree(session, tmp_path / "copy"))
        beside = {"reconstruct": "reconstructions/plane_00700.0.tiff", "noise": "noise_maps.npz"}
        for step, name in beside.items():
            whole = (copy / name).read_bytes()
            (copy / name).write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
            with pytest.raises(ResultDamaged, match=f"{name}: was altered"):
                verify_all(copy)
            assert self.ran(copy, 700.0)[0] == step
            assert (copy / name).read_bytes() == whole

    def test_a_report_of_other_planes_does_not_stay(
        self, session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        self.ran(session, 700.0)
        copy = Path(shutil.copytree(session, tmp_path / "copy"))

        def interrupted(*_: object, **__: object) -> None:
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr("faintfield.pipelines.pages.report.write_report", interrupted)
            with pytest.raises(KeyboardInterrupt):
                run(copy, options=replace(_AT_700_MM, passes=4))
        again = run(copy, options=replace(_AT_700_MM, passes=4))
        assert [step.step for step in again.steps if step.ran] == ["report"]

    def test_another_lens_is_another_geometry(self, session: Path, tmp_path: Path) -> None:
        copy = Path(shutil.copytree(session, tmp_path / "copy"))
        assert run(copy, options=_AT_700_MM, lens="opencv4").steps[1].ran
        assert json.loads((copy / "geometry.json").read_text())["lens"]["model"] == "opencv4"
        assert not run(copy, options=_AT_700_MM, lens="opencv4").steps[1].ran

    def test_what_fails_leaves_the_rest_and_says_how_to_go_on(
        self, recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        session = Path(shutil.copytree(recorded, tmp_path / "copy"))
        frames = {path: path.read_bytes() for path in (session / "frames").glob("*_charuco_*")}
        for path in frames:
            path.unlink()
        with pytest.raises(MissingFile, match=r"run `faintfield run .*still to be done: geometry, reconstruct, report"):
            self.ran(session)
        assert (session / "noise.json").is_file()
        assert "reconstruct: skipped, because it needs geometry" in capsys.readouterr().err
        for path, content in frames.items():
            path.write_bytes(content)
        assert self.ran(session) == ["geometry", "reconstruct"]

    def test_no_depth_at_all_is_wrong_usage(self, recorded: Path) -> None:
        with pytest.raises(WrongUsage, match=r"give --depth-mm or --sweep-mm"):
            run(recorded)

    def test_a_folder_without_a_session_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(MissingFile, match="holds no session"):
            run(tmp_path, options=Options(depth_mm=[500.0]))


def test_a_session_is_verified_with_its_results(recorded: Path, session: Path, tmp_path: Path) -> None:
    assert verify_all(recorded).results is None
    run(session, options=_AT_700_MM)
    found = verify_all(session)
    assert found.session is not None
    assert found.results is not None
    assert found.session.present == found.session.planned
    assert (found.results.problems, found.results.unchecked) == ((), ())
    assert found.results.inputs > found.session.planned
    copy = Path(shutil.copytree(session, tmp_path / "copy"))
    next((copy / "frames").glob("*_flat_0_*")).write_bytes(b"another")
    with pytest.raises(ResultDamaged, match=r"_flat_0_.* was altered since it was made from it"):
        verify_all(copy / "noise.json")
    with pytest.raises(SessionCorrupt, match=r"is damaged: .*_flat_0_.*; restore these files from a copy"):
        verify_all(copy)


def test_repeated_frames_add_up(tmp_path: Path) -> None:
    """Twice the frames: twice the electrons, twice the dark electrons and the read variance."""
    session = captured(tmp_path, rig_toml([*SWEEPS, "dark_scene", "dark_scene", "dark"]))
    geometry(session)
    noise(session)
    loaded = load_session(session)
    assert loaded.frames_per_view == 2
    assert loaded.settings.exposure_s == pytest.approx(0.2)
    (layout,) = channel_layouts(loaded)
    images = load_channel(loaded, layout)
    frames = [path for it, _, path in taken_frames(session) if it.kind == "dark_scene" and it.stop.node == (0, 2)]
    by_hand = sum((read_frame(path).pixels_dn - loaded.noise.offset_dn) / loaded.noise.gain_dn_per_e for path in frames)
    np.testing.assert_allclose(images.electrons[2], by_hand, atol=1e-3)
    variance_e2 = np.asarray(images.read_variance_e2)[0]
    np.testing.assert_allclose(variance_e2, 2 * loaded.noise.read_variance_e2(), rtol=1e-5)
    dark_e = 0.2 * np.asarray(loaded.noise.dark_current_e_per_s)
    np.testing.assert_allclose(np.asarray(images.background_e)[0], dark_e, rtol=1e-5)
    # What is known of the variance is what is there: of the pixels that see nothing, against the sum of both parts
    unlit = images.electrons[2][:20, :40]
    expected = np.mean(images.read_variance_e2) + np.mean(images.background_e)
    assert np.var(unlit) == pytest.approx(float(expected), rel=5 * np.sqrt(2 / unlit.size))
