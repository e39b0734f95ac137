"""Settings read from TOML: every key known, every value of its type, every complaint with its path."""

import difflib
import re
import tomllib
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from pipelines.errors import BadValue, MissingFile, UnknownKey
from pipelines.files import write_whole


def read_toml[T](path: Path, kind: type[T]) -> T:
    """Read a TOML file into `kind`, a msgspec Struct that forbids unknown fields.

    Raises
    ------
    MissingFile
        There is no such file.
    UnknownKey
        A key that nothing reads, with its path and the nearest key that is read.
    BadValue
        The file is not TOML, a key is missing, or a value has the wrong type.
    """
    if not path.is_file():
        raise MissingFile(f"{path}: no such file; name a folder or file of the kind that this command reads")
    try:
        return msgspec.toml.decode(path.read_bytes(), type=kind)
    except OSError as failure:
        raise MissingFile(f"{path}: cannot be read ({failure.strerror}); allow it to be read") from failure
    except msgspec.ValidationError as failure:
        _raise_with_path(path, str(failure), kind)
        raise
    except (tomllib.TOMLDecodeError, msgspec.DecodeError, UnicodeDecodeError) as failure:
        raise BadValue(f"{path}: is not TOML ({failure}); correct the line") from failure


def write_toml(path: Path, settings: msgspec.Struct) -> None:
    """Write what `read_toml` reads, whole or not at all; keys without a value are left out, for TOML has no null."""
    write_whole(path, tomli_w.dumps(_without_none(msgspec.to_builtins(settings))))


def inside(folder: Path, name: str, key: str) -> Path:
    """Return the path of a file that a settings file names, which must lie in its own folder.

    Raises
    ------
    BadValue
        The name is absolute, or climbs out of the folder.
    """
    path = folder / name
    if not name or Path(name).is_absolute() or not path.resolve().is_relative_to(folder.resolve()):
        raise BadValue(f"{key} = '{name}' leaves the folder {folder}; name a file inside it")
    return path


def _raise_with_path(path: Path, complaint: str, kind: type) -> None:
    """Raise what msgspec complains of, in the words of this project."""
    reason, _, place = complaint.partition(" - at ")
    prefix = place.strip("`").removeprefix("$").removeprefix(".")
    unknown = re.search(r"unknown field `(.+?)`", reason)
    if unknown is None:
        raise BadValue(f"{path}: {prefix or 'the file'}: {reason}; correct it") from None
    key = f"{prefix}.{unknown[1]}" if prefix else unknown[1]
    near = difflib.get_close_matches(unknown[1], _known_keys(kind), n=1, cutoff=0.5)
    remedy = f"did you mean '{near[0]}'?" if near else "remove it"
    raise UnknownKey(f"{path}: '{key}' is not a key that is read; {remedy}") from None


def _known_keys(kind: type) -> set[str]:
    """Return the names of all keys of a Struct and of the Structs within it."""
    schema = msgspec.json.schema(kind)
    parts = [schema, *schema.get("$defs", {}).values()]
    return {key for part in parts for key in part.get("properties", {})}


def _without_none(value: Any) -> Any:
    """Drop the keys that say nothing."""
    if isinstance(value, dict):
        return {key: _without_none(part) for key, part in value.items() if part is not None}
    return [_without_none(part) for part in value] if isinstance(value, list | tuple) else value
