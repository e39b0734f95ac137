"""Set-up of tests of reconstructions."""

from pathlib import Path

import pytest

from tests.pipelines.conftest import made_once, run_undrawn


@pytest.fixture(autouse=True)
def _empty_pages(undrawn: None) -> None:
    """Leave the drawings of all pages empty."""


@pytest.fixture(scope="session")
def colour_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small set of a Bayer camera, to be read only."""
    words = ("--size-px", 64, 48, "--rows", 3, "--columns", 3, "--colour", "bayer", "--snr", 1)
    return made_once(tmp_path_factory, "colour", lambda folder: run_undrawn("simulate", folder / "set", *words)) / "set"
