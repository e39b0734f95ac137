"""The list of commands, in the order in which an experiment needs them, each with an example."""

from pathlib import Path
from typing import NamedTuple

from cyclopts import App, Group

TRY_IT = Group("Try it without hardware", sort_key=1)
AT_THE_RIG = Group("At the rig", sort_key=2)
CALIBRATE = Group("Calibrate", sort_key=3)
RECONSTRUCT = Group("Reconstruct", sort_key=4)
FILES = Group("Other people's files", sort_key=5)

_PACKAGE = Path(__file__).parent

# What `commands.stage` says of itself.
_STAGE_HELP = "Bring up a stage: ask it, home it, move it, try it."


class Command(NamedTuple):
    """One command.

    Parameters
    ----------
    name : str
        The word that is typed.
    target : str
        Module and function, imported only when the command runs or its own help is shown.
    example : str
        Arguments of a sensible call; a test parses each.
    """

    name: str
    target: str
    example: str


COMMANDS: dict[Group, tuple[Command, ...]] = {
    TRY_IT: (
        Command("demo", "faintfield.pipelines.commands.demo:demo", "demo first-demo --quick"),
        Command(
            "simulate",
            "faintfield.pipelines.commands.simulate:simulate",
            "simulate scene --rows 5 --columns 5 --size-px 320 240",
        ),
        Command("darken", "faintfield.pipelines.commands.darken:darken", "darken bright dark --snr 0.16 --seed 1"),
    ),
    AT_THE_RIG: (
        Command("init", "faintfield.pipelines.commands.init:init", "init rig.toml"),
        Command("check", "faintfield.pipelines.commands.check:check", "check rig.toml --remember"),
        Command("board", "faintfield.pipelines.commands.board:board", "board boards.pdf --paper A3 --boards 3"),
        Command("capture", "faintfield.pipelines.commands.capture:capture", "capture rig.toml session --page"),
        Command("verify", "faintfield.pipelines.commands.verify:verify", "verify session"),
    ),
    CALIBRATE: (
        Command("noise", "faintfield.pipelines.commands.noise:noise", "noise session --out results"),
        Command(
            "geometry",
            "faintfield.pipelines.commands.geometry:geometry",
            "geometry boards --depth-mm 500 --depth-mm 700",
        ),
    ),
    RECONSTRUCT: (
        Command("run", "faintfield.pipelines.commands.run:run", "run session --depth-mm 500 --depth-mm 700"),
        Command(
            "reconstruct",
            "faintfield.pipelines.commands.reconstruct:reconstruct",
            "reconstruct dark --geometry boards --depth-mm 500 --depth-mm 700 --out planes",
        ),
        Command("report", "faintfield.pipelines.commands.report:report", "report planes"),
        Command("view", "faintfield.pipelines.commands.view:view", "view planes"),
        Command("figures", "faintfield.pipelines.commands.figures:figures", "figures figures --only 4"),
    ),
}
IMPORTS = (
    Command(
        "grid",
        "faintfield.pipelines.commands.imports.grid:import_grid",
        "grid pictures bright --pitch-mm 50 --fx-px 600",
    ),
    Command(
        "colmap", "faintfield.pipelines.commands.imports.colmap:import_colmap", "colmap sparse/0 set --images images"
    ),
    Command("mrcal", "faintfield.pipelines.commands.imports.mrcal:import_mrcal", "mrcal cameras set --images images"),
    Command(
        "emva1288", "faintfield.pipelines.commands.imports.emva1288:import_emva1288", "emva1288 descriptor.txt noise"
    ),
)
EXPORTS = (
    Command("colmap", "faintfield.pipelines.commands.exports.colmap:export_colmap", "colmap set sparse"),
    Command("mrcal", "faintfield.pipelines.commands.exports.mrcal:export_mrcal", "mrcal set cameras"),
    Command("zarr", "faintfield.pipelines.commands.exports.zarr:export_zarr", "zarr sweep sweep.ome.zarr"),
)


def register_commands(app: App) -> None:
    """Register all commands with `app`, grouped as its help shows them, without importing their modules."""
    for group, commands in COMMANDS.items():
        _register(app, commands, "faintfield", group)
    stage = "faintfield.pipelines.commands.stage:app"
    app.command(stage, name="stage", help=_STAGE_HELP, group=AT_THE_RIG, sort_key=2.5)
    for name, commands, words in (
        ("import", IMPORTS, "Make a set of images and poses, or of frames, from other people's files."),
        ("export", EXPORTS, "Write lens and poses of a set, or planes, for other people's programs."),
    ):
        app.command(App(name=name, help=words, group=FILES, help_epilogue=_example(f"faintfield {name}", commands[0])))
        _register(app[name], commands, f"faintfield {name}")


def _register(app: App, commands: tuple[Command, ...], prefix: str, group: Group | None = None) -> None:
    """Register the commands of one level, in their order."""
    for place, command in enumerate(commands, start=1):
        app.command(
            command.target,
            name=command.name,
            help=_docstring(command.target),
            group=group,
            sort_key=place,
            help_epilogue=_example(prefix, command),
        )


def _docstring(target: str) -> str:
    """Return the docstring of a command from its source: importing all modules would take seconds."""
    module, _, function = target.partition(":")
    source = _PACKAGE.joinpath(*module.split(".")[2:]).with_suffix(".py").read_text()
    return source.partition(f"\ndef {function}(")[2].split('"""')[1]


def _example(prefix: str, command: Command) -> str:
    """Return the last line of a command's help."""
    return f"Example: {prefix} {command.example}"
