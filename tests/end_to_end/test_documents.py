"""The shell and Python examples of each document run as they stand, one after the other, in one folder."""

import os
import re
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from faintfield.pipelines.formats.sets.elemental_file import ElementalSetFile

_ROOT = Path(__file__).parents[2]
_SKIPPED = ("make ", "git clone ")
# The Python blocks of api.md share their names, as in a notebook.
DOCUMENTS = {"README.md": False, "docs/guide.md": False, "docs/api.md": True}


def _blocks(document: str, *kinds: str) -> list[tuple[str, str]]:
    """Return kind and content of the fenced blocks of some kinds, in order."""
    text = (_ROOT / document).read_text()
    found = re.findall(r"^```(\w+)\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)
    return [(kind, content) for kind, content in found if kind in kinds]


@pytest.mark.parametrize("document", ["README.md", "docs/guide.md"])
def test_there_are_examples_for_the_shell_and_for_python(document: str) -> None:
    assert {kind for kind, _ in _blocks(document, "sh", "python")} == {"sh", "python"}


@pytest.mark.parametrize(
    "document", [pytest.param(it, marks=() if it == "docs/api.md" else pytest.mark.slow) for it in DOCUMENTS]
)
def test_its_examples_run_one_after_the_other(document: str, tmp_path: Path) -> None:
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONWARNINGS": "error",
    }
    blocks = _blocks(document, "sh", "python")
    if DOCUMENTS[document]:
        blocks = [("python", "\n".join(content for _, content in blocks))]
    for kind, content in blocks:
        lines = [line for line in content.splitlines() if not line.startswith(_SKIPPED)]
        command = ["bash", "-euo", "pipefail", "-c"] if kind == "sh" else [sys.executable, "-c"]
        ended = subprocess.run(
            [*command, "\n".join(lines)], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert ended.returncode == 0, f"{content}\n{ended.stderr}"


def test_the_settings_file_of_the_readme_is_one() -> None:
    blocks = _blocks("README.md", "toml")
    assert blocks
    for _, content in blocks:
        settings = msgspec.toml.decode(content, type=ElementalSetFile)
        assert settings.view[settings.reference_view].rt_cam_ref == (0.0,) * 6
