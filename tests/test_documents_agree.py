"""Documents agree with what they describe: links, the figures of docs/quality.md, and the keys of result files."""

import importlib.util
import json
import re
from pathlib import Path
from pkgutil import resolve_name
from types import ModuleType

from msgspec import inspect as types

from faintfield.pipelines.formats.key_meanings import key_meanings
from faintfield.pipelines.workflows.schema import records_of

_ROOT = Path(__file__).parents[1]
_DOCUMENTS = [*sorted(_ROOT.glob("*.md")), *sorted((_ROOT / "docs").rglob("*.md"))]


def _collect_results() -> ModuleType:
    """Return docs/collect_results.py, which is a script and in no package."""
    spec = importlib.util.spec_from_file_location("collect_results", _ROOT / "docs" / "collect_results.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_figures_of_documents_are_the_results() -> None:
    script = _collect_results()
    page = (_ROOT / "docs" / "quality.md").read_text()
    results = json.loads((_ROOT / "docs" / "results.json").read_text())
    assert script.filled(page, results) == page
    results["planes"][0]["mse_texture"] += 0.5
    assert script.filled(page, results) != page


def test_links_lead_somewhere() -> None:
    for document in _DOCUMENTS:
        for target in re.findall(r"\]\(([^)\s]+)\)", document.read_text()):
            if not target.startswith("http"):
                name, _, anchor = target.partition("#")
                path = (document.parent / name).resolve() if name else document
                assert path.exists(), (document, target)
                assert not anchor or anchor in _anchors(path), (document, target)


def test_benchmarks_of_documents_exist() -> None:
    for document in _DOCUMENTS:
        for module in re.findall(r"python -m (benchmarks[\w.]*)", document.read_text()):
            assert importlib.util.find_spec(module), (document, module)


def test_keys_of_result_files_have_meanings() -> None:
    pages = [page.read_text() for page in (_ROOT / "docs" / "reference" / "formats").glob("*.md")]
    files = [resolve_name(name) for page in pages for name in re.findall(r"{json-format} (\S+)", page)]
    assert files
    for record in records_of(types.multi_type_info(files)):
        assert not {field.name for field in record.fields} - key_meanings(record.cls).keys(), record.cls


def _anchors(document: Path) -> set[str]:
    """Return the anchors of a document's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", document.read_text(), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
