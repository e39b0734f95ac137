"""Read rig.toml, its template, and the stored settings of the stage beside it."""

from importlib.resources import files
from pathlib import Path

from faintfield.pipelines.formats.reading import is_file, read_json
from faintfield.pipelines.formats.toml_files import read_toml
from faintfield.rig.errors import UnknownPlugin
from faintfield.rig.plugins import fold_plugins
from faintfield.rig.settings import RigSettings


def read_rig(path: Path) -> RigSettings:
    """Read a rig.toml; raises as `read_rig_tables` does."""
    return read_rig_tables(path, RigSettings)


def read_rig_tables[T](path: Path, kind: type[T]) -> T:
    """Read a rig.toml, or those of its tables that `kind` has; raise as `read_toml` does, or UnknownPlugin."""
    try:
        return read_toml(path, kind, fold_plugins)
    except UnknownPlugin as failure:
        raise UnknownPlugin(f"{path}: {failure}") from None


def rig_template() -> str:
    """Return the text of a commented rig.toml, which describes a simulated rig."""
    return files("faintfield.pipelines.formats").joinpath("rig_template.toml").read_text(encoding="utf-8")


def stage_settings_path(rig: Path) -> Path:
    """Return the path of the stored settings of the stage of a rig.toml."""
    return rig.with_suffix(".stage.json")


def read_stage_settings(rig: Path) -> dict[str, str] | None:
    """Read the stored settings of the stage of a rig.toml, None if there are none."""
    path = stage_settings_path(rig)
    if not is_file(path):
        return None
    return read_json(path, dict[str, str], what="what --remember writes", remedy="run with --remember again")
