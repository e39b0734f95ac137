"""The checks of frames: good frames pass, each fault gives its warning."""

from collections.abc import Callable

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


@pytest.mark.parametrize(
    ("kind", "spoil", "word"),
    [
        ("bright", lambda frame: np.where(frame > 3000, 65535, frame), "saturated"),
        ("bright", lambda frame: frame // 100, "contrast"),
        ("flat", lambda frame: frame // 10, "median"),
        ("dark", lambda frame: frame + np.uint16(30) * (np.indices(frame.shape)[1] > 140), "stray light"),
        ("noise_reference", lambda frame: frame + np.uint16(30) * (np.indices(frame.shape)[0] < 20), "stray light"),
    ],
)
def test_bad_frames_give_a_warning(kind: str, spoil: Callable[[Pixels], Pixels], word: str) -> None:
    frame = np.asarray(spoil(scene(kind)), np.uint16)
    findings = check_frame(frame, kind, CheckSettings(), (BOARD,), [])  # type: ignore[arg-type]
    assert any(word in warning and "; " in warning for warning in findings.warnings)


def test_a_blurred_frame_is_noticed_beside_sharp_ones() -> None:
    sharp = scene("bright")
    blurred = sum(np.roll(sharp.astype(float), shift, axis=1) for shift in range(8)) / 8
    usual = [check_frame(sharp, "bright", CheckSettings()).values["sharpness"]] * 5
    assert check_frame(sharp, "bright", CheckSettings(), (), usual).warnings == ()
    findings = check_frame(np.asarray(blurred, np.uint16), "bright", CheckSettings(), (), usual)
    assert any("sharpness" in warning for warning in findings.warnings)
