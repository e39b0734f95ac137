"""Finding and reading the JSON files of results, with a named failure for a damaged one."""

from collections.abc import Callable
from pathlib import Path

from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.files import sha256
from faintfield.pipelines.formats.reading import read_json
from faintfield.pipelines.formats.results.records import RECONSTRUCTION_FILE, ReconstructionRecord

# Folders of results lie at most this far below the folder that is shown.
_MAX_LEVELS_BELOW = 3


def files_below(directory: Path, name: str) -> list[Path]:
    """Return the files of a name in a folder and down to three folders below it, in order; no link out of it counts."""
    whole = directory.resolve()
    found = {path for level in range(_MAX_LEVELS_BELOW + 1) for path in directory.glob("*/" * level + name)}
    return sorted(path for path in found if path.resolve().is_relative_to(whole))


def read_result[Record](path: Path, kind: type[Record]) -> Record:
    """Read a JSON file as one of the types of `formats.results.records`."""
    return read_json(path, kind, what="a result that can be shown", remedy="reconstruct again")


def file_within(folder: Path, name: str) -> Path:
    """Return the path of a file that a record in `folder` names; it may be missing, but not be elsewhere (BadValue)."""
    path = folder / name
    if not _is_within(path, folder):
        raise BadValue(f"{path}: leads out of the folder, or is no regular file; reconstruct again")
    return path


def problem_of_file(path: Path, folder: Path, known: str, hashed: Callable[[Path], str] = sha256) -> str | None:
    """Return in words how a file, which must lie in `folder`, differs from its recorded hash, None if it does not."""
    if not _is_within(path, folder):
        return "leads out of its folder, or is no regular file"
    try:
        if not path.exists():
            return "is missing"
        return None if hashed(path) == known else "was altered"
    except MissingFile as failure:
        return f"cannot be read ({failure.__cause__})"


def _is_within(path: Path, folder: Path) -> bool:
    try:
        return path.resolve().is_relative_to(folder.resolve()) and (path.is_file() or not path.exists())
    except (OSError, ValueError):  # a name that no file can have
        return False


def results_below(directory: Path, *, required: bool = True) -> dict[Path, ReconstructionRecord]:
    """Return each reconstruction.json in a folder and below it, by its folder; MissingFile if one is `required`."""
    if not directory.is_dir():
        raise MissingFile(f"{directory}: no such folder; name one that `faintfield reconstruct` wrote")
    paths = files_below(directory, RECONSTRUCTION_FILE)
    if not paths and required:
        raise MissingFile(f"{directory}: holds no {RECONSTRUCTION_FILE}; run `faintfield reconstruct` first")
    results = {path.parent: read_result(path, ReconstructionRecord) for path in paths}
    for folder, result in results.items():
        for name in result.files:
            file_within(folder, name)
    return results
