"""The shell and Python examples of each document run one after the other, in one folder; in deep as they stand."""

import re
import shlex
import subprocess
from pathlib import Path

import msgspec
import pytest
from matplotlib.figure import Figure

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.sets.elemental_file import ElementalSetFile
from tests.drawings import save_empty

_ROOT = Path(__file__).parents[2]
_SKIPPED = ("make ", "git clone ")
# A line, or all lines of a here-document.
_COMMAND = re.compile(r"^(.+<< *'?(\w+)'?.*\n[\s\S]*?^\2$|.+)$", re.MULTILINE)

# Smaller numbers for the examples of the README, so that all of them run with the quick tests.
SMALLER = {
    "--size-px 480 360": "--size-px 96 72 --rows 3 --columns 3",
    "--fx-px 600": "--fx-px 120 --no-align",
    "--depth auto": "--depth 500 --method backprojection",
    "--surface --out": "--surface --depth-range-mm 400:900 --passes 3 --penalty-weight 1 --out",
    "plane(500.0, uncertainty=True)": "plane(500.0, uncertainty=True, prior='tv', passes=3, penalty_weight=1.0)",
}


def _blocks(document: str, *kinds: str) -> list[tuple[str, str]]:
    """Return kind and content of the fenced blocks of some kinds, in order."""
    text = (_ROOT / document).read_text()
    found = re.findall(r"^```(\w+)\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)
    return [(kind, content) for kind, content in found if kind in kinds]


_PAGES = [path for folder in ("tutorials", "how-to") for path in sorted((_ROOT / "docs" / folder).glob("*.md"))]
_LESSONS = [str(path.relative_to(_ROOT)) for path in _PAGES]
DOCUMENTS = ["README.md", *(lesson for lesson in _LESSONS if _blocks(lesson, "sh", "python"))]


def _run_examples(blocks: list[tuple[str, str]]) -> None:
    """Run the examples in the present folder; the Python blocks share their names, as in a notebook."""
    names: dict[str, object] = {}
    for kind, content in blocks:
        if kind == "python":
            exec(content, names)
            continue
        for command, _ in re.findall(_COMMAND, content):
            if command.startswith("faintfield "):
                assert run(shlex.split(command, comments=True)[1:]) == 0, command
            elif not command.startswith(_SKIPPED):
                subprocess.run(["bash", "-euo", "pipefail", "-c", command], check=True)


def test_examples_of_readme_run_with_smaller_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Figure, "savefig", save_empty)
    blocks = _blocks("README.md", "sh", "python")
    for old, new in SMALLER.items():
        assert any(old in content for _, content in blocks), old
        blocks = [(kind, content.replace(old, new)) for kind, content in blocks]
    assert {kind for kind, _ in blocks} == {"sh", "python"}
    _run_examples(blocks)


@pytest.mark.deep
@pytest.mark.parametrize("document", DOCUMENTS)
def test_examples_run_as_they_stand(document: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = _blocks(document, "sh", "python")
    assert blocks
    _run_examples(blocks)


def test_settings_file_of_documents_is_valid() -> None:
    blocks = _blocks("docs/how-to/elemental_set.md", "toml")
    assert blocks
    for _, content in blocks:
        settings = msgspec.toml.decode(content, type=ElementalSetFile)
        assert settings.view[settings.reference_view].rt_cam_ref == (0.0,) * 6
