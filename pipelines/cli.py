"""The command line: which commands there are, and how their ends become exit codes.

A command is a function that takes its arguments and returns its result, a JSON-able object. Commands are registered
by name, so that a module is imported only when its command runs.
"""

import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Annotated, Any

import msgspec
from cyclopts import App, CycloptsError, Parameter

from calib.errors import CalibrationError
from pipelines.console import framed_console, say
from pipelines.errors import InputError, WrongUsage
from recon.errors import ReconstructionError
from rig.errors import RigError

DONE, FAILED, WRONG_USAGE = 0, 1, 2
NAMED_FAILURES = (RigError, CalibrationError, ReconstructionError, InputError)

app = App(
    name="faintfield",
    help="See in the dark: reconstruct the planes of a scene from a grid of photon-starved images.",
    version=version("faintfield"),
    error_console=framed_console,
    default_parameter=Parameter(negative=()),
    result_action="return_value",
)
# `run` says in one line what an interrupt leaves behind.
app.suppress_keyboard_interrupt = app.meta.suppress_keyboard_interrupt = False


for _name in (
    "demo",
    "init",
    "check",
    "capture",
    "verify",
    "noise",
    "geometry",
    "simulate",
    "darken",
    "reconstruct",
    "figures",
    "report",
    "view",
):
    app.command(f"pipelines.{_name}:{_name}")
app.command(App(name="import", help="Make a set of images and poses, or of frames, from other people's files."))
app["import"].command("pipelines.import_grid:import_grid", name="grid")
app["import"].command("pipelines.import_emva1288:import_emva1288", name="emva1288")
app.command("pipelines.stage:app", name="stage")
app.command("pipelines.board_pdf:board")
app["import"].command("pipelines.import_colmap:import_colmap", name="colmap")
app["import"].command("pipelines.import_mrcal:import_mrcal", name="mrcal")
app.command(App(name="export", help="Write the lens and poses of a set for other people's programs."))
app["export"].command("pipelines.import_colmap:export_colmap", name="colmap")
app["export"].command("pipelines.import_mrcal:export_mrcal", name="mrcal")


@app.meta.default
def _launch(
    *tokens: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
    json: bool = False,
) -> None:
    """See in the dark: reconstruct the planes of a scene from a grid of photon-starved images.

    Parameters
    ----------
    json
        Print the result as one JSON object on standard output.
    """
    result: Any = app(tokens, exit_on_error=False, print_error=True)
    if json and result is not None:
        sys.stdout.write(msgspec.json.encode(result).decode() + "\n")
    elif isinstance(result, dict) and "report" in result:
        sys.stdout.write(f"{result['report']}\n")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit: 0 done, 1 a named failure (one line), 2 wrong usage."""
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code; any other exception than a named failure is a bug."""
    _load_what_help_lists(arguments)
    try:
        app.meta(arguments, exit_on_error=False, print_error=True)
    except CycloptsError:
        return WRONG_USAGE
    except WrongUsage as failure:
        say(f"faintfield: wrong usage: {failure}")
        return WRONG_USAGE
    except NAMED_FAILURES as failure:
        say(f"faintfield: {type(failure).__name__}: {failure}")
        return FAILED
    except KeyboardInterrupt:
        say("faintfield: Interrupted: stopped by Ctrl-C; what was finished is kept, no file is half-written")
        return FAILED
    return DONE


def _load_what_help_lists(arguments: Sequence[str]) -> None:
    """Import the commands of a list that is about to be shown: what they do stands in their modules."""
    level = app
    for word in arguments:
        if word.startswith("-"):
            break
        if word not in level:
            return
        level = level[word]
    for name in level:
        level[name]
