"""The paper cites its bibliography, shows pictures that exist, and states the figures of docs/results.json."""

import json
import re
import runpy
import tomllib
from pathlib import Path

_ROOT = Path(__file__).parents[1]
_PAPER = _ROOT / "paper" / "paper.md"


def test_citations_are_the_bibliography() -> None:
    cited = set(re.findall(r"(?<![\w.])@([a-z]\w*)", _PAPER.read_text()))
    entries = re.findall(r"^@\w+\{(\w+),$", (_PAPER.parent / "paper.bib").read_text(), flags=re.MULTILINE)
    assert sorted(cited) == sorted(entries)


def test_figures_exist_and_are_mentioned() -> None:
    text = _PAPER.read_text()
    figures = re.findall(r"\\label\{([^}]+)\}\]\(([^)]+)\)", text)
    assert len(figures) == text.count("![")
    for label, path in figures:
        assert (_PAPER.parent / path).is_file(), path
        assert f"\\autoref{{{label}}}" in text, label


def test_table_of_paper_is_the_results() -> None:
    results = json.loads((_ROOT / "docs" / "results.json").read_text())
    filled = runpy.run_path(str(_ROOT / "docs" / "collect_results.py"))["filled"]
    assert filled(_PAPER.read_text(), results) == _PAPER.read_text()


def test_citation_file_names_the_present_version() -> None:
    version = tomllib.loads((_ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"\nversion: {version}\n" in (_ROOT / "CITATION.cff").read_text()
