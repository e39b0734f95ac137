"""The rig.toml that `faintfield init` writes."""

from pathlib import Path

from faintfield.calib.noise.likelihood.response import LINEARITY_RANGE
from faintfield.pipelines.formats.toml_files import read_rig, write_template
from faintfield.rig.settings import CheckSettings, DriftSettings, SettleSettings


def test_template_states_the_default_values(tmp_path: Path) -> None:
    write_template(tmp_path / "rig.toml")
    settings = read_rig(tmp_path / "rig.toml")
    defaults = SettleSettings(), DriftSettings(), CheckSettings()
    assert (settings.settle, settings.drift, settings.checks) == defaults


def test_flats_of_template_determine_linearity_error(tmp_path: Path) -> None:
    write_template(tmp_path / "rig.toml")
    (flats,) = (step for step in read_rig(tmp_path / "rig.toml").steps() if step.kind == "flat")
    low, high = (share * max(flats.exposure_s) for share in LINEARITY_RANGE)
    assert sum(low <= exposure_s <= high for exposure_s in flats.exposure_s) >= 3
