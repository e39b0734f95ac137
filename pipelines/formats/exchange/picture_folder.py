"""The pictures of a folder that are views, and a word on every file that is left out."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.exchange.grid_names import by_number
from faintfield.pipelines.formats.frames import IMAGE_SUFFIXES
from faintfield.pipelines.formats.reading import is_file, is_folder
from faintfield.pipelines.formats.toml_files import inside

# Words in the names of files that go along with views, and are none.
_BESIDE = re.compile(
    r"(?<![a-z])(masks?|depths?|disp|disparity|disparities|thumbs?|thumbnails?|previews?|normals?|labels?|segmentation"
    r"|objectids?|oid|gt|truth|contact|centerview|flow|confidence)(?![a-z])",
    re.IGNORECASE,
)

# Files that nobody takes for pictures; others are named with their kind.
_NO_PICTURES = {".txt", ".md", ".json", ".toml", ".csv", ".cfg", ".xml", ".yaml", ".yml", ".html", ".pdf", ".py", ".m"}

# Suffixes of one kind of file.
_ALIKE = {".tiff": ".tif", ".jpeg": ".jpg", ".pnm": ".ppm", ".pgm": ".ppm"}


def pictures_in(folder: Path, *, every: bool = False) -> tuple[list[Path], list[str]]:
    """Return the pictures of a folder, as people count, and what was left out, in words.

    Left out are masks, depth maps and thumbnails by their names, a few pictures of another kind than most, and files
    that are not read.

    Parameters
    ----------
    folder : Path
        Where they lie.
    every : bool
        Leave out only what is not read: a pattern says which pictures are meant.

    Raises
    ------
    MissingFile
        There is no such folder, or it holds no picture that is read; the kinds that it holds are named.
    BadValue
        It holds pictures of several kinds under the same names.
    """
    if not is_folder(folder):
        raise MissingFile(f"{folder}: no such folder; name the folder that holds the pictures")
    entries = sorted(folder.iterdir(), key=lambda path: by_number(path.name))
    files = [path for path in entries if not path.name.startswith(".") and is_file(path)]
    read = [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES]
    others = [path for path in files if path.suffix.lower() not in IMAGE_SUFFIXES | _NO_PICTURES]
    if not read:
        raise _nothing_read(folder, files, [path for path in entries if is_folder(path)])
    said = [f"left out: {_counted(others)}, which are not read"] if others else []
    if every:
        return read, said
    views = _without(read, [path for path in read if _BESIDE.search(path.stem)], said, "by their names no views")
    return _of_one_kind(folder, views, said), said


def _nothing_read(folder: Path, files: Sequence[Path], folders: Sequence[Path]) -> MissingFile:
    """Return the failure of a folder without a picture that is read, which names what it holds."""
    if not files and not folders:
        return MissingFile(f"{folder}: is empty; name the folder that holds the pictures")
    if not files:
        return MissingFile(f"{folder}: holds folders only, such as {folders[0].name}; name the one with the pictures")
    return MissingFile(
        f"{folder}: {_counted(files)}: not read; convert pictures to PNG or TIFF (read are "
        f"{', '.join(sorted(IMAGE_SUFFIXES))}), or name the folder that holds them"
    )


def _counted(paths: Sequence[Path]) -> str:
    """Return the number of files of each kind, most first: "256 .gif files, 1 .txt file"."""
    kinds = Counter(path.suffix.lower() for path in paths).most_common(4)
    return ", ".join(f"{n} {kind} file{'s' * (n > 1)}" if kind else f"{n} without a suffix" for kind, n in kinds)


def _without(paths: Sequence[Path], unwanted: Sequence[Path], said: list[str], why: str) -> list[Path]:
    """Return the paths without some, and say so; all of them if no smaller number would be left than is left out."""
    if not 0 < 2 * len(unwanted) <= len(paths):
        return list(paths)
    said.append(f"left out: {len(unwanted)} of {len(paths)} pictures, {why} ({unwanted[0].name})")
    return [path for path in paths if path not in set(unwanted)]


def _of_one_kind(folder: Path, paths: Sequence[Path], said: list[str]) -> list[Path]:
    """Return the pictures without those of another kind than most, unless they are named like these; refuse copies."""
    kinds = Counter(_kind(path) for path in paths).most_common()
    most, count = kinds[0]
    if len(kinds) == 1:
        return list(paths)
    rest = [path for path in paths if _kind(path) != most]
    of_most = [path for path in paths if _kind(path) == most]
    named_alike = {path.stem for path in of_most} & {path.stem for path in rest}
    if named_alike:
        raise BadValue(
            f"{folder}: holds pictures of several kinds ({_counted(paths)}), with {min(named_alike)} in two of them; "
            "leave one kind in the folder"
        )
    forms = {_form(path) for path in of_most}
    return _without(
        paths,
        [path for path in rest if _form(path) not in forms],
        said,
        f"of another kind than the {count} {most} files",
    )


def _kind(path: Path) -> str:
    """Return the suffix of a picture, one for each kind of file."""
    return _ALIKE.get(path.suffix.lower(), path.suffix.lower())


def _form(path: Path) -> str:
    """Return a name without its numbers."""
    return re.sub(r"[0-9]+", "0", path.stem)


def picture_named(folder: Path, name: str, key: str) -> Path:
    """Return the picture of a name that another file states, with or without its suffix; it may be missing.

    Raises
    ------
    BadValue
        The name leads out of the folder.
    """
    path = inside(folder, name, key)
    if is_file(path):
        return path
    named = [path.with_name(path.name + suffix) for suffix in sorted(IMAGE_SUFFIXES)] if path.name else []
    return next(
        (candidate for candidate in named if is_file(inside(folder, str(candidate.relative_to(folder)), key))), path
    )
