"""Provenance of every result (command, options, inputs, versions), whether it is current, and the digest of its record.

The digest, the last key of a JSON record, is the SHA-256 of its text without that key and without white space. It tells
a record that was altered or damaged from one that was written so. It is no signature: who writes a record anew can
write its digest, too.
"""

import hashlib
import platform
import re
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import msgspec
from msgspec import UNSET, UnsetType

from faintfield.pipelines.formats.units import StatedUnits, record_of

_PACKAGES = ("faintfield", "numpy", "scipy", "numba", "opencv-contrib-python-headless", "mrcal", "casadi")

DIGEST_KEY = "record_sha256"

_LAST_KEY = re.compile(rf',"{DIGEST_KEY}":"([0-9a-f]{{64}})"\}}\Z'.encode())


class Provenance[Options](msgspec.Struct, frozen=True, kw_only=True):
    """Provenance of a result, the last keys of its JSON: inputs by SHA-256, options as they took effect, versions.

    Attributes
    ----------
    units : StatedUnits, optional
        Units in which the result is stated; without them mm, electrons and s.
    command : str
        Name of the command that made the result.
    options : Options
        Options of the command as they took effect.
    inputs : dict of str
        SHA-256 of each file that was read, by its name.
    versions : dict of str
        Versions of Python and of the packages that computed the result.
    """

    units: StatedUnits | UnsetType = UNSET
    command: str
    options: Options
    inputs: dict[str, str]
    versions: dict[str, str]

    def parts(self) -> dict[str, Any]:
        """Return what is recorded, by name."""
        return {name: part for name, part in msgspec.structs.asdict(self).items() if part is not UNSET}


def provenance[Options](
    command: str, options: Options, inputs: dict[str, str], units: StatedUnits | UnsetType = UNSET
) -> Provenance[Options]:
    """Return the provenance of a result that is made now."""
    return Provenance(units=units, command=command, options=options, inputs=inputs, versions=versions())


@cache  # finding them takes 10 ms
def versions() -> dict[str, str]:
    """Return the versions of Python and the packages that compute results; one that is not installed is left out."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):  # mrcal is installed apart
            found[name] = version(name)
    return found


def first_difference[Options](content: bytes, now: Provenance[Options]) -> str | None:
    """Return in words how the provenance in a result's JSON differs from what it would be now, None if it does not.

    The provenance is under a key of its own, or among the other keys. Raises one of `JSON_FAILURES` on a damaged file.
    """
    record = record_of(content, dict[str, object])
    written = msgspec.convert(record.get("provenance") or record, Provenance[dict[str, object]])
    now_options: dict[str, object] = msgspec.json.decode(msgspec.json.encode(now.options))
    compared: tuple[tuple[str, Mapping[str, object], Mapping[str, object]], ...] = (
        ("input", written.inputs, now.inputs),
        ("option", written.options, now_options),
        ("version", written.versions, now.versions),
    )
    for kind, before, after in compared:
        changed = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
        if changed:
            more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
            return f"{kind}: {changed[0]}{more}"
    return None


def with_digest(content: bytes) -> bytes:
    """Return a JSON object as the content of a file: indented, with its digest as the last key."""
    text = msgspec.json.format(content, indent=-1)
    return msgspec.json.format(text[:-1] + f',"{DIGEST_KEY}":"{_digest(text)}"}}'.encode()) + b"\n"


def digest_holds(content: bytes) -> bool | None:
    """Return whether a JSON object agrees with the digest that it carries, None if it carries none.

    Raises
    ------
    msgspec.MsgspecError, RecursionError
        It is not JSON.
    """
    if DIGEST_KEY.encode() not in content:
        return None
    text = msgspec.json.format(content, indent=-1)
    last = _LAST_KEY.search(text)
    return last is not None and _digest(text[: last.start()] + b"}") == last[1].decode()


def _digest(text: bytes) -> str:
    return hashlib.sha256(text).hexdigest()
