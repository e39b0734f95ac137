"""rig.toml, read and checked; and what the commands on it share."""

from pathlib import Path

from faintfield.pipelines.errors import InputError
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.toml_files import read_toml
from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.settings import RigSettings


def read_rig(path: Path) -> RigSettings:
    """Read a rig.toml.

    Raises
    ------
    MissingFile, BadValue, UnknownKey
        With the path and the key.
    """
    return read_toml(path, RigSettings)


def decoded(path: Path) -> Pixels | None:
    """Return the pixels of a frame's file, None when it cannot be decoded here."""
    try:
        return read_frame(path).pixels_dn
    except InputError:
        return None
