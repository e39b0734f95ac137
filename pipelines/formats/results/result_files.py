"""Finding and reading the JSON files of results, with a named failure for a damaged one."""

from pathlib import Path

from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.formats.reading import read_json
from faintfield.pipelines.formats.results.records import RECONSTRUCTION_FILE, ReconstructionRecord

# Folders of results lie at most this far below the folder that is shown.
_MAX_LEVELS_BELOW = 3


def files_below(directory: Path, name: str) -> list[Path]:
    """Return the files of a name in a folder and down to three folders below it, in order."""
    levels = range(_MAX_LEVELS_BELOW + 1)
    return sorted({path for level in levels for path in directory.glob("*/" * level + name)})


def read_result[Record](path: Path, kind: type[Record]) -> Record:
    """Read a JSON file as one of the types of `formats.results.records`.

    Raises
    ------
    MissingFile, BadValue
        The file cannot be read, or is not of this type.
    """
    return read_json(path, kind, what="a result that can be shown", remedy="reconstruct again")


def results_below(directory: Path) -> dict[Path, ReconstructionRecord]:
    """Return each reconstruction.json in a folder and below it, by its folder.

    Raises
    ------
    MissingFile, BadValue
        There is none, or one that cannot be read.
    """
    if not directory.is_dir():
        raise MissingFile(f"{directory}: no such folder; name one that `faintfield reconstruct` wrote")
    paths = files_below(directory, RECONSTRUCTION_FILE)
    if not paths:
        raise MissingFile(f"{directory}: holds no {RECONSTRUCTION_FILE}; run `faintfield reconstruct` first")
    return {path.parent: read_result(path, ReconstructionRecord) for path in paths}
