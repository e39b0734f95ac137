"""Every example in README.md runs as it stands."""

import os
import re
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from pipelines.elemental_set import ElementalSet

_README = Path(__file__).parents[2] / "README.md"
_SKIPPED = ("make ", "git clone ")


def _blocks(*kinds: str) -> list[tuple[str, str]]:
    """Return kind and content of the fenced blocks of some kinds, in order."""
    found = re.findall(r"^```(\w+)\n(.*?)^```$", _README.read_text(), flags=re.DOTALL | re.MULTILINE)
    return [(kind, content) for kind, content in found if kind in kinds]


def test_there_are_examples_for_the_shell_and_for_python() -> None:
    assert {kind for kind, _ in _blocks("sh", "python")} == {"sh", "python"}


@pytest.mark.timeout(240)
def test_its_examples_run_one_after_the_other(tmp_path: Path) -> None:
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    for kind, content in _blocks("sh", "python"):
        lines = [line for line in content.splitlines() if not line.startswith(_SKIPPED)]
        command = ["bash", "-euo", "pipefail", "-c"] if kind == "sh" else [sys.executable, "-c"]
        ended = subprocess.run(
            [*command, "\n".join(lines)], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert ended.returncode == 0, f"{content}\n{ended.stderr}"


def test_its_settings_file_is_one() -> None:
    blocks = _blocks("toml")
    assert blocks
    for _, content in blocks:
        settings = msgspec.toml.decode(content, type=ElementalSet)
        assert settings.view[settings.reference_view].rt_cam_ref == (0.0,) * 6
