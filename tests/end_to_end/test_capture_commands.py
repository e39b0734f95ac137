"""init, check, capture and verify, as a person types them."""

import json
import signal
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from faintfield.pipelines import cli
from faintfield.pipelines.formats.rig_file import read_rig
from faintfield.pipelines.live.guided import duration_words
from faintfield.rig.session.disk import lock_session
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.session import taken_frames
from faintfield.rig.simulation.lab import SimulatedLab
from faintfield.rig.stages.protocol import StageSettings

STEPS = [
    *[("charuco", 49)] * 6,
    ("bright", 49),
    ("dark_scene", 49),
    ("noise_reference", 49),
    ("dark", 40),
    ("flat", 20),
]
FRAMES = sum(count for _, count in STEPS)


KEEP_OUT = "[[stage.keep_out]]\nx_mm = [-260, -240]\ny_mm = [-260, -240]"


class Shell:
    """Runs commands and keeps what they printed."""

    def __init__(self, capsys: pytest.CaptureFixture[str], folder: Path) -> None:
        self._capsys = capsys
        self.rig = folder / "rig.toml"
        self.session = folder / "session"
        self.output = self.words = ""

    def run(self, *arguments: object) -> int:
        code = cli.run([str(argument) for argument in arguments])
        self.output, self.words = self._capsys.readouterr()
        return code

    def result(self, *arguments: object) -> Any:
        assert self.run(*arguments, "--json") == 0, self.words
        return json.loads(self.output)

    def edit(self, old: str, new: str) -> None:
        text = self.rig.read_text()
        assert old in text
        self.rig.write_text(text.replace(old, new))


@pytest.fixture
def shell(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Shell:
    """Return a shell beside a rig.toml as `init` writes it, of few pixels."""
    shell = Shell(capsys, tmp_path)
    assert shell.run("init", shell.rig) == 0
    shell.edit("size_px = [640, 480]", "size_px = [64, 48]")
    return shell


def small(shell: Shell) -> Shell:
    """Make the grid small."""
    shell.edit("rows = 7\ncolumns = 7", "rows = 2\ncolumns = 2")
    return shell


def test_the_whole_experiment_unattended(shell: Shell) -> None:
    assert shell.result("capture", shell.rig, shell.session, "--yes")["taken"] == FRAMES
    verdict = shell.result("verify", shell.session)["session"]
    assert verdict["problems"] == []
    assert (verdict["planned"], verdict["present"], verdict["sealed"]) == (FRAMES, FRAMES, True)
    frames = [frame for frame, _, _ in taken_frames(shell.session)]
    assert [(kind, sum(frame.step == step for frame in frames)) for step, (kind, _) in enumerate(STEPS)] == STEPS
    assert [frame.kind for frame in frames] == [kind for kind, count in STEPS for _ in range(count)]
    assert [frame.number for frame in frames] == list(range(FRAMES))
    grid = [frame.stop.node for frame in frames[:49]]
    assert grid[:8] == [(0, column) for column in range(7)] + [(1, 6)]
    assert {frame.exposure_s for frame in frames if frame.kind == "dark"} == {0.05, 0.1, 0.5, 1.0}
    with Journal(shell.session / "journal.sqlite", read_only=True) as journal:
        assert [it.frame for it in journal.committed()] == list(range(FRAMES))
        assert not journal.uncommitted()
        assert len(journal.events("drift_check")) == 9
        assert len(journal.events("settling")) == 1


def test_check_moves_nothing_and_says_what_matters(shell: Shell) -> None:
    with (
        mock.patch("faintfield.rig.stages.gantry.Gantry.move_to") as move,
        mock.patch("faintfield.rig.stages.gantry.Gantry.home") as home,
    ):
        found = shell.result("check", shell.rig)
        assert not move.called
        assert not home.called
    assert found["frames"] == FRAMES
    assert found["disk_bytes"] == FRAMES * (2 * 64 * 48 + 512)
    assert 300.0 < found["duration_s"] < 1000.0
    for words in (
        "501 frames in 11 steps",
        "about 13 min without prompts by the simulated stage's clock",
        "travel [-400, 0]",
        "are free",
    ):
        assert words in shell.words


def test_a_simulated_stage_has_a_clock_of_its_own() -> None:
    real, simulated = StageSettings("grbl", port="/dev/ttyUSB0"), StageSettings("simulated")
    assert duration_words(600.0, real) == "about 10 min without prompts"
    words = "about 10 min without prompts by the simulated stage's clock, far less by yours"
    assert duration_words(600.0, simulated) == duration_words(600.0, StageSettings("grbl", "simulated:grbl")) == words


def test_the_template_shows_as_many_board_poses_as_the_geometry_asks_for(shell: Shell) -> None:
    settings = read_rig(shell.rig)
    assert len(settings.board) * sum(step.kind == "charuco" for step in settings.step) >= 6


def test_check_remembers_the_stage_s_settings(shell: Shell) -> None:
    stored = shell.rig.with_suffix(".stage.json")
    assert shell.result("check", shell.rig)["changed_settings"] == []
    assert not stored.exists()
    shell.result("check", shell.rig, "--remember")
    assert shell.result("check", shell.rig)["changed_settings"] == []
    settings = json.loads(stored.read_text())
    name = next(name for name in settings if "120" in name)
    stored.write_text(json.dumps({**settings, name: "250.000"}))
    (change,) = shell.result("check", shell.rig)["changed_settings"]
    assert f"{name} was 250.000 when stored and is 500.000 now; set it back" in change
    stored.write_text("[1]")
    assert shell.run("check", shell.rig) == 1
    assert "is not what --remember writes" in shell.words


@pytest.mark.parametrize(
    ("old", "new", "failure", "words"),
    [
        ("origin_mm = [-350.0", "origin_mm = [-250.0", "OutsideTravel", "outside the travel"),
        (
            "# [[stage.keep_out]]",
            "[[stage.keep_out]]\nx_mm=[-260, -240]\ny_mm=[-260, -240]\n#",
            "KeepOutCrossed",
            "meets",
        ),
        ("pitch_mm", "pich_mm", "UnknownKey", "did you mean 'pitch_mm'?"),
        (
            'kind = "bright"',
            'kind = "brigth"',
            "BadValue",
            "step[6].kind = 'brigth'; choose from 'bright', 'charuco', 'dark', 'dark_scene', 'flat', "
            "'noise_reference'; did you mean 'bright'?",
        ),
        ('"serpentine"', '"snake"', "BadValue", "grid.order = 'snake'; choose from 'raster', 'serpentine'"),
        (
            'protocol = "simulated"',
            'protocol = "klipper"',
            "UnknownPlugin",
            "stage.protocol = 'klipper'; choose from 'grbl', 'marlin', 'simulated', 'micromanager', no plug-in is",
        ),
        ("square_mm = 40.0", "square_mm = 4.0", "BadValue", "markers smaller"),
        ('dictionary = "DICT_5X5_1000"', 'dictionary = "5X5"', "BadValue", "no dictionary of OpenCV"),
        ("exposure_s = 0.1\n", "exposure_s = 0.0\n", "BadValue", "above 0 s"),
        (
            'backend = "simulated"',
            'backend = "gphoto"',
            "UnknownPlugin",
            "camera.backend = 'gphoto'; choose from 'gphoto2', 'micromanager', 'aravis', 'folder', 'simulated', "
            "no plug-in is installed; did you mean 'gphoto2'?",
        ),
        *[
            (
                'backend = "simulated"',
                f'backend = "{other}"',
                "UnknownKey",
                "'camera.size_px' is not a key that is read; it is for backend = 'simulated' alone: remove it",
            )
            for other in ("gphoto2", "micromanager", "aravis", "folder")
        ],
        (
            "[grid]",
            "[grid]\ndepth_mm = 3.0",
            "UnknownKey",
            "'grid.depth_mm' is not a key that is read; it belongs in an",
        ),
        *[
            (f"{key} = ", f"{key} = {value} #", "BadValue", f"{place}.{key} = {value}; numbers are finite")
            for place, key, value in (
                ("grid", "pitch_mm", "inf"),
                ("settle", "limit_px", "nan"),
                ("settle", "longest_s", "nan"),
                ("checks", "leak_dn", "nan"),
            )
        ],
        *[
            ("exposure_s = 0.1\n", f"exposure_s = {value}\n", "BadValue", f"step[6].exposure_s = {shown}; numbers are")
            for value, shown in (("inf", "inf"), ("nan", "nan"), ("1e308", "1e+308"), ("1" + 400 * "0", "1" + 23 * "0"))
        ],
        ("origin_mm = [-350.0", "origin_mm = [-inf", "BadValue", "grid.origin_mm[0] = -inf; numbers are finite"),
        *[
            (f"{key} = ", f"{key} = {value} #", "BadValue", f"{key} = {value}; a share lies between 0 and 1")
            for key, value in (("saturated_share", "7"), ("sharpness_share", "-0.5"))
        ],
        ("size_px = [64, 48]", "size_px = [200000, 200000]", "BadValue", "40000000000 pixels, at most 40000000 are"),
        (
            "rows = 7\ncolumns = 7",
            "rows = 100000\ncolumns = 100000",
            "BadValue",
            "10000000000 nodes, at most",
        ),
        ("frames_per_node = 10", f"frames_per_node = {10**9}", "BadValue", "6000000441 frames, at most 100000 are"),
    ],
)
def test_check_refuses_what_cannot_be_done(shell: Shell, old: str, new: str, failure: str, words: str) -> None:
    shell.edit(old, new)
    assert shell.run("check", shell.rig) == 1
    assert f"faintfield: {failure}: " in shell.words
    assert words in shell.words
    assert len(shell.words.splitlines()) == 1
    assert shell.run("capture", shell.rig, shell.session, "--yes") == 1
    assert not (shell.session / "plan.json").exists()


def test_check_asks_for_room_on_the_disk(shell: Shell) -> None:
    shell.edit("size_px = [64, 48]", "size_px = [6000, 6000]")
    shell.edit("frames_per_node = 10", "frames_per_node = 1600")
    assert shell.run("check", shell.rig) == 1
    assert "faintfield: DiskFull: " in shell.words
    assert "are needed" in shell.words


def test_init_overwrites_nothing(shell: Shell) -> None:
    before = shell.rig.read_bytes()
    assert shell.run("init", shell.rig) == 1
    assert "OutputExists" in shell.words
    assert shell.rig.read_bytes() == before


def test_prompts_need_somebody_to_answer(shell: Shell) -> None:
    assert shell.run("capture", shell.rig, shell.session) == 2
    assert "give --yes, or --page" in shell.words


def test_ctrl_c_stops_after_the_present_frame_and_running_again_goes_on(shell: Shell) -> None:
    small(shell)
    expose = SimulatedLab.expose
    calls = []

    def interrupted(lab: SimulatedLab, exposure_s: float, number: int) -> Any:
        calls.append(number)
        if number == 7:
            signal.raise_signal(signal.SIGINT)
        return expose(lab, exposure_s, number)

    before = signal.getsignal(signal.SIGINT)
    with mock.patch.object(SimulatedLab, "expose", interrupted):
        assert shell.run("capture", shell.rig, shell.session, "--yes") == 1
    assert signal.getsignal(signal.SIGINT) is before
    assert "CaptureStopped: stopped with 7 of 96 frames taken; run the same command to go on" in shell.words
    verdict = shell.result("verify", shell.session)["session"]
    assert (verdict["present"], len(verdict["missing"]), verdict["sealed"]) == (7, 89, False)
    assert "89 still to be taken" in shell.words
    assert shell.result("capture", shell.rig, shell.session, "--yes")["taken"] == 89
    assert "7 of 96 frames are there; going on" in shell.words
    assert shell.result("capture", shell.rig, shell.session, "--yes")["taken"] == 0
    assert shell.result("verify", shell.session)["session"]["sealed"] is True


def test_a_session_stays_with_its_rig_and_with_one_capture(shell: Shell) -> None:
    small(shell)
    with mock.patch.object(SimulatedLab, "expose", side_effect=KeyboardInterrupt):
        assert shell.run("capture", shell.rig, shell.session, "--yes") == 1
    assert "Interrupted" in shell.words
    with lock_session(shell.session):
        assert shell.run("capture", shell.rig, shell.session, "--yes") == 1
        assert "SessionBusy" in shell.words
        assert shell.run("verify", shell.session) == 1
    shell.edit("pitch_mm = 50.0", "pitch_mm = 40.0")
    assert shell.run("capture", shell.rig, shell.session, "--yes") == 1
    assert "PlanRefused: the rig.toml differs from the plan.json of the session: grid.pitch_mm was 50.0" in shell.words


def test_check_compares_with_a_session_that_is_to_be_resumed(shell: Shell) -> None:
    small(shell)
    assert shell.run("check", shell.rig, "--session", shell.session) == 1
    assert "MissingFile" in shell.words
    with mock.patch.object(SimulatedLab, "expose", side_effect=KeyboardInterrupt):
        assert shell.run("capture", shell.rig, shell.session, "--yes") == 1
    assert shell.result("check", shell.rig, "--session", shell.session)["changed_since_session"] == []
    assert "a resume would be accepted; no settings differ" in shell.words
    shell.edit("leak_dn = 8.0", "leak_dn = 9.0")
    changed = ["checks.leak_dn was 8.0 and is 9.0"]
    assert shell.result("check", shell.rig, "--session", shell.session)["changed_since_session"] == changed
    assert f"session: {changed[0]}; would apply from the resume on" in shell.words
    shell.edit("pitch_mm = 50.0", "pitch_mm = 40.0")
    assert shell.run("check", shell.rig, "--session", shell.session) == 1
    assert f"session: {changed[0]}; would apply from the resume on" in shell.words
    assert "session: grid.pitch_mm was 50.0 and is 40.0; the session keeps the old value" in shell.words
    assert "PlanRefused: the rig.toml differs" in shell.words
    with Journal(shell.session / "journal.sqlite", read_only=True) as journal:
        assert journal.events("setting_changed") == []
    shell.edit("pitch_mm = 40.0", "pitch_mm = 50.0")
    assert shell.run("capture", shell.rig, shell.session, "--yes") == 0
    assert f"{changed[0]}, from now on" in shell.words
    assert shell.result("check", shell.rig, "--session", shell.session)["changed_since_session"] == []
    assert "it is complete, nothing is left to capture" in shell.words


def test_verify_says_what_is_wrong(shell: Shell) -> None:
    small(shell)
    shell.result("capture", shell.rig, shell.session, "--yes")
    for path in sorted((shell.session / "frames").iterdir())[:20]:
        path.unlink()
    assert shell.run("verify", shell.session) == 1
    assert shell.words.count("problem: ") == 10
    assert "SessionCorrupt" in shell.words
    assert shell.run("verify", shell.session / "absent") == 1
    assert "MissingFile" in shell.words


def test_noise_is_measured_from_the_frames_of_a_session_which_stays_whole(shell: Shell) -> None:
    assert shell.run("capture", small(shell).rig, shell.session, "--yes") == 0
    measured = shell.result("noise", shell.session)
    for name, truth in (("offset_dn", 100.0), ("gain_dn_per_e", 2.0), ("read_noise_e", 12**0.5)):
        assert abs(measured[name]["value"] - truth) <= 4 * measured[name]["se"]
    assert len(measured["frames"]) == 60
    verified = shell.result("verify", shell.session)
    assert (verified["session"]["problems"], verified["results"]["problems"]) == ([], [])
