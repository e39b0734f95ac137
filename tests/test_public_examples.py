"""Every public name has an example in its docstring, and the examples run as they stand."""

import doctest
from pathlib import Path

import pytest

import faintfield

# Names whose examples need a package that is not always installed.
_PACKAGES = {"calibrate_geometry": "mrcal"}


@pytest.mark.parametrize("name", faintfield.__all__)
def test_public_name_has_an_example_that_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    tests = doctest.DocTestFinder().find(getattr(faintfield, name), name, globs={})  # those of methods as well
    assert [test for test in tests if test.name == name and test.examples], f"{name} has no example in its docstring"
    if name in _PACKAGES:
        pytest.importorskip(_PACKAGES[name])
    report: list[str] = []
    runner = doctest.DocTestRunner(verbose=False)
    failures = sum(runner.run(test, out=report.append).failed for test in tests)
    assert not failures, "".join(report)
