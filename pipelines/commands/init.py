"""`faintfield init`: write a commented rig.toml to start from."""

from pathlib import Path
from typing import Any

from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import OutputExists


def init(rig: Path = Path("rig.toml"), /) -> dict[str, Any]:
    """Write a commented configuration, which describes a simulated rig until you change it.

    Parameters
    ----------
    rig
        File to write; an existing one is left alone.
    """
    from faintfield.pipelines.formats.files import write_whole
    from faintfield.pipelines.formats.rig_file import rig_template

    if rig.exists():
        raise OutputExists(f"{rig}: exists and is not overwritten; name another file, or edit this one")
    write_whole(rig, rig_template())
    inform(f"wrote {rig}; describe your rig in it, then: faintfield check {rig}")
    return {"rig": str(rig)}
