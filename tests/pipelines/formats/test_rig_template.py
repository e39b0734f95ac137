"""The rig.toml that `faintfield init` writes."""

from pathlib import Path

from faintfield.pipelines.formats.toml_files import read_rig, write_template
from faintfield.rig.settings import CheckSettings, DriftSettings, SettleSettings


def test_template_states_the_default_values(tmp_path: Path) -> None:
    write_template(tmp_path / "rig.toml")
    settings = read_rig(tmp_path / "rig.toml")
    defaults = SettleSettings(), DriftSettings(), CheckSettings()
    assert (settings.settle, settings.drift, settings.checks) == defaults
