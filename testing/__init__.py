"""Contract tests: what every camera and every stage must do, for our drivers and for those of other packages.

They need pytest. `docs/plugins.md` shows how a package runs them.
"""

import pytest

pytest.register_assert_rewrite("faintfield.testing.camera", "faintfield.testing.stage")  # so that failures show values

from faintfield.testing.camera import camera_contract  # noqa: E402 - after pytest was told
from faintfield.testing.stage import stage_contract  # noqa: E402

__all__ = ["camera_contract", "stage_contract"]
