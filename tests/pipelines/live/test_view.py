"""Content of the views of a capture: checks in words, histogram, plan."""

from pathlib import Path

import numpy as np
import pytest

from faintfield.calib.estimate import Estimate
from faintfield.calib.noise_model import NoiseModel
from faintfield.pipelines.live.panel import CapturePanel, SessionFrames
from faintfield.pipelines.live.terminal import describe_plan
from faintfield.pipelines.live.view import CaptureView, CheckRow, frame_view, step_rows
from faintfield.pipelines.planning.known import Sensor
from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.capture.checks import MAIN_QUANTITIES, QUANTITIES, check_frame
from faintfield.rig.capture.guide import TITLES, Prompt, ShownFrame, Status
from faintfield.rig.plan import PlannedFrame, StepKind, Stop
from faintfield.rig.session.resume import open_session
from faintfield.rig.settings import CheckSettings
from faintfield.rig.stages.protocol import Point
from tests.faults.capturing import FRAMES, SMALL_RIG, capture, frozen_plan

_MODEL = NoiseModel(100.0, 2.0, 3.0)
_SENSOR = Sensor("known", Estimate(3.0), Estimate(0.0), Estimate(2.0), Estimate(None), model=_MODEL)


def shown(pixels: Pixels, kind: StepKind) -> ShownFrame:
    frame = PlannedFrame(0, 0, kind, 0, Stop((0, 0), Point(0.0, 0.0)), 0.1, 0)
    panel = CapturePanel(unattended=True)
    panel.show_frame(ShownFrame(frame, pixels, check_frame(pixels, kind, CheckSettings(), [])))
    assert panel.shown is not None
    return panel.shown


@pytest.mark.parametrize("kind", TITLES)
def test_every_check_is_declared(kind: StepKind) -> None:
    pixels = np.random.default_rng(1).integers(90, 110, (64, 64)).astype(np.uint16)
    values = check_frame(pixels, kind, CheckSettings(), []).values
    assert values.keys() <= QUANTITIES.keys()
    assert {*MAIN_QUANTITIES[kind]} <= values.keys()


def test_checks_have_units_limits_verdicts() -> None:
    pixels = np.full((64, 64), 250, np.uint16)
    pixels[:4] = 65535
    assert frame_view(shown(pixels, "flat"), None, 1).checks == (
        CheckRow("saturated pixels", "6.25 %", "at most 1.00 %", "fail"),
        CheckRow("median", "250 DN", "at least 300 DN", "fail"),
    )
    few = frame_view(shown(pixels, "charuco"), None, 1).checks[0]
    assert few == CheckRow("board corners", "0", "at least 6", "low")


def test_histogram_marks_saturation_and_noise() -> None:
    rng = np.random.default_rng(2)
    flat = frame_view(shown(rng.normal(9000, 90, (200, 200)).astype(np.uint16), "flat"), _SENSOR, 1).histogram
    assert (flat.low_dn, flat.high_dn) == (0.0, 65535.0)
    assert [mark.label for mark in flat.marks] == ["saturation 65535 DN", "median 9000 DN", "least median 300 DN"]
    assert int(np.argmax(flat.heights)) == 64 * 9000 // 65535
    dark = rng.normal(100.0, 6.0, (200, 200))
    dark[0, 0] = 60000.0  # a hot pixel does not stretch the range
    histogram = frame_view(shown(dark.astype(np.uint16), "dark"), _SENSOR, 1).histogram
    assert histogram.marks[0].label == "offset 100 ± read noise 6.0 DN"
    assert (histogram.marks[0].low_dn, histogram.marks[0].high_dn) == (94.0, 106.0)
    assert histogram.high_dn < 200
    assert histogram.heights[-1] > 0


def test_plan_tells_done_now_and_next(tmp_path: Path) -> None:
    panel = _StopAt(8)
    assert capture(tmp_path, panel) is not None
    assert panel.status is not None
    with open_session(tmp_path, frozen_plan(SMALL_RIG)) as session:
        session.skip(session.frames[-1])
        frames = SessionFrames(session)
        rows = step_rows(frames, panel.status)
        assert [(row.title, row.state, row.done, row.total) for row in rows] == [
            ("Bright set", "done", 6, 6),
            ("Dark-scene set", "now", 3, 6),
            ("Dark frames", "next", 0, 4),
        ]
        assert rows[0].to_go == ""
        assert rows[1].to_go.startswith("about ")
        assert rows[2].frames == "centre node, 2 x 0.1, 1 s"
        assert rows[2].prepare == ("Cover the lens. Cover the viewfinder too, if the camera has one.",)
        assert describe_plan(frames, None) == [
            "The plan:",
            "   1  Bright set: 6 nodes, 0.1 s   (done)",
            "   2  Dark-scene set: 6 nodes, 0.1 s   (next)",
            "   3  Dark frames: centre node, 2 x 0.1, 1 s",
        ]
        for frame in session.frames[9:12]:
            session.skip(frame)
        assert [row.state for row in step_rows(frames, None)] == ["done", "left out", "next"]
        view = CaptureView(panel, frames)
        [snr, stray] = view.state().courses
        assert (len(snr.values), snr.frames_per_point) == (3, 1)
        assert stray.last.endswith(" DN")
        assert view.state().frame is view.state().frame


class _StopAt(CapturePanel):
    """An unattended panel that asks to stop when so many of all frames are taken."""

    def __init__(self, frames: int) -> None:
        super().__init__(unattended=True)
        self._last = frames

    def show_status(self, status: Status) -> None:
        super().show_status(status)
        assert status.total == FRAMES
        if status.done == self._last:
            self.press("stop")


def test_presses_before_prompt_do_not_answer_it() -> None:
    panel, prompt = CapturePanel(unattended=False), Prompt("step", "Step 2", (), ("go", "skip", "stop"), "go")

    def answer() -> None:
        if panel.asked is not None:
            panel.press("go")

    panel.on_change.append(answer)
    panel.press("skip")  # meant for a frame of the step before
    assert panel.ask(prompt) == "go"
    panel.press("stop")
    assert panel.ask(prompt) == "stop"
