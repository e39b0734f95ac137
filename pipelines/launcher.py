"""The launcher: runs a command, prints its result, and turns failures into exit codes.

A command is a function of its arguments that returns its result, a JSON-able object. `pipelines.registry` lists the
commands by name, so that a module is imported only when its command runs.
"""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from json import dumps
from pathlib import Path
from typing import Annotated

from cyclopts import App, CycloptsError, CycloptsPanel, Group, Parameter

import faintfield
from faintfield.pipelines.console import framed_console, inform, visible
from faintfield.pipelines.errors import NAMED_FAILURES, FileFailed, MemoryShort, WrongUsage
from faintfield.pipelines.log_file import logged
from faintfield.pipelines.registry import register_commands

DONE, FAILED, WRONG_USAGE = 0, 1, 2

# Options of every command; listed last.
EVERY_COMMAND = Group("Every command", sort_key=9)

_START = """Start with: faintfield demo first-demo

The --help of every command ends with an example; docs/guide.md leads from the parts list to the first plane."""

app = App(
    name="faintfield",
    help="See in the dark: reconstruct the planes of a scene from a grid of photon-starved images.",
    help_epilogue=_START,
    version=lambda: faintfield.__version__,
    error_console=framed_console,
    error_formatter=lambda failure: CycloptsPanel(visible(str(failure))),
    help_format="plaintext",  # the help of a command is in Markdown, which takes long to load
    default_parameter=Parameter(negative=()),
    result_action="return_value",
)
# `run` reports an interrupt in one line.
app.suppress_keyboard_interrupt = app.meta.suppress_keyboard_interrupt = False
register_commands(app)
app.command(
    "faintfield.pipelines.completion:install_completion",
    name="--install-completion",
    help="Complete commands and options with the tab key of your shell.",
    group=EVERY_COMMAND,
)
for _flag in ("--help", "--version"):
    app[_flag].group = EVERY_COMMAND


@app.meta.default
def _launch(
    *tokens: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
    json: Annotated[bool, Parameter(group=EVERY_COMMAND, show_default=False)] = False,
    log: Annotated[Path | None, Parameter(group=EVERY_COMMAND)] = None,
) -> None:
    """See in the dark: reconstruct the planes of a scene from a grid of photon-starved images.

    Parameters
    ----------
    json
        Print the result as one JSON object on standard output.
    log
        Append to this file: the command, versions, all messages with their times, and how the command ended.
    """
    with logged(log, tokens, one_line=(CycloptsError, WrongUsage, *NAMED_FAILURES)), _named_system_errors():
        result: object = app(tokens, exit_on_error=False, print_error=True)
        if json and result is not None:
            _print_bytes(_json(result))
        elif report := result.get("report") if isinstance(result, dict) else getattr(result, "report", None):
            _print_bytes(os.fsencode(visible(str(report)) if sys.stdout.isatty() else report))


def _json(result: object) -> bytes:
    """Return a result as one line of JSON."""
    import msgspec

    from faintfield.pipelines.formats.units import json_of

    try:
        return json_of(result)
    except UnicodeEncodeError:  # the name of a file is not UTF-8
        return dumps(msgspec.to_builtins(result)).encode()


def _print_bytes(line: bytes) -> None:
    """Write a line to standard output as it is: the name of a file may be text in no encoding."""
    sys.stdout.flush()
    sys.stdout.buffer.write(line + b"\n")
    sys.stdout.buffer.flush()


@contextmanager
def _named_system_errors() -> Iterator[None]:
    """Name an error of the system that met a command where it expects none: a disk or the memory can fail anywhere."""
    try:
        yield
    except OSError as failure:
        raise FileFailed(
            f"{failure.filename or 'a file'}: {failure.strerror or failure}; see to its disk and its permissions, and "
            "run the same command again"
        ) from failure
    except MemoryError as failure:
        reason = str(failure) or "no size stated"
        raise MemoryShort(
            f"the command needs more memory than there is ({reason}); ask for less at once, or use a machine with more"
        ) from failure


def launch(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code; an exception that is not a named failure is a bug, and is raised."""
    try:
        app.meta(arguments, exit_on_error=False, print_error=True)
    except CycloptsError:
        return WRONG_USAGE
    except WrongUsage as failure:
        inform(f"faintfield: wrong usage: {failure}")
        return WRONG_USAGE
    except NAMED_FAILURES as failure:
        inform(f"faintfield: {type(failure).__name__}: {failure}")
        return FAILED
    except KeyboardInterrupt:
        inform("faintfield: Interrupted: stopped by Ctrl-C; finished results are kept, and no file is half-written")
        return FAILED
    return DONE
