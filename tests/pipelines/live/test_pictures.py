"""Pictures of frames, as terminal and page show them."""

import numpy as np

from faintfield.pipelines.live.panel import CapturePanel
from faintfield.pipelines.live.terminal import _frame_picture, describe_values, display_levels
from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.capture.checks import Findings
from faintfield.rig.capture.guide import ShownFrame
from faintfield.rig.plan import PlannedFrame, StepKind, Stop
from faintfield.rig.stages.protocol import Point


def shown(panel: CapturePanel, pixels: Pixels, kind: StepKind, step: int = 0) -> ShownFrame:
    frame = PlannedFrame(0, step, kind, 0, Stop((0, 0), Point(0.0, 0.0)), 0.1, 0)
    panel.show_frame(ShownFrame(frame, pixels, Findings({"snr": 0.16})))
    assert panel.shown is not None
    return panel.shown


def test_terminal_draws_bright_pixels_brightest() -> None:
    ramp = np.tile(np.arange(48, dtype=np.uint16) * 1000, (4, 1))
    styles = [
        span.style for span in _frame_picture(shown(CapturePanel(unattended=True), ramp, "bright"), 20).spans[:48]
    ]
    reds = [int(str(style).split("(")[1].split(",")[0]) for style in styles]
    assert reds == sorted(reds)
    assert (reds[0], reds[-1]) == (0, 191)


def test_dark_frames_of_a_step_share_scale() -> None:
    panel = CapturePanel(unattended=True)
    noise = np.random.default_rng(4).normal(100.0, 7.0, (60, 80))
    first, lit = shown(panel, noise, "dark_scene"), shown(panel, noise + 30.0, "dark_scene")
    assert first.scale_dn == lit.scale_dn
    levels = [float(display_levels(frame.pixels, 80, frame.scale_dn).mean()) for frame in (first, lit)]
    assert levels[1] > levels[0] + 60
    assert describe_values(first) == ["SNR of the brightest part 0.16", "black 79 DN, white 142 DN in this step"]
    assert shown(panel, noise + 30.0, "dark", step=1).scale_dn != first.scale_dn
    assert shown(panel, noise, "bright", step=2).scale_dn is None


def test_picture_leaves_room_for_words() -> None:
    frame = shown(CapturePanel(unattended=True), np.zeros((48, 64), np.uint16), "bright")
    assert [_frame_picture(frame, lines).plain.count("\n") for lines in (30, 9, 1)] == [18, 9, 0]
