"""Damaged and foreign files: no traceback, no hang, no memory without bound, no touch outside the command's folder."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from faintfield.pipelines.cli import run
from tests.faults import mutation_operations
from tests.faults.contained import ONE_THREAD
from tests.faults.mutation_kinds import KINDS
from tests.faults.mutation_operations import VICTIM

_MAX_SECONDS = 3600  # for a machine that does much else

_DARKEN, _BACKPROJECT = "darken IN OUT", "reconstruct IN --out OUT --depth-mm 500 --method backprojection"

# A kind of files, a file, an operation on it, a command, and words of its failure
DAMAGED: dict[str, tuple[str, str, str, list[Any], str, str]] = {
    "lens": (
        *("elemental set", "elemental.toml", "set", [["camera", "distortion"], "[-9.0]"], _BACKPROJECT),
        "LensNotInvertible",
    ),
    "saturation": (
        *("elemental set", "elemental.toml", "set", [["noise", "saturation_dn"], "1.0"], _BACKPROJECT),
        "sees the plane",
    ),
    "half a view": ("elemental set", "view_r1_c1.tiff", "splice", [200, 1 << 60, ""], _DARKEN, "view_r1_c1.tiff"),
    "pipe": ("elemental set", "view_r1_c1.tiff", "become", ["pipe"], _DARKEN, "MissingFile"),
    "JPEG": ("pictures", "8_bits/*.jpg", "splice", [100, 1 << 60, ""], "import grid IN/8_bits OUT", "view_r0_c1.jpg"),
    "PNG": ("pictures", "16_bits/*.png", "flip", [[[99, 1]]], "import grid IN/16_bits OUT", "UnreadableImage"),
    "rig": ("rig", "rig.toml", "set", [["grid", "rows"], "100000"], "check IN/rig.toml", "BadValue: IN/rig.toml"),
    "noise set": ("noise set", "noise.toml", "splice", [40, 20, "00"], "noise IN --out OUT", "IN/noise.toml"),
    "EMVA": ("EMVA 1288", "descriptor.txt", "splice", [0, 8, "ff"], "import emva1288 IN/descriptor.txt OUT", "line 1"),
    "frame": ("complete session", "session/frames/00001*", "flip", [[[150, 1]]], "verify IN/session", "was altered"),
    "journal": ("complete session", "session/journal.sqlite", "splice", [4096, 64, ""], "verify IN/session", "journal"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_file_is_refused_in_one_line(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    kind, file, operation, arguments, command, words = DAMAGED[name]
    KINDS[kind].seed(tmp_path / "IN")
    (tmp_path / VICTIM).touch()
    monkeypatch.chdir(tmp_path)
    capfd.readouterr()
    path = next((tmp_path / "IN").glob(file))
    mutation_operations.apply(path, operation, arguments)
    before = set(tmp_path.rglob("*"))
    assert run(command.split()) == 1
    said, complaint = capfd.readouterr()
    assert said == ""
    *report, failure = complaint.splitlines()
    assert all(line.startswith(("reconstructing planes: ", "problem: ", "IN/session: ")) for line in report)
    assert failure.startswith("faintfield: ")
    assert words in failure
    assert set(tmp_path.rglob("*")) == before


@pytest.mark.deep
@pytest.mark.timeout(_MAX_SECONDS)
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_files_are_read_or_refused(kind: str) -> None:
    if kind == "raw picture" and "FAINTFIELD_DATA" not in os.environ:
        pytest.skip("needs FAINTFIELD_DATA")
    words = [sys.executable, "-m", "tests.faults.mutations", kind, f"0:{KINDS[kind].cases}"]
    root = Path(__file__).parents[2]
    ended = subprocess.run(words, cwd=root, env=os.environ | ONE_THREAD, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
