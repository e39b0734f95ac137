"""The list of commands, in the order in which an experiment needs them, each with an example."""

from pathlib import Path

from cyclopts import App, Group

_COMMANDS = "faintfield.pipelines.commands"
_AT_THE_RIG = Group("At the rig", sort_key=2)

# A sensible call of each command, without "faintfield", by group and module; the first word is its name. A test parses
# each.
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
    ),
    (Group("Reconstruct", sort_key=4), "reconstruction"): (
        "run session --depth-mm 500 --depth-mm 700",
        "reconstruct dark --geometry boards --depth-mm 500 --depth-mm 700 --out planes",
        "report planes",
        "view planes",
        "figures figures --only 4",
    ),
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


def register_commands(app: App) -> None:
    """Register all commands with `app`, grouped as its help shows them, without importing their modules."""
    for (group, module), examples in COMMANDS.items():
        for place, example in enumerate(examples, start=1):
            name = example.split()[0]
            _register(app, name, f"{module}:{name}", example, place, group)
    stage_help = "Bring up a stage: identify it, home it, move it, test it."
    app.command(f"{_COMMANDS}.stage:app", name="stage", help=stage_help, group=_AT_THE_RIG, sort_key=2.5)
    files = Group("Other people's files", sort_key=5)
    for examples, words in (
        (IMPORTS, "Make a set of images and poses, or of frames, from other people's files."),
        (EXPORTS, "Write lens and poses of a set, planes, or dark and flat frames, for other people's programs."),
    ):
        verb = examples[0].split()[0]
        app.command(
            App(
                name=verb,
                help=words,
                group=files,
                help_epilogue=f"Example: faintfield {examples[0]}",
                help_format="plaintext",
            )
        )
        for place, example in enumerate(examples, start=1):
            name = example.split()[1]
            _register(app[verb], name, f"{verb}s:{verb}_{name}", example, place)


def _register(app: App, name: str, target: str, example: str, place: int, group: Group | None = None) -> None:
    """Register a command by its module and function, with what its docstring says before the parameters.

    It is read from the source: importing all modules would take seconds.
    """
    module, _, function = target.partition(":")
    source = Path(__file__).parent.joinpath("commands", *module.split(".")).with_suffix(".py").read_text("utf-8")
    app.command(
        f"{_COMMANDS}.{target}",
        name=name,
        help=source.partition(f"\ndef {function}(")[2].split('"""')[1].partition("\n    Parameters\n")[0],
        group=group,
        sort_key=place,
        help_epilogue=f"Example: faintfield {example}",
        help_format="markdown",
    )
