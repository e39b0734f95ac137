"""The documents agree with the code and with each other."""

import importlib.util
import inspect
import json
import re
from pathlib import Path
from types import ModuleType

import pytest

import faintfield.calib.errors
import faintfield.pipelines.errors
import faintfield.recon.errors
import faintfield.rig.errors

_ROOT = Path(__file__).parents[1]
_DOCUMENTS = [*sorted(_ROOT.glob("*.md")), *sorted((_ROOT / "docs").rglob("*.md"))]
_INDEXED = ("rig", "calib", "recon", "pipelines", "testing", "benchmarks")
# Base classes: a person meets only the failures derived from them.
_NEVER_BY_ITSELF = {
    "RigError",
    "StageError",
    "SessionError",
    "CalibrationError",
    "ReconstructionError",
    "InputError",
} | {"ArrangementError"}


def _collect_results() -> ModuleType:
    """Return docs/collect_results.py, which is a script and in no package."""
    spec = importlib.util.spec_from_file_location("collect_results", _ROOT / "docs" / "collect_results.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_results_of_the_readme_are_those_of_the_file() -> None:
    script = _collect_results()
    readme = (_ROOT / "README.md").read_text()
    results = json.loads((_ROOT / "docs" / "results.json").read_text())
    assert script.filled(readme, results) == readme
    results["planes"][0]["mse_bright"] += 0.5
    assert script.filled(readme, results) != readme


def test_results_are_collected_from_a_demo(tmp_path: Path) -> None:
    script = _collect_results()
    row = {"depth_mm": 500.0, "method": "pmlem", "poses": "measured", "mse_bright": 0.0123456, "psnr_db": 19.0}
    metrics = {"planes": [row], "snr": {"measured": 0.1561}, "photons_per_px": {"from_moments": 1.9222}}
    (tmp_path / "dark").mkdir()
    (tmp_path / "dark" / "reconstruction.json").write_text(json.dumps({"versions": {"faintfield": "9.9"}}))
    known = {"value": 3.46412, "se": 0.00123, "truth": 3.4641016}
    measured = {"noise": dict.fromkeys(("gain_dn_per_e", "read_noise_e", "dark_current_e_per_s"), known)}
    (tmp_path / "metrics.json").write_text(json.dumps(metrics | measured | {"geometry": {"centre_rms_mm": 0.03456}}))
    results = script.collect(tmp_path)
    assert results["planes"][0]["mse_bright"] == 0.0123
    assert script.table(results) == (
        "| mean square error at SNR 0.16, 1.9 photons per pixel | 500 mm |\n|---|---|\n"
        "| PMLEM, to its optimum, measured poses | 0.0123 |\n\n"
        "Measured on the way: camera centres 0.035 mm rms off the true ones; "
        "gain 3.464 ± 0.001 DN/e⁻ (true: 3.464); read noise 3.464 ± 0.001 e⁻ (true: 3.464); "
        "dark current 3.464 ± 0.001 e⁻/s (true: 3.464).\n"
    )


@pytest.mark.parametrize(
    "tree",
    [faintfield.rig.errors, faintfield.calib.errors, faintfield.recon.errors, faintfield.pipelines.errors],
    ids=lambda it: it.__name__,
)
def test_the_guide_says_what_to_do_for_every_named_failure(tree: ModuleType) -> None:
    guide = (_ROOT / "docs" / "guide.md").read_text()
    table = guide[guide.index("## When you see this, do that") :]
    named = {name for name, value in inspect.getmembers(tree, inspect.isclass) if issubclass(value, Exception)}
    assert named
    assert {name for name in named - _NEVER_BY_ITSELF if f"`{name}`" not in table} == set()


@pytest.mark.parametrize("document", _DOCUMENTS, ids=lambda path: path.relative_to(_ROOT).as_posix())
def test_links_lead_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", document.read_text()):
        if not target.startswith("http"):
            name, _, anchor = target.partition("#")
            path = (document.parent / name).resolve() if name else document
            assert path.exists(), target
            if anchor:
                assert anchor in _anchors(path), target


def _anchors(document: Path) -> set[str]:
    """Return the anchors of a document's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", document.read_text(), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def _index() -> dict[str, set[str]]:
    """Return the files that architecture.md lists, by folder; a row without a folder belongs to that of the row above.

    The index is every table that begins `| folder | files |`, with folders and the stems of files in backticks.
    """
    found: dict[str, set[str]] = {}
    folder, inside = "", False
    for line in (_ROOT / "docs" / "architecture.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip().split("|")[1:-1]]
        inside = bool(cells) and (inside or cells[:2] == ["folder", "files"])
        if inside and len(cells) > 1:
            folder = cells[0].strip("`") or folder
            found.setdefault(folder, set()).update(re.findall(r"`([^`]+)`", cells[1]))
    return found


def test_the_index_of_the_code_lists_every_file_in_its_folder_and_no_other() -> None:
    files: dict[str, set[str]] = {}
    for package in _INDEXED:
        for path in (_ROOT / package).rglob("*.py"):
            if path.name not in ("__init__.py", "__main__.py"):
                files.setdefault(path.parent.relative_to(_ROOT).as_posix(), set()).add(path.stem)
    listed = {folder: stems for folder, stems in _index().items() if folder.split("/")[0] in _INDEXED}
    missing = {f"{folder}/{stem}" for folder, stems in files.items() for stem in stems - listed.get(folder, set())}
    gone = {f"{folder}/{stem}" for folder, stems in listed.items() for stem in stems - files.get(folder, set())}
    assert (sorted(missing), sorted(gone)) == ([], [])


def test_decisions_are_numbered_without_gaps_and_each_has_a_status() -> None:
    decisions = sorted((_ROOT / "docs" / "decisions").glob("*.md"))
    assert decisions
    for number, path in enumerate(decisions, start=1):
        title, blank, status, *_ = path.read_text().splitlines()
        assert path.name.startswith(f"{number:03d}-")
        assert title.startswith(f"# {number:03d}: ")
        assert blank == ""
        assert status.startswith("Status: "), path.name


def test_the_hooks_of_pre_commit_are_the_lines_of_make_lint() -> None:
    makefile = (_ROOT / "Makefile").read_text()
    (recipe,) = re.findall(r"^lint:.*\n((?:\t.*\n)+)", makefile, flags=re.MULTILINE)
    lines = [line.strip().replace("$(BIN)", ".venv/bin") for line in recipe.splitlines()]
    hooks = re.findall(r"^ *entry: (.*)$", (_ROOT / ".pre-commit-config.yaml").read_text(), flags=re.MULTILINE)
    assert hooks == lines


def test_every_document_is_two_hops_from_the_readme() -> None:
    readme = (_ROOT / "README.md").read_text()
    for path in (_ROOT / "docs").glob("*.md"):
        assert path.name in readme, path.name
