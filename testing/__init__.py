"""Contract tests: what every camera, stage, light and sweep must do, ours and those of other packages.

They need pytest. `docs/tutorials/camera_driver.md` shows how a package runs them.
"""

import pytest

_CONTRACTS = ("camera", "light", "stage", "sweeps")
pytest.register_assert_rewrite(*(f"faintfield.testing.{name}" for name in _CONTRACTS))  # so that failures show values

from faintfield.testing.camera import camera_contract  # noqa: E402 - after pytest was told
from faintfield.testing.light import light_contract  # noqa: E402
from faintfield.testing.stage import stage_contract  # noqa: E402
from faintfield.testing.sweeps import sweeps_contract  # noqa: E402

__all__ = ["camera_contract", "light_contract", "stage_contract", "sweeps_contract"]
