"""mrcal and casadi are loaded only where they are needed, and a missing mrcal is a named failure."""

import subprocess
import sys

import pytest

from faintfield.calib.errors import MissingMrcal
from faintfield.calib.geometry import calibrate_geometry
from faintfield.calib.mrcal_loader import load_mrcal
from tests.calib.geometry.simulated import BOARDS, OPTICS, simulated


def test_imports_load_no_solver() -> None:
    light, heavier = (
        "; ".join(f"import faintfield.calib.{name}" for name in names)
        for names in (["lens", "homography", "noise_model", "board", "detection"], ["geometry.stage", "noise"])
    )
    code = f"import sys; {light}; assert 'casadi' not in sys.modules; {heavier}; assert 'mrcal' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_missing_mrcal_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    assert load_mrcal().__name__ == "mrcal"
    monkeypatch.setitem(sys.modules, "mrcal", None)
    given = simulated(1)
    with pytest.raises(MissingMrcal, match="; run: pip install --no-deps mrcal"):
        calibrate_geometry(BOARDS, given.observations, OPTICS.size_px, given.reference)
