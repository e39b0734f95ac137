"""The start of the command line: `--version` is answered at once; for all else the launcher is loaded."""

import sys
from collections.abc import Sequence

import faintfield


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit: 0 done, 1 a named failure (one line), 2 wrong usage, 128 + N ended by signal N."""
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code; an exception that is not a named failure is a bug, and is raised."""
    if list(arguments) == ["--version"]:
        sys.stdout.write(f"{faintfield.__version__}\n")
        return 0
    from faintfield.pipelines.launcher import launch

    return launch(arguments)
