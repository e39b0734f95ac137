"""The capture loop: the order of a frame, requests of the operator, settling, pace."""

from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from faintfield.rig.cameras.protocol import CameraReport, Exposure
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.capture.checks import Settling
from faintfield.rig.capture.guide import Answer, OperatorRequest, Pace
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import check_plan, survey
from faintfield.rig.devices import open_rig
from faintfield.rig.errors import CameraError, CaptureStopped, OutsideTravel, PlanRefused
from faintfield.rig.plan import Grid, PlannedFrame, Stop
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import taken_frames
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import SettleSettings, StepSettings
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.lab import SimulatedCamera, SimulatedLab
from faintfield.rig.stages.protocol import Point
from tests.faults.capturing import BOARD, FRAMES, SMALL_RIG, Operator, assert_complete, capture, events, frozen_plan
from tests.rig.stages.benches import homed


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "session"


def test_operator_is_led_through_all_steps(folder: Path) -> None:
    operator = Operator()
    assert capture(folder, operator) is None
    assert operator.frames == list(range(FRAMES))
    assert [prompt.key for prompt in operator.prompts] == ["home", "step", "step", "step"]
    assert [prompt.title for prompt in operator.prompts[1:]] == [
        "Step 1 of 3: Bright set", "Step 2 of 3: Dark-scene set", "Step 3 of 3: Dark frames",
    ]  # fmt: skip
    assert any("Lights out" in line for line in operator.prompts[2].lines)
    answers = [event.detail for event in events(folder, "prompt")]
    assert [(detail["key"], detail["title"], detail["answer"]) for detail in answers] == [
        (prompt.key, prompt.title, "go") for prompt in operator.prompts
    ]
    last = operator.statuses[-1]
    assert (last.step, last.steps, last.done, last.total) == (3, 3, FRAMES, FRAMES)
    assert last.grid == ((-1.0, -1.0, -1.0), (-1.0, 1.0, -1.0))
    for frame, committed, path in taken_frames(folder):
        assert path.is_file()
        assert committed.record.position_mm == pytest.approx(list(frame.stop.target), abs=0.02)
        assert committed.record.exposure_s == frame.exposure_s
        assert committed.record.camera["camera"] == "simulated camera"
        assert "median_dn" in committed.record.checks


@pytest.mark.parametrize(("request_4", "answer"), [("stop", None), ("pause", "stop")])
def test_stopped_capture_goes_on(folder: Path, request_4: OperatorRequest, answer: Answer | None) -> None:
    failure = capture(folder, Operator({"paused": [answer]} if answer else {}, {4: request_4}))
    assert isinstance(failure, CaptureStopped)
    assert str(failure) == f"stopped with 4 of {FRAMES} frames taken; run the same command to go on"
    operator = Operator()
    assert capture(folder, operator) is None
    assert operator.frames == list(range(4, FRAMES))
    assert_complete(folder)


def test_retake_keeps_both_files_counts_the_later(folder: Path) -> None:
    operator = Operator({}, {3: "retake"})
    assert capture(folder, operator) is None
    assert operator.frames[:5] == [0, 1, 2, 2, 3]
    assert_complete(folder, superseded=1)
    assert len(list((folder / "frames").iterdir())) == FRAMES + 1
    assert taken_frames(folder)[2][1].intent == 4


def test_retake_in_pause_stays_paused(folder: Path) -> None:
    operator = Operator({"paused": ["retake", "retake", "stop"]}, {3: "pause"})
    assert isinstance(capture(folder, operator), CaptureStopped)
    assert operator.frames == [0, 1, 2, 2, 2]
    assert [prompt.key for prompt in operator.prompts] == ["home", "step", "paused", "paused", "paused"]


@pytest.mark.parametrize("answer", ["again", "keep"])
def test_skipped_frames_are_asked_for_at_the_end(folder: Path, answer: Answer) -> None:
    operator = Operator({"skipped": [answer], "step": ["go", "skip"]}, {1: "skip"})
    assert capture(folder, operator) is None
    assert operator.frames[1] == 2
    if answer == "again":
        assert_complete(folder)
    else:
        verdict = verify(folder)
        assert (verdict.problems, verdict.missing) == ((), ())
        # One frame of the first step, and all six of the second
        assert (len(verdict.left_out), verdict.present, verdict.sealed) == (7, FRAMES - 7, True)


def test_unattended_capture_leaves_no_frame_out(folder: Path) -> None:
    assert isinstance(capture(folder, Operator({}, {1: "skip"})), CaptureStopped)
    assert capture(folder) is None
    assert_complete(folder)


def test_declining_to_home_moves_nothing(folder: Path) -> None:
    assert isinstance(capture(folder, Operator({"home": ["stop"]})), CaptureStopped)
    with Journal(folder / "journal.sqlite", read_only=True) as journal:
        sent = b"".join(data for _, direction, data in journal.traffic() if direction == "sent")
    assert b"$H" not in sent
    assert b"$J" not in sent


def test_impossible_rig_is_refused_before_motion() -> None:
    outside = replace(SMALL_RIG, grid=replace(SMALL_RIG.grid, origin_mm=Point(-90.0, -350.0)))
    with pytest.raises(OutsideTravel, match=r"outside the travel"):
        survey(open_rig(outside), outside)
    real_stage = replace(SMALL_RIG, stage=replace(SMALL_RIG.stage, protocol="grbl", port="/dev/ttyUSB0"))
    with pytest.raises(PlanRefused, match=r"needs stage\.protocol = 'simulated'"):
        open_rig(real_stage)


@pytest.mark.parametrize(
    ("offered_s", "wrong"),
    [
        ((0.05, 0.2, 0.5, 2.0), r"not offer exposure_s = 0\.1, the nearest is (0\.05|0\.2);"),
        ((0.1, 0.6, 1.5), r"not offer exposure_s = 1, the nearest is 1\.5;"),
        ((0.1005, 0.995), None),
    ],
)
def test_nearest_exposure_is_named_if_missing(offered_s: tuple[float, ...], wrong: str | None) -> None:
    rig = open_rig(SMALL_RIG)
    plan = survey(rig, SMALL_RIG).plan
    rig.stage.connect()
    report = CameraReport("camera", 1000, exposures_s=offered_s)
    if wrong is None:
        check_plan(plan, rig.stage, report)
    else:
        with pytest.raises(PlanRefused, match=wrong):
            check_plan(plan, rig.stage, report)


def test_stage_rests_before_every_frame(folder: Path) -> None:
    rests_s: list[float] = []
    expose = SimulatedLab.expose

    def watched(lab: SimulatedLab, exposure_s: float, number: int) -> NDArray[np.uint16]:
        rests_s.append(lab.still_s())
        return expose(lab, exposure_s, number)

    settings = replace(SMALL_RIG, settle=SettleSettings(measure=False, wait_s=2.0))
    with mock.patch.object(SimulatedLab, "expose", watched):
        assert isinstance(capture(folder, Operator({}, {3: "stop"}), settings), CaptureStopped)
        assert capture(folder, settings=settings) is None
    assert len(rests_s) == FRAMES
    assert min(rests_s) >= 2.0


def test_settling_is_measured_once_per_session(folder: Path) -> None:
    rests_s: dict[int, float] = {}
    expose = SimulatedLab.expose

    def watched(lab: SimulatedLab, exposure_s: float, number: int) -> NDArray[np.uint16]:
        rests_s[number] = lab.still_s()
        return expose(lab, exposure_s, number)

    swinging = replace(
        SMALL_RIG,
        camera=SimulatedSettings(size_px=(160, 120)),
        board=(BOARD,),
        grid=Grid(2, 2, 50.0, Point(-350.0, -350.0)),
        step=(StepSettings("charuco", 0.05), StepSettings("dark_scene", 0.1)),
        settle=SettleSettings(exposure_s=0.05),
    )
    with mock.patch.object(SimulatedLab, "expose", watched):
        assert isinstance(capture(folder, Operator({}, {2: "stop"}), swinging), CaptureStopped)
        assert capture(folder, settings=swinging) is None
    with Journal(folder / "journal.sqlite", read_only=True) as journal:
        (settling,) = journal.details("settling", Settling)
    measured_s = settling.rest_s("bright", swinging.settle)
    # The swing of 1.5 mm along both axes, seen at 540 mm, decays by e every 0.25 s; frames are 0.1 s apart, and the
    # controller's reports take the first 0.2 s to 0.4 s
    shift_px = 2**0.5 * 1.5 * 200 / 540
    rest_s = 0.25 * np.log(shift_px / swinging.settle.limit_px)
    assert measured_s is not None
    assert rest_s - 0.4 <= measured_s <= rest_s - 0.2 + 0.2
    # A board waits for less swing than the scene
    of_boards_s = settling.rest_s("charuco", swinging.settle)
    assert of_boards_s is not None
    assert of_boards_s >= measured_s + 0.3
    frames = taken_frames(folder)
    boards, scene = ([rests_s[taken.intent] for frame, taken, _ in frames if frame.step == step] for step in (0, 1))
    assert min(boards) >= of_boards_s
    assert measured_s <= min(scene) <= max(scene) < of_boards_s
    shifts = [shift for _, shift in settling.curve]
    assert shifts[0] > 5 * max(shifts[-10:])


def test_remaining_time_is_right_after_five_nodes(folder: Path) -> None:
    settings = replace(
        SMALL_RIG,
        grid=Grid(2, 7, 50.0, Point(-350.0, -350.0)),
        step=(StepSettings("bright", 0.1), StepSettings("dark_scene", (0.1, 2.0)), StepSettings("dark", 1.0, 20)),
    )
    operator, estimates = Operator(), list[tuple[float, float]]()
    with open_session(folder, frozen_plan(settings)) as session:
        rig = open_rig(settings, session.journal)
        operator.on_status = lambda status: estimates.append((rig.clock.now_s(), status.to_go_s))
        Capture(session, rig, operator, lambda path: None).run()
        end_s = rig.clock.now_s()
    # One status for the prompt and two for each frame, moving and exposing; in the first step each frame is a node
    for now_s, to_go_s in estimates[11 : len(estimates) - 10]:
        assert to_go_s == pytest.approx(end_s - now_s, rel=0.1, abs=2.0)
    now_s, to_go_s = estimates[11]
    assert to_go_s == pytest.approx(end_s - now_s, rel=0.1)


def frame(number: int, step: int, target: Point, exposure_s: float) -> PlannedFrame:
    return PlannedFrame(number, step, "bright", 0, Stop((0, number), target), exposure_s, 0)


def test_remaining_time_sums_motions_stops_exposures_checks() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    pace = Pace(stage, bench.clock, rest_s=0.7, readout_s=0.3)
    a, b = Point(-100.0, -100.0), Point(-50.0, -100.0)
    frames = [frame(0, 0, a, 2.0), frame(1, 0, a, 3.0), frame(2, 0, b, 5.0), frame(3, 1, b, 7.0)]
    pace.check_s = 11.0
    # At first: a stop takes 0.15 s and the rest, a frame a fifth of a second and the readout
    motion_s = pace.remaining_s(frames[1:3], 0) - (2 * (0.15 + 0.7) + 2 * (0.2 + 0.3) + 3.0 + 5.0)
    rate, acceleration = stage.feed_mm_per_s(), stage.identify().motion.acceleration_mm_per_s2[0]
    assert motion_s == pytest.approx(50.0 / rate + rate / acceleration)  # upwards, straight to the place
    expected = 3 * (0.15 + 0.7) + 4 * (0.2 + 0.3) + 17.0 + motion_s
    assert pace.remaining_s(frames, 2) == pytest.approx(expected + 2 * 11.0)
    # Measured times replace the guesses; the first frame of a stop is told from the next
    pace.here = a
    pace.depart()
    assert pace.here is None
    bench.clock.sleep_s(motion_s + 4.0)
    pace.arrive(b, "bright", timed=True)
    assert pace.here == b
    for number, (exposure_s, besides_s) in enumerate(((5.0, 0.9), (5.0, 0.4), (7.0, 0.6))):
        begun_s = bench.clock.now_s()
        bench.clock.sleep_s(exposure_s + besides_s)
        pace.finish_frame(begun_s, exposure_s, repeated=number > 0)
    assert pace.remaining_s([frame(3, 1, b, 7.0)], 0) == pytest.approx(4.0 + 0.9 + 7.0)
    again = [frame(3, 1, b, 7.0), frame(4, 1, b, 7.0)]
    assert pace.remaining_s(again, 0) == pytest.approx(4.0 + 0.9 + 7.0 + 0.5 + 7.0)


def test_test_frame_is_shown_and_not_recorded(tmp_path: Path) -> None:
    folders = tmp_path / "without", tmp_path / "with"
    operator = Operator({"step": ["test", "test", "go", "go", "test", "go"]})
    assert capture(folders[0]) is None
    assert capture(folders[1], operator) is None
    tests = [shown for shown in operator.shown if not shown.recorded]
    assert [(shown.frame.kind, shown.frame.exposure_s) for shown in tests] == [("bright", 0.1)] * 2 + [("dark", 0.1)]
    assert all(shown.findings.values["median_dn"] > 0 for shown in tests)
    assert operator.frames == list(range(FRAMES))
    assert_complete(folders[1])
    without, with_tests = (sorted(path.name for path in (folder / "frames").iterdir()) for folder in folders)
    assert with_tests == without


def test_failed_test_frame_leads_back_to_prompt(folder: Path) -> None:
    operator = Operator({"step": ["test"]})
    expose = SimulatedCamera.expose

    def expose_frames_only(camera: SimulatedCamera, exposure_s: float, number: int) -> Exposure:
        if number >= 10**9:
            raise CameraError("no picture; look")
        return expose(camera, exposure_s, number)

    with mock.patch.object(SimulatedCamera, "expose", expose_frames_only):
        assert capture(folder, operator) is None
    assert [prompt.key for prompt in operator.prompts] == ["home", "step", "camera", "step", "step", "step"]
    assert "failed" in {status.camera for status in operator.statuses}
    assert_complete(folder)


def test_status_states_stage_camera_and_steps(folder: Path) -> None:
    operator = Operator()
    assert capture(folder, operator) is None
    states = [(status.doing, status.stage, status.camera) for status in operator.statuses]
    assert states[0] == ("connected", "connected, its position is not known", "ready")
    assert states[1] == ("homing", "homes", "ready")
    assert ("exposing", "at rest at -300.0, -350.0 mm", "exposes for 0.1 s") in states
    assert ("moving", "moves to node 0, 1", "ready") in states
    first, last = operator.statuses[0], operator.statuses[-1]
    assert sum(first.step_to_go_s) == pytest.approx(first.to_go_s)
    assert min(first.step_to_go_s) > 0
    assert last.step_to_go_s == (0.0, 0.0, 0.0)
