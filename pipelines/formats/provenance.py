"""What every artefact records of itself (command, options, inputs' hashes, versions), and whether it still holds."""

import platform
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import msgspec

_PACKAGES = ("faintfield", "numpy", "scipy", "numba", "opencv-contrib-python-headless", "mrcal", "casadi")


def provenance(command: str, options: dict[str, Any], inputs: dict[str, str]) -> dict[str, Any]:
    """Return the record that goes beside or into a result.

    Parameters
    ----------
    command : str
        The command's name.
    options : dict
        Its options as they took effect.
    inputs : dict
        SHA-256 by file name.
    """
    return {
        "command": command,
        "options": options,
        "inputs": inputs,
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Return the versions of the packages that compute results, by name; one that is not installed is left out."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):  # mrcal is installed apart
            found[name] = version(name)
    return found


def first_difference(origin: dict[str, Any], now: dict[str, Any]) -> str | None:
    """Return in words the first thing in which the origin of a result differs from what it would be now.

    Parameters
    ----------
    origin : dict
        What the result says of itself, as it was read from its file.
    now : dict
        Of `provenance`: what it would say if it were made now.
    """
    now = msgspec.json.decode(msgspec.json.encode(now))
    for key, called in (("inputs", "input"), ("options", "option"), ("versions", "version")):
        before, after = origin.get(key, {}), now[key]
        changed = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
        if changed:
            more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
            return f"{called}: {changed[0]}{more}"
    return None
