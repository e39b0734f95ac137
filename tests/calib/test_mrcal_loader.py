"""mrcal and casadi are loaded only where they are needed, and a missing mrcal is a named failure."""

import subprocess
import sys

import pytest

from faintfield.calib.errors import MissingMrcal
from faintfield.calib.geometry import calibrate_geometry
from faintfield.calib.mrcal_loader import load_mrcal
from tests.calib.geometry.simulated import BOARDS, OPTICS, simulated


@pytest.mark.parametrize(
    ("modules", "absent"),
    [
        ("lens, homography, noise_model, board, detection", ("mrcal", "casadi")),
        ("geometry, geometry.stage, noise", ("mrcal",)),
    ],
)
def test_imports_load_no_solver(modules: str, absent: tuple[str, ...]) -> None:
    imports = "; ".join(f"import faintfield.calib.{name}" for name in modules.split(", "))
    code = f"import sys; {imports}; print([name for name in {absent} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_missing_mrcal_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    assert load_mrcal().__name__ == "mrcal"
    monkeypatch.setitem(sys.modules, "mrcal", None)
    given = simulated(1)
    with pytest.raises(MissingMrcal, match="; run: pip install --no-deps mrcal"):
        calibrate_geometry(BOARDS, given.observations, OPTICS.size_px, given.reference)
