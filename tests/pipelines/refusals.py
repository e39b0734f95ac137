"""A command that must end by a named failure."""

from subprocess import CompletedProcess


def assert_refused(ended: CompletedProcess[str], failure: str, *words: str) -> None:
    """Assert that a command ended by this failure, with these words in its message."""
    assert ended.returncode == 1, ended.stderr
    assert f"faintfield: {failure}: " in ended.stderr
    assert all(word in ended.stderr for word in words), ended.stderr
