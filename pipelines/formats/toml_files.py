"""Settings in TOML: unknown keys and wrong values are refused, with their place in the file."""

import difflib
import re
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from faintfield.pipelines.errors import BadValue, InputError, MissingFile, UnknownKey
from faintfield.pipelines.formats.files import write_whole
from faintfield.pipelines.formats.reading import is_file, read_content, read_json
from faintfield.rig.errors import UnknownPlugin
from faintfield.rig.plugins import fold_plugins
from faintfield.rig.settings import RigSettings

# No quantity of a rig is larger, and computing with numbers up to it does not overflow.
_MAX_NUMBER = 1e12

# Size in bytes up to which TOML is read: a set of ten thousand views has some three million.
_MAX_TOML_BYTES = 8_000_000

# A key of more than 32 parts, such as a.a.a…: the time to read one grows with the square of its length.
_LONG_KEY = re.compile(rb"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){32}""")


def read_toml[T](
    path: Path, kind: type[T], *, remedy: str, prepare: Callable[[Any], Any] = lambda content: content
) -> T:
    """Read a TOML file into `kind`, a msgspec Struct that forbids unknown fields.

    `remedy` says what to name where there is no such file, and what makes one. `prepare` gives the file's tables the
    form that `kind` has. Raises MissingFile, UnknownKey with the nearest key or the table where it belongs, or BadValue
    with the place of a value of a wrong type or out of its limits.
    """
    if not is_file(path):
        raise MissingFile(f"{path}: no such file; {remedy}")
    content = _decoded(path)
    _require_finite(path, content)
    try:
        return msgspec.convert(prepare(content), kind)
    except msgspec.ValidationError as failure:
        message = str(failure).replace(" | null`", "`")  # None is a key left out: TOML has no null
        raise _failure_of(path, message, kind) from None


def _decoded(path: Path) -> Any:
    content = read_content(path, _MAX_TOML_BYTES)
    if (key := _LONG_KEY.search(content)) is not None:
        line = content.count(b"\n", 0, key.start()) + 1
        raise BadValue(f"{path}: line {line}: a key has more than 32 parts, and none that is read has; correct it")
    try:
        return msgspec.toml.decode(content)
    except RecursionError as failure:
        raise BadValue(f"{path}: its values are nested too deeply; none that is read is: correct it") from failure
    except ValueError as failure:  # not TOML, not UTF-8, or an integer of thousands of digits
        raise BadValue(f"{path}: is not TOML ({failure}); correct the line") from failure


def write_toml(path: Path, settings: msgspec.Struct) -> None:
    """Write what `read_toml` reads, whole or not at all; keys whose value is None are left out, as TOML has no null."""
    write_whole(path, tomli_w.dumps(_without_none(msgspec.to_builtins(settings))))


def inside(folder: Path, name: str, key: str) -> Path:
    """Return the path of a file named in a settings file; BadValue if it is not in the same folder."""
    path = folder / name
    try:
        lies_inside = path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError):  # longer than any path, or with a NUL
        lies_inside = False
    if not name or Path(name).is_absolute() or not lies_inside:
        raise BadValue(f"{key} = '{name}' leaves the folder {folder}; name a file inside it")
    return path


def _require_finite(path: Path, value: Any, place: str = "") -> None:
    """Refuse numbers that are not finite or larger than any rig has, at any depth."""
    if isinstance(value, dict):
        for key, part in value.items():
            _require_finite(path, part, f"{place}.{key}" if place else key)
    elif isinstance(value, list):
        for index, part in enumerate(value):
            _require_finite(path, part, f"{place}[{index}]")
    elif isinstance(value, int | float) and not abs(value) <= _MAX_NUMBER:
        raise BadValue(
            f"{path}: {place} = {_shown(value)}; numbers are finite, and at most {_MAX_NUMBER:g} in size: correct it"
        )


def _shown(number: float) -> str:
    """Return the beginning of a number; Python does not print integers of more than 4300 digits."""
    try:
        return f"{number!s:.24}"
    except ValueError:
        return f"an integer of {int(number).bit_length()} bits"


def _failure_of(path: Path, complaint: str, kind: type) -> InputError:
    reason, _, place = complaint.partition(" - at ")
    place = place.strip("`").removeprefix("$").removeprefix(".")
    if unknown := re.search(r"unknown field `(.+?)`", reason):
        key = f"{place}.{unknown[1]}" if place else unknown[1]
        return UnknownKey(f"{path}: '{key}' is not a key that is read; {_better_key(kind, place, unknown[1])}")
    if none_of_them := re.fullmatch(r"Invalid (?:enum )?value (.+)", reason):
        value = none_of_them[1]
        return BadValue(f"{path}: {place} = {value}; {_better_value(kind, place, value)}")
    return BadValue(f"{path}: {place or 'the file'}: {reason}; correct it")


def _better_key(kind: type, place: str, key: str) -> str:
    tables = _tables(kind)
    known = {name for table in tables.values() for name in table}
    if key not in known:
        near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
        return f"did you mean '{near[0]}'?" if near else "remove it"
    for table in tables.values():
        kinds = table.get(_name(place), {}).get("discriminator", {"mapping": {}})
        if owners := [repr(tag) for tag, reference in kinds["mapping"].items() if key in tables[reference]]:
            return f"it is for {kinds['propertyName']} = {' or '.join(owners)} alone: remove it"
    return "it belongs in another table: move it there, or remove it"


def _better_value(kind: type, place: str, value: str) -> str:
    choices = [
        repr(choice) for table in _tables(kind).values() for choice in table.get(_name(place), {}).get("enum", [])
    ]
    near = difflib.get_close_matches(value, choices, n=1, cutoff=0.5)
    return f"choose from {', '.join(choices)}" + (f"; did you mean {near[0]}?" if near else "")


def _tables(kind: type) -> dict[str, dict[str, Any]]:
    """Return the keys of each Struct in the JSON schema of `kind`, by reference."""
    parts = msgspec.json.schema(kind)["$defs"]
    return {f"#/$defs/{name}": part.get("properties", {}) for name, part in parts.items()}


def _name(place: str) -> str:
    return re.sub(r"\[.*?\]", "", place).rpartition(".")[2]


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_none(part) for key, part in value.items() if part is not None}
    return [_without_none(part) for part in value] if isinstance(value, list | tuple) else value


def read_rig(path: Path) -> RigSettings:
    """Read a rig.toml; raises as `read_rig_tables` does."""
    return read_rig_tables(path, RigSettings)


def read_rig_tables[T](path: Path, kind: type[T]) -> T:
    """Read a rig.toml, or those of its tables that `kind` has; raise as `read_toml` does, or UnknownPlugin."""
    try:
        return read_toml(path, kind, remedy="name a rig.toml; `faintfield init` writes one", prepare=fold_plugins)
    except UnknownPlugin as failure:
        raise UnknownPlugin(f"{path}: {failure}") from None


def write_template(rig: Path) -> None:
    """Write a commented rig.toml, which describes a simulated rig."""
    write_whole(rig, files("faintfield.pipelines.formats").joinpath("rig_template.toml").read_text(encoding="utf-8"))


def stage_settings_path(rig: Path) -> Path:
    """Return the path of the stored settings of the stage of a rig.toml."""
    return rig.with_suffix(".stage.json")


def read_stage_settings(rig: Path) -> dict[str, str] | None:
    """Read the stored settings of the stage of a rig.toml, None if there are none."""
    path = stage_settings_path(rig)
    if not is_file(path):
        return None
    return read_json(path, dict[str, str], what="what --remember writes", remedy="run with --remember again")
