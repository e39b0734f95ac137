"""A small session, taken once for all tests of a session on disk."""

import shutil
from pathlib import Path

import pytest

from tests.faults.capturing import capture_small


@pytest.fixture(scope="session")
def complete(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A complete session, to be copied."""
    folder = tmp_path_factory.mktemp("complete") / "session"
    capture_small(folder)
    return folder


@pytest.fixture
def sealed(complete: Path, tmp_path: Path) -> Path:
    """A copy of a complete session."""
    return Path(shutil.copytree(complete, tmp_path / "session"))


@pytest.fixture
def unsealed(sealed: Path) -> Path:
    """A session whose frames are all there and which is not sealed."""
    (sealed / "SHA256SUMS").unlink()
    return sealed
