"""Modules that need no solver are imported without one."""

import subprocess
import sys


def test_imports_load_no_solver() -> None:
    light, heavier = (
        "; ".join(f"import faintfield.calib.{name}" for name in names)
        for names in (["lens", "homography", "noise_model", "board", "detection"], ["geometry.stage", "noise"])
    )
    code = f"import sys; {light}; assert 'casadi' not in sys.modules; {heavier}; assert 'mrcal' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
