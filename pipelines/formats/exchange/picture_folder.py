"""Pictures of a folder that are views, with a remark on the files that are left out."""

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
_COMPANION = re.compile(
    r"(?<![a-z])(masks?|depths?|disp|disparity|disparities|thumbs?|thumbnails?|previews?|normals?|labels?|segmentation"
    r"|objectids?|oid|gt|truth|contact|centerview|flow|confidence)(?![a-z])",
    re.IGNORECASE,
)

# Files that nobody takes for pictures; others are named with their kind.
_NO_PICTURES = {".txt", ".md", ".json", ".toml", ".csv", ".cfg", ".xml", ".yaml", ".yml", ".html", ".pdf", ".py", ".m"}

_DIGITS = re.compile(r"[0-9]+")

# Suffixes of one kind of file.
_ALIKE = {".tiff": ".tif", ".jpeg": ".jpg", ".pnm": ".ppm", ".pgm": ".ppm"}


def pictures_in(folder: Path, *, every: bool = False) -> tuple[list[Path], list[str]]:
    """Return the pictures of a folder, as people count, and a remark on each kind of file that is left out.

    Left out are masks, depth maps and thumbnails by their names, a few pictures of another kind than most, and files
    that are not read.

    Parameters
    ----------
    folder : Path
        Folder of the pictures.
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
    pictures = [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES]
    unread = [path for path in files if path.suffix.lower() not in IMAGE_SUFFIXES | _NO_PICTURES]
    if not pictures:
        folders = [path for path in entries if is_folder(path)]
        if folders and not files:
            raise MissingFile(
                f"{folder}: holds folders only, such as {folders[0].name}; name the one with the pictures"
            )
        raise MissingFile(
            f"{folder}: holds {_count_kinds(files) or 'nothing'}; convert pictures to PNG or TIFF (read are "
            f"{', '.join(sorted(IMAGE_SUFFIXES))}), or name the folder that holds them"
        )
    remarks = [f"left out: {_count_kinds(unread)}, which are not read"] if unread else []
    if every:
        return pictures, remarks
    masks = [path for path in pictures if _COMPANION.search(path.stem)]
    pictures = _leave_out(pictures, masks, remarks, "by their names no views")
    kinds = {path: _ALIKE.get(path.suffix.lower(), path.suffix.lower()) for path in pictures}
    kind, count = Counter(kinds.values()).most_common(1)[0]
    common = [path for path in pictures if kinds[path] == kind]
    rest = [path for path in pictures if kinds[path] != kind]
    named_alike = {path.stem for path in common} & {path.stem for path in rest}
    if named_alike:
        raise BadValue(
            f"{folder}: holds pictures of several kinds ({_count_kinds(pictures)}), with {min(named_alike)} in two of "
            "them; leave one kind in the folder"
        )
    # Pictures of another kind whose names differ in their numbers only are views, too
    forms = {_DIGITS.sub("0", path.stem) for path in common}
    foreign = [path for path in rest if _DIGITS.sub("0", path.stem) not in forms]
    return _leave_out(pictures, foreign, remarks, f"of another kind than the {count} {kind} files"), remarks


def _count_kinds(paths: Sequence[Path]) -> str:
    """Return the number of files of each kind, most first: "256 .gif files, 1 .txt file"."""
    kinds = Counter(path.suffix.lower() for path in paths).most_common(4)
    return ", ".join(f"{n} {kind} file{'s' * (n > 1)}" if kind else f"{n} without a suffix" for kind, n in kinds)


def _leave_out(paths: list[Path], unwanted: Sequence[Path], remarks: list[str], reason: str) -> list[Path]:
    """Return the paths without some, and say so; all of them if no smaller number would be left than is left out."""
    if not 0 < 2 * len(unwanted) <= len(paths):
        return paths
    remarks.append(f"left out: {len(unwanted)} of {len(paths)} pictures, {reason} ({unwanted[0].name})")
    return [path for path in paths if path not in unwanted]


def picture_named(folder: Path, name: str, key: str) -> Path:
    """Return the picture of a name that another file states, with or without its suffix; it may be missing.

    Raises
    ------
    BadValue
        The name leads out of the folder.
    """
    path = inside(folder, name, key)
    suffixes = sorted(IMAGE_SUFFIXES) if path.name and not is_file(path) else []
    candidates = (path.with_name(path.name + suffix) for suffix in suffixes)
    return next((file for file in candidates if is_file(inside(folder, str(file.relative_to(folder)), key))), path)
