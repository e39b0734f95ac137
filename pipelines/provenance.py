"""What every artefact records of itself: the command, its options, its inputs' hashes, and the versions."""

import platform
from importlib.metadata import version
from typing import Any

_PACKAGES = ("faintfield", "numpy", "scipy", "numba", "opencv-contrib-python-headless")


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
    """Return the versions of what computes results, by name."""
    return {"python": platform.python_version(), **{name: version(name) for name in _PACKAGES}}
