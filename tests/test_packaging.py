"""The distribution holds one package with all of its files; `import faintfield` offers the public names."""

import ast
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib import import_module
from pathlib import Path

import pytest

import faintfield

_ROOT = Path(__file__).parents[1]
_FOLDERS = ("rig", "calib", "recon", "pipelines", "testing")
_BUILT_FROM = ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "faintfield", *_FOLDERS, "tests")
# Prints the modules that `import faintfield` loads.
_IMPORT = "import sys; before = set(sys.modules); import faintfield; print(*sorted(set(sys.modules) - before))"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of what the distribution is built from, so that nothing is written into the repository."""
    copy = tmp_path_factory.mktemp("source")
    for name in _BUILT_FROM:
        if (_ROOT / name).is_dir():
            shutil.copytree(_ROOT / name, copy / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(_ROOT / name, copy)
    return copy


def _expected_files() -> set[str]:
    """Return every file of the package as it should be installed, symbolic links followed."""
    found = {"faintfield/__init__.py", "faintfield/py.typed"}
    for folder in _FOLDERS:
        for path in (_ROOT / folder).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                found.add(f"faintfield/{path.relative_to(_ROOT).as_posix()}")
    return found


def _build(call: str, source: Path, out: Path) -> Path:
    """Call one of setuptools' build hooks in the folder, without network, and return the file that it made."""
    out.mkdir(exist_ok=True)
    program = f"from setuptools import build_meta; build_meta.{call}({str(out)!r})"
    subprocess.run([sys.executable, "-c", program], cwd=source, check=True, capture_output=True)
    (made,) = out.iterdir()
    return made


@pytest.mark.deep
def test_archives_hold_the_package_and_nothing_else(source: Path, tmp_path: Path) -> None:
    names = zipfile.ZipFile(_build("build_wheel", source, tmp_path / "wheel")).namelist()
    assert {name for name in names if ".dist-info/" not in name} == _expected_files()
    with tarfile.open(_build("build_sdist", source, tmp_path / "sdist")) as archive:
        members = {member.name.partition("/")[2]: member for member in archive.getmembers()}
    files = {name for name, member in members.items() if member.isfile()}
    assert {name for name in files if name.startswith("faintfield/")} == _expected_files()
    assert {"pyproject.toml", "README.md", "LICENSE"} < files
    assert not any(name.startswith("tests") for name in members)
    assert not any(member.issym() for member in members.values())


def test_wheel_needs_neither_mrcal_nor_second_opencv() -> None:
    project = tomllib.loads((_ROOT / "pyproject.toml").read_text())["project"]
    needed = {re.split(r"[^\w-]", line)[0] for line in project["dependencies"]}
    offered = {re.split(r"[^\w-]", line)[0] for lines in project["optional-dependencies"].values() for line in lines}
    assert "mrcal" not in needed | offered
    assert {name for name in needed | offered if name.startswith("opencv")} == {"opencv-contrib-python-headless"}


def test_import_of_faintfield_loads_nothing_heavy() -> None:
    ended = subprocess.run([sys.executable, "-c", _IMPORT], cwd=_ROOT, capture_output=True, text=True, check=True)
    elemental_set = ended.stdout.split()
    assert "faintfield" in elemental_set
    assert not [name for name in elemental_set if name.startswith(("faintfield.", "numpy", "numba", "cv2", "mrcal"))]


def test_public_names_load() -> None:
    for name in faintfield.__all__:
        assert getattr(faintfield, name) is not None
        assert name in dir(faintfield)
    assert re.fullmatch(r"\d+\.\d+\.\d+\S*", faintfield.__version__)
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        vars(faintfield)["__getattr__"]("nonsense")


def test_type_checkers_see_the_public_names() -> None:
    """The imports under TYPE_CHECKING give each name the object that `__getattr__` loads."""
    tree = ast.parse(Path(faintfield.__file__).read_text())
    (checked,) = (node for node in tree.body if isinstance(node, ast.If))
    seen: dict[str, object] = {}
    for statement in checked.body:
        if isinstance(statement, ast.ImportFrom) and statement.module:
            module = import_module(statement.module)
            seen |= {alias.name: getattr(module, alias.name) for alias in statement.names}
        elif isinstance(statement, ast.Assign):
            assert isinstance(statement.targets[0], ast.Name)
            assert isinstance(statement.value, ast.Name)
            seen[statement.targets[0].id] = seen.pop(statement.value.id)
    assert seen == {name: getattr(faintfield, name) for name in faintfield.__all__}
