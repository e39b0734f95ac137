"""Commands that do without a rig, where Python offers only what it offers on Windows; locks there."""

import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from faintfield.pipelines.errors import OutputBusy
from faintfield.pipelines.formats.files import exclusive, shared
from faintfield.rig import files
from tests.pipelines.sessions import rig_toml
from tests.windows import Msvcrt, Sys

_OF_A_SET = """
simulate scene --rows 2 --columns 2 --size-px 96 72
reconstruct scene --depth-mm 500 --prior tv --passes 3 --penalty-weight 2 --workers 1 --out out
report out
verify out
export nerfstudio scene transforms
import nerfstudio transforms imported --images scene
"""
_OF_A_SESSION = """
capture rig.toml session --yes
noise session
verify session
"""


@pytest.mark.parametrize(
    "commands", [pytest.param(_OF_A_SET, id="set"), pytest.param(_OF_A_SESSION, id="session", marks=pytest.mark.deep)]
)
def test_commands_work_without_posix(commands: str, tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(rig_toml(("dark_scene", "dark", "flat"), rows=2, columns=2))
    command = [sys.executable, "-X", "warn_default_encoding", "-m", "tests.windows", str(tmp_path), commands.strip()]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr


@pytest.mark.parametrize("windows", [False, True])
def test_shared_locks_exclude_exclusive_ones_alone(
    windows: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if windows:
        monkeypatch.setattr(files, "sys", Sys("sys"))
        monkeypatch.setattr(files, "msvcrt", Msvcrt(), raising=False)
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    out = tmp_path / "out"
    for _ in range(2):  # a lock that has ended is no hindrance
        with shared(out), shared(out):
            with pytest.raises(OutputBusy), exclusive(out):
                pass
        with exclusive(out):
            with pytest.raises(OutputBusy), exclusive(out):
                pass
            with pytest.raises(OutputBusy), shared(out):
                pass
            with exclusive(tmp_path / "another"):
                pass
