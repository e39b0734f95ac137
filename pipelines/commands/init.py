"""`faintfield init`: a commented rig.toml to start from."""

from importlib.resources import files
from pathlib import Path
from typing import Any

from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import OutputExists
from faintfield.pipelines.formats.files import write_whole


def init(rig: Path = Path("rig.toml"), /) -> dict[str, Any]:
    """Write a commented configuration, of a simulated rig until you change it.

    Parameters
    ----------
    rig
        File to write; an existing one is left alone.
    """
    if rig.exists():
        raise OutputExists(f"{rig}: is there already and is not overwritten; name another file, or edit this one")
    write_whole(rig, files("faintfield.pipelines.formats").joinpath("rig_template.toml").read_text(encoding="utf-8"))
    inform(f"wrote {rig}; describe your rig in it, then: faintfield check {rig}")
    return {"rig": str(rig)}
