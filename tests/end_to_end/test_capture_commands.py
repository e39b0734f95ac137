"""init, check, capture and verify, as a person types them."""

import json
import math
import shutil
import signal
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import tifffile

from faintfield.pipelines import cli
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.session import taken_frames
from faintfield.rig.simulation.lab import TRUE_LIGHTS, SimulatedLab
from tests.end_to_end.rigs import write_small_rig
from tests.faults.capturing import events

# Kind and frames of each step of the rig.toml that `init` writes, on a grid of 2 x 2, with a frame for each exposure.
STEPS = [*[("charuco", 4)] * 6, ("bright", 4), ("dark_scene", 4), ("noise_reference", 4), ("dark", 4), ("flat", 4)]
FRAMES = sum(count for _, count in STEPS)


class Shell:
    """Runs commands and keeps what they printed."""

    def __init__(self, capsys: pytest.CaptureFixture[str], folder: Path) -> None:
        self._capsys = capsys
        self.rig = folder / "rig.toml"
        self.session = folder / "session"
        self.output = self.words = ""

    def run(self, *arguments: object) -> int:
        self._capsys.readouterr()
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
    write_small_rig(shell.rig, 7, 7, frames=10)
    return shell


@pytest.fixture
def small(shell: Shell) -> Shell:
    """Return a shell beside a rig.toml of few frames."""
    shell.rig.unlink()
    write_small_rig(shell.rig, 2, 2)
    return shell


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Capture the whole experiment on a small grid; to be read only."""
    folder = tmp_path_factory.mktemp("whole")
    write_small_rig(folder / "rig.toml", 2, 2)
    assert cli.run(["capture", str(folder / "rig.toml"), str(folder / "session"), "--yes"]) == 0
    return folder / "session"


def test_whole_experiment_unattended(whole: Path, shell: Shell) -> None:
    verdict = shell.result("verify", whole)["session"]
    assert verdict["problems"] == []
    assert (verdict["planned"], verdict["present"], verdict["sealed"]) == (FRAMES, FRAMES, True)
    frames = [frame for frame, _, _ in taken_frames(whole)]
    assert [(kind, sum(frame.step == step for frame in frames)) for step, (kind, _) in enumerate(STEPS)] == STEPS
    assert [frame.kind for frame in frames] == [kind for kind, count in STEPS for _ in range(count)]
    assert [frame.number for frame in frames] == list(range(FRAMES))
    assert [frame.stop.node for frame in frames[:4]] == [(0, 0), (0, 1), (1, 1), (1, 0)]
    assert {frame.exposure_s for frame in frames if frame.kind == "dark"} == {0.05, 0.1, 0.5, 1.0}
    with Journal(whole / "journal.sqlite", read_only=True) as journal:
        assert [committed.frame for committed in journal.committed()] == list(range(FRAMES))
        assert not journal.uncommitted()
        assert len(journal.events("drift_check")) == 9
        assert len(journal.events("settling")) == 1


def test_verify_names_missing_frames(whole: Path, shell: Shell) -> None:
    shutil.copytree(whole, shell.session)
    for path in sorted((shell.session / "frames").iterdir())[:20]:
        path.unlink()
    assert shell.run("verify", shell.session) == 1
    assert shell.words.count("problem: ") == 10
    assert "SessionCorrupt" in shell.words
    assert f"{FRAMES - 20} of {FRAMES} frames present and whole, damaged" in shell.words
    assert shell.run("verify", shell.session / "absent") == 1
    assert "MissingFile" in shell.words


def test_check_moves_nothing_and_counts_frames(shell: Shell) -> None:
    with (
        mock.patch("faintfield.rig.stages.gantry.Gantry.move_to") as move,
        mock.patch("faintfield.rig.stages.gantry.Gantry.home") as home,
    ):
        result = shell.result("check", shell.rig)
        assert not move.called
        assert not home.called
    assert result["frames"] == 521
    assert result["disk_bytes"] == 521 * (2 * 64 * 48 + 512)
    assert 300.0 < result["duration_s"] < 1200.0
    assert "521 frames in 11 steps" in shell.words


LIGHTS = """
[[light]]
name = "room"
driver = "controller"
output = "flood"
[[light]]
name = "lamp"
driver = "command"
on = ["/bin/true"]
off = ["{off}"]
"""


def test_check_tries_lights_without_motion(shell: Shell) -> None:
    shell.edit("# The steps,", LIGHTS.format(off="/bin/true") + "# The steps,")
    assert shell.result("check", shell.rig)["lights"] == {
        "room": "switched on and off, which it reports",
        "lamp": "switched on and off; it reports nothing",
    }
    assert "light room: switched on and off" in shell.words
    shell.edit('off = ["/bin/true"]', 'off = ["/bin/false"]')
    assert shell.run("check", shell.rig) == 1
    assert "LightError: light lamp: /bin/false ended with exit code 1; run it by hand" in shell.words


LIT_RIG = """
stage = {protocol = "simulated", port = "simulated:marlin"}
camera = {backend = "simulated", size_px = [64, 48]}
grid = {rows = 1, columns = 2, pitch_mm = 50.0, origin_mm = [50.0, 50.0]}
light = [
    {name = "room", driver = "controller", output = "fan", number = 1},
    {name = "scene", driver = "controller", output = "pin", number = 57},
    {name = "shutter", driver = "simulated"},
]
step = [
    {kind = "bright", exposure_s = 0.1, lights = ["room", "shutter"]},
    {kind = "dark_scene", exposure_s = 0.1, lights = ["scene", "shutter"]},
    {kind = "noise_reference", exposure_s = 0.1, lights = []},
    {kind = "dark", exposure_s = 0.1, lights = ["room"]},
]
"""


def test_lights_of_a_rig_file_shine_in_its_capture(shell: Shell) -> None:
    shell.rig.write_text(LIT_RIG)
    assert shell.run("capture", shell.rig, shell.session, "--yes") == 0, shell.words
    assert f"next: faintfield run {shell.session} --depth-mm DEPTH" in shell.words
    frames = [committed.record for _, committed, _ in taken_frames(shell.session)]
    shone = [record.camera[TRUE_LIGHTS] for record in frames]
    assert shone == ["room,shutter"] * 2 + ["scene,shutter"] * 2 + [""] * 2 + ["room"]
    assert [",".join(record.lights or ()) for record in frames] == shone
    lit, faint, dark = (frames[index].checks["mean_dn"] for index in (0, 2, 4))
    assert lit > faint + 1000.0 > dark + 1000.0


@pytest.mark.parametrize(
    ("kinds", "commands"),
    [
        (["dark"], ["noise"]),
        (["charuco"], ["geometry"]),
        (["charuco", "dark"], ["noise", "geometry"]),
        (["bright"], ["verify"]),
    ],
)
def test_next_command_fits_kinds_of_frames(kinds: list[str], commands: list[str], shell: Shell) -> None:
    text = shell.rig.read_text()
    steps = "".join(f'[[step]]\nkind = "{kind}"\nexposure_s = 0.1\n' for kind in kinds)
    shell.rig.write_text(
        text[: text.index("[[step]]")].replace("rows = 7\ncolumns = 7", "rows = 1\ncolumns = 2") + steps
    )
    assert shell.run("capture", shell.rig, shell.session, "--yes") == 0, shell.words
    named = " and ".join(f"faintfield {command} {shell.session}" for command in commands)
    assert f"frames taken; next: {named}\n" in shell.words


def test_check_remembers_settings_of_stage(shell: Shell) -> None:
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
            "[[stage.keep_out]]\nx_mm = [-260, 0]\ny_mm = [-260, 0]\n#",
            "KeepOutCrossed",
            "meets",
        ),
        ("pitch_mm", "pich_mm", "UnknownKey", "did you mean 'pitch_mm'?"),
        ('protocol = "simulated"', 'protocol = "klipper"', "UnknownPlugin", "choose from 'grbl', 'marlin', "),
        ('backend = "simulated"', 'backend = "gphoto2"', "UnknownKey", "'camera.size_px' is not a key"),
        ("square_mm = 40.0", "square_mm = 4.0", "BadValue", "markers smaller"),
        ("exposure_s = 0.1\n", "exposure_s = nan\n", "BadValue", "step[6].exposure_s = nan; numbers are"),
        ("size_px = [64, 48]", "size_px = [200000, 200000]", "BadValue", "at most 40000000 are"),
        ("rows = 7\ncolumns = 7", "rows = 100000\ncolumns = 100000", "BadValue", "10000000000 nodes, at most"),
        ("frames_per_node = 10", f"frames_per_node = {10**9}", "BadValue", "at most 100000 are"),
    ],
)
def test_check_refuses_impossible_rigs(shell: Shell, old: str, new: str, failure: str, words: str) -> None:
    shell.edit(old, new)
    assert shell.run("check", shell.rig) == 1
    assert f"faintfield: {failure}: " in shell.words
    assert words in shell.words
    assert len(shell.words.splitlines()) == 1
    assert shell.run("capture", shell.rig, shell.session, "--yes") == 1
    assert f"faintfield: {failure}: " in shell.words
    assert not (shell.session / "plan.json").exists()


def test_check_asks_for_room_on_disk(shell: Shell) -> None:
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
    assert shell.run("capture", shell.rig, shell.session) == 2
    assert "give --yes, or --page" in shell.words


def test_capture_resumes_after_ctrl_c(small: Shell) -> None:
    expose = SimulatedLab.expose
    calls = []

    def interrupted(lab: SimulatedLab, exposure_s: float, number: int) -> Any:
        calls.append(number)
        if number == 7:
            signal.raise_signal(signal.SIGINT)
        return expose(lab, exposure_s, number)

    before = signal.getsignal(signal.SIGINT)
    with mock.patch.object(SimulatedLab, "expose", interrupted):
        assert small.run("capture", small.rig, small.session, "--yes") == 1
    assert signal.getsignal(signal.SIGINT) is before
    assert "CaptureStopped: stopped with 7 of 44 frames taken; run the same command to go on" in small.words
    verdict = small.result("verify", small.session)["session"]
    assert (verdict["present"], len(verdict["missing"]), verdict["sealed"]) == (7, 37, False)
    assert "37 still to be taken" in small.words
    assert small.result("capture", small.rig, small.session, "--yes")["taken"] == 37
    assert "7 of 44 frames are there; going on" in small.words
    assert small.result("capture", small.rig, small.session, "--yes")["taken"] == 0
    assert small.result("verify", small.session)["session"]["sealed"] is True


def test_check_compares_rig_with_session(small: Shell) -> None:
    assert small.run("check", small.rig, "--session", small.session) == 1
    assert "MissingFile" in small.words
    with mock.patch.object(SimulatedLab, "expose", side_effect=KeyboardInterrupt):
        assert small.run("capture", small.rig, small.session, "--yes") == 1
    assert small.result("check", small.rig, "--session", small.session)["changed_since_session"] == []
    assert "a resume would be accepted; no settings differ" in small.words
    small.edit("leak_dn = 8.0", "leak_dn = 9.0")
    changed = ["checks.leak_dn was 8.0 and is 9.0"]
    assert small.result("check", small.rig, "--session", small.session)["changed_since_session"] == changed
    assert f"session: {changed[0]}; would apply from the resume on" in small.words
    small.edit("pitch_mm = 50.0", "pitch_mm = 40.0")
    assert small.run("check", small.rig, "--session", small.session) == 1
    assert f"session: {changed[0]}; would apply from the resume on" in small.words
    assert "session: grid.pitch_mm was 50.0 and is 40.0; the session keeps the old value" in small.words
    assert "PlanRefused: the rig.toml differs" in small.words
    assert small.run("capture", small.rig, small.session, "--yes") == 1
    assert "PlanRefused: the rig.toml differs from the plan.json of the session: grid.pitch_mm was 50.0" in small.words
    assert events(small.session, "setting_changed") == []
    small.edit("pitch_mm = 40.0", "pitch_mm = 50.0")
    assert small.run("capture", small.rig, small.session, "--yes") == 0
    assert f"{changed[0]}, from now on" in small.words
    assert small.result("check", small.rig, "--session", small.session)["changed_since_session"] == []
    assert "it is complete, nothing is left to capture" in small.words


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--light-e", "1"], "the light is compared on the page or in a terminal, and there is neither; give --page"),
        (["--noise", "noise.json"], "--noise is of live planes, rounds and the light; give --live-depth-mm or"),
        (["--fx-px", "800"], "--geometry and --fx-px are of live planes and of rounds; give --live-depth-mm"),
    ],
)
def test_options_of_views_need_a_view(options: list[str], words: str, shell: Shell) -> None:
    assert shell.run("capture", shell.rig, shell.session, "--yes", *options) == 2
    assert words in shell.words
    assert not shell.session.exists()


def test_rounds_end_at_noise_of_frames(shell: Shell) -> None:
    shell.rig.unlink()
    write_small_rig(shell.rig, 3, 3)
    text = shell.rig.read_text()
    until = "until = { sigma_e = 0.8, at_most_rounds = 12 }"
    head = text[: text.index("[[step]]")].replace("[500.0, 700.0]", "[500.0]")
    head = head.replace("position_error_mm = 0.3", "position_error_mm = 0.0")
    head = head.replace("rotation_error_mrad = 3.5", "rotation_error_mrad = 0.0")
    shell.rig.write_text(f'{head}[[step]]\nkind = "dark_scene"\nexposure_s = 1.0\n{until}\n')
    assert shell.result("check", shell.rig)["frames"] == 9 * 12
    assert shell.run("capture", shell.rig, shell.session, "--yes", "--light-e", "20") == 0, shell.words
    [ended] = shell.result("verify", shell.session)["session"]["rounds"]
    assert f"step 1 ended after {ended['rounds']} rounds, at a predicted σ of" in shell.words
    # The scatter of pixels between two rounds, in electrons, where the frames are brightest; the gain is 2
    nodes: dict[tuple[int, int], list[Any]] = {}
    for frame, _, path in taken_frames(shell.session):
        nodes.setdefault(frame.stop.node, []).append(tifffile.imread(path).astype(float) / 2.0)
    variances_e2 = []
    for frames in nodes.values():
        parts = np.stack(frames).reshape(len(frames), 8, 6, 8, 8)  # rows and columns of 8 x 8 parts
        row, column = np.unravel_index(parts.mean(axis=(0, 2, 4)).argmax(), (8, 8))
        variances_e2.append(np.var(parts[:, row, :, column], axis=0, ddof=1).mean())
    # The picture moves by 8 whole pixels from node to node, so that each sample meets one pixel of each view
    sigma_of_round_e = math.sqrt(np.mean(variances_e2) / 9)
    assert abs(ended["rounds"] - math.ceil((sigma_of_round_e / 0.8) ** 2)) <= 1
    assert ended["sigma_e"] == pytest.approx(sigma_of_round_e / math.sqrt(ended["rounds"]), rel=0.06)
