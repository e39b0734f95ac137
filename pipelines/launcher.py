"""The launcher: lists the commands, runs one, prints its result, and turns failures into exit codes.

A command is a function of its arguments that returns its result, a JSON-able object. Its module is imported only when
the command runs or its help is shown.
"""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import takewhile
from json import dumps
from pathlib import Path
from typing import Annotated, Literal, get_args

import msgspec
from cyclopts import App, CoercionError, CycloptsError, CycloptsPanel, Group, Parameter, UnusedCliTokensError

import faintfield
from faintfield.pipelines.console import framed_console, inform, visible
from faintfield.pipelines.errors import NAMED_FAILURES, FileFailed, MemoryShort, WrongUsage
from faintfield.pipelines.formats.units import json_of
from faintfield.pipelines.log_file import logged
from faintfield.pipelines.termination import Terminated
from faintfield.recon.names import on_compiling

DONE, FAILED, WRONG_USAGE = 0, 1, 2

_COMMANDS = "faintfield.pipelines.commands"

_AT_THE_RIG, _FILES = Group("At the rig", sort_key=2), Group("Other people's files", sort_key=5)
_EVERY_COMMAND = Group("Every command", sort_key=9)

# An example of each command, without "faintfield", by group and module, in the order in which an experiment needs them;
# the first word is its name. A test parses each.
COMMANDS: dict[tuple[Group, str], tuple[str, ...]] = {
    (Group("Try it without hardware", sort_key=1), "simulation"): (
        "demo first-demo --quick",
        "simulate scene --rows 5 --columns 5 --size-px 320 240",
        "darken bright dark --snr 0.16 --seed 1",
    ),
    (_AT_THE_RIG, "capture"): (
        "init rig.toml",
        "check rig.toml --remember",
        "plan rig.toml --light-e 0.97 --sigma-e 0.3 --exposures-ms 50 100 --grids 5x5 7x7",
        "board boards.pdf --paper A3 --boards 3",
        "capture rig.toml session --page",
        "verify session",
    ),
    (Group("Calibrate", sort_key=3), "calibration"): (
        "noise session --out results",
        "geometry boards --depth-mm 500 --depth-mm 700",
        "align set --depth 500 --depth 700",
    ),
    (Group("Reconstruct", sort_key=4), "reconstruction"): (
        "run session --depth-mm 500 --depth-mm 700",
        "reconstruct dark --geometry boards --depth-mm 500 --depth-mm 700 --out planes",
        "report planes",
        "view planes",
        "figures figures --only 4",
    ),
    (_FILES, "exports"): ("schema geometry",),
}
IMPORTS = (
    "import grid pictures bright --pitch-mm 50 --fx-px 600",
    "import colmap sparse/0 set --images images",
    "import mrcal cameras set --images images",
    "import nerfstudio transforms.json set --mm-per-unit 1000",
    "import poses poses.csv set --fx-px 600 --images images",
    "import emva1288 descriptor.txt noise",
)
EXPORTS = (
    "export colmap set sparse",
    "export mrcal set cameras",
    "export nerfstudio set transforms",
    "export zarr sweep sweep.ome.zarr",
    "export emva1288 noise emva1288",
)

_START = """Start with: faintfield demo first-demo

The --help of every command ends with an example; docs/tutorials/rig.md leads from the parts list to the first plane."""


def _explain_usage(failure: CycloptsError) -> str:
    """Return what is wrong with the arguments of a command, and the remedy for no numbers and for superfluous words."""
    if isinstance(failure, CoercionError) and (numbers := _explain_numbers(failure)):
        return numbers
    unused = failure.unused_tokens if isinstance(failure, UnusedCliTokensError) else None
    if not unused or failure.app is None:
        return str(failure)
    repeatable = {item.name for item in failure.app.assemble_argument_collection() if item.token_count()[1]}
    tokens = failure.root_input_tokens or []
    parts = [part for token in tokens for part in (token.split("=", 1) if token.startswith("--") else [token])]
    for option, *values in (parts[place:] for place, part in enumerate(parts) if part in repeatable):
        if values[1:2] == unused[:1]:
            several = [values[0], *takewhile(unused.__contains__, values[1:])]
            return _repeat(option, several)
    command = " ".join((app.name[0], *(failure.command_chain or ())))
    return f"{' '.join(unused)}: no place for this; put a name with spaces in quotes, or see {command} --help"


def _explain_numbers(failure: CoercionError) -> str | None:
    """Return the remedy for a value that is no number, None where none is wanted."""
    kinds = get_args(failure.target_type) or (failure.target_type,)
    if float not in kinds or failure.token is None or failure.token.keyword is None:
        return None
    option, value = failure.token.keyword, failure.token.value
    several = value.split(",")
    if len(several) > 1 and failure.argument is not None and failure.argument.token_count()[1]:
        return _repeat(option, several)
    unit = option.rpartition("-")[2]
    inside = f" in {unit}" if unit in ("mm", "px", "ms") else ""
    otherwise = "".join(f", or {word}" for kind in kinds for word in get_args(kind))
    return f"{option} {value}: is no number; give digits alone{inside}, such as 500 or 0.5{otherwise}"


def _repeat(option: str, values: Sequence[str]) -> str:
    calls = " ".join(f"{option} {value.strip()}" for value in values)
    return f"{option} takes one value each time; repeat it for several: {calls}"


app = App(
    name="faintfield",
    help="See in the dark: reconstruct the planes of a scene from a grid of photon-starved images.",
    help_epilogue=_START,
    version=lambda: faintfield.__version__,
    error_console=framed_console,
    error_formatter=lambda failure: CycloptsPanel(visible(_explain_usage(failure))),
    help_format="plaintext",  # the help of a command is in Markdown, which takes long to load
    default_parameter=Parameter(negative=()),
    result_action="return_value",
)
# `launch` reports an interrupt in one line
app.suppress_keyboard_interrupt = app.meta.suppress_keyboard_interrupt = False


def _register(parent: App, name: str, target: str, example: str, place: int, group: Group | None = None) -> None:
    """Register a command with the part of its docstring before the parameters, read from its source.

    Importing all modules would take seconds.
    """
    module, _, function = target.partition(":")
    source = (Path(__file__).parent / "commands" / f"{module}.py").read_text("utf-8")
    parent.command(
        f"{_COMMANDS}.{target}",
        name=name,
        help=source.partition(f"\ndef {function}(")[2].split('"""')[1].partition("\n    Parameters\n")[0],
        group=group,
        sort_key=place,
        help_epilogue=f"Example: faintfield {example}",
        help_format="markdown",
    )


def _register_verb(examples: Sequence[str], description: str) -> None:
    verb = examples[0].split()[0]
    epilogue = f"Example: faintfield {examples[0]}"
    app.command(App(name=verb, help=description, group=_FILES, help_epilogue=epilogue, help_format="plaintext"))
    for place, example in enumerate(examples, start=1):
        name = example.split()[1]
        _register(app[verb], name, f"{verb}s:{verb}_{name}", example, place)


for (_group, _module), _examples in COMMANDS.items():
    for _place, _example in enumerate(_examples, start=1):
        _name = _example.split()[0]
        _register(app, _name, f"{_module}:{_name}", _example, _place, _group)
app.command(
    f"{_COMMANDS}.stage:app",
    name="stage",
    help="Bring up a stage: identify it, home it, move it, test it.",
    group=_AT_THE_RIG,
    sort_key=2.5,
)
_register_verb(IMPORTS, "Make a set of images and poses, or of frames, from other people's files.")
_register_verb(EXPORTS, "Write lens and poses of a set, planes, or dark and flat frames, for other people's programs.")
for _flag in ("--help", "--version"):
    app[_flag].group = _EVERY_COMMAND


@app.command(
    name="--install-completion",
    help="Complete commands and options with the tab key of your shell.",
    group=_EVERY_COMMAND,
)
def _install_completion(
    *,
    shell: Literal["zsh", "bash", "fish", "powershell"] | None = None,
    output: Annotated[Path | None, Parameter(name=["-o", "--output"])] = None,
) -> None:
    """Install shell completion for this application.

    Parameters
    ----------
    shell
        Shell type for completion. If not specified, attempts to auto-detect current shell.
    output
        Output path for the completion script. If not specified, uses shell-specific default.
    """
    from cyclopts.completion.install import create_install_completion_command  # takes as long as all of the launcher

    create_install_completion_command(app.install_completion, add_to_startup=True)(shell=shell, output=output)


@app.meta.default
def _launch(
    *tokens: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
    json: Annotated[bool, Parameter(group=_EVERY_COMMAND, show_default=False)] = False,
    log: Annotated[Path | None, Parameter(group=_EVERY_COMMAND)] = None,
) -> None:
    """See in the dark: reconstruct the planes of a scene from a grid of photon-starved images.

    Parameters
    ----------
    json
        Print the result as one JSON object on standard output.
    log
        Append to this file: the command, versions, all messages with their times, and how the command ended.
    """
    if any(not token or (token.startswith("--") and token.endswith("=")) for token in tokens):
        raise WrongUsage("an argument is empty; give it a value, or leave its option out")
    with logged(log, tokens, one_line=(CycloptsError, WrongUsage, *NAMED_FAILURES)), _named_system_errors():
        result: object = app(tokens, exit_on_error=False, print_error=True)
        if json and result is not None:
            _print_bytes(_json(result))
        elif report := result.get("report") if isinstance(result, dict) else getattr(result, "report", None):
            _print_bytes(os.fsencode(visible(str(report)) if sys.stdout.isatty() else report))


def _json(result: object) -> bytes:
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


def _announce_compiling() -> None:
    inform("compiling kernels, which takes up to a minute; later runs find them where numba can write its cache")


on_compiling.append(_announce_compiling)


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
    except Terminated as end:
        with suppress(OSError):  # the terminal may be gone
            inform(f"faintfield: Terminated: ended by {end}; finished results are kept, and no file is half-written")
        return 128 + end.number
    except KeyboardInterrupt:
        inform("faintfield: Interrupted: stopped by Ctrl-C; finished results are kept, and no file is half-written")
        return FAILED
    return DONE
