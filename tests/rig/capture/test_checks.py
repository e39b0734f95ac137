"""The checks of frames: good frames pass, each fault gives its warning."""

import numpy as np
import pytest

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.capture.checks import check_frame
from faintfield.rig.capture.guide import TITLES
from faintfield.rig.settings import CheckSettings
from tests.faults.capturing import BOARD


def scene(kind: str, **changes: float) -> Pixels:
    """Return a good frame of a kind."""
    generator = np.random.default_rng(3)
    noise = generator.normal(100.0, 3.0, (120, 160))
    if kind == "charuco":
        picture = np.kron(BOARD.in_opencv().generateImage((160, 106)), np.ones((3, 3)))
        noise = 100.0 + 20.0 * np.pad(picture, 20, constant_values=255)
    elif kind in ("bright", "flat"):
        noise += 2000.0 + (1500.0 * (np.indices(noise.shape).sum(axis=0) % 24 < 12) if kind == "bright" else 0.0)
    return noise.astype(np.uint16)


@pytest.mark.parametrize("kind", TITLES)
def test_good_frames_give_no_warning(kind: str) -> None:
    findings = check_frame(scene(kind), kind, CheckSettings(), (BOARD,), [0.1])  # type: ignore[arg-type]
    assert findings.warnings == ()
    if kind == "charuco":
        assert findings.values["board_corners"] == 8 * 5
