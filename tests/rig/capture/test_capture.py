"""The capture loop: the order of a frame, requests of the operator, settling, pace."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from unittest import mock

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.rig.cameras.protocol import CameraReport, Pixels
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.capture.guide import Answer, OperatorRequest, Prompt, Status
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.settling import Settling
from faintfield.rig.capture.survey import check_plan, survey
from faintfield.rig.devices import open_rig
from faintfield.rig.errors import CaptureStopped, OutsideTravel, PlanRefused, RigError
from faintfield.rig.plan import Grid, PlannedFrame
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan, taken_frames
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import RigSettings, SettleSettings, StepSettings
from faintfield.rig.simulation.lab import SimulatedLab
from faintfield.rig.stages.protocol import Point
from tests.faults.capturing import BOARD, FRAMES, SMALL_RIG


class Person:
    """An operator with prepared answers and requests.

    `answers` holds a list for each prompt key; `requests` is keyed by the number of frames shown before.
    """

    def __init__(
        self,
        answers: Mapping[str, Sequence[Answer]] | None = None,
        requests: Mapping[int, OperatorRequest] | None = None,
    ) -> None:
        self.answers = {key: list(values) for key, values in (answers or {}).items()}
        self.requests = dict(requests or {})
        self.prompts: list[Prompt] = []
        self.statuses: list[Status] = []
        self.seen: list[PlannedFrame] = []
        self.on_status: Callable[[Status], None] = lambda status: None

    def ask(self, prompt: Prompt) -> Answer:
        self.prompts.append(prompt)
        waiting = self.answers.get(prompt.key)
        answer = waiting.pop(0) if waiting else prompt.unattended
        assert answer in prompt.answers
        return answer

    def take_request(self) -> OperatorRequest | None:
        return self.requests.pop(len(self.seen), None)

    def show_status(self, status: Status) -> None:
        self.statuses.append(status)
        self.on_status(status)

    def show_frame(self, frame: PlannedFrame, pixels: Pixels, values: Mapping[str, float]) -> None:
        self.seen.append(frame)


def run(folder: Path, person: Person, settings: RigSettings = SMALL_RIG) -> RigError | None:
    """Capture; return the failure, None without one."""
    plan = FrozenPlan(survey(open_rig(settings), settings).plan, settings)
    try:
        with open_session(folder, plan) as session:
            Capture(session, open_rig(settings, session.journal), person, lambda path: None).run()
    except RigError as failure:
        return failure
    return None


def assert_whole(folder: Path) -> None:
    verdict = verify(folder)
    assert verdict.problems == ()
    assert (verdict.present, verdict.sealed) == (FRAMES, True)


def test_a_person_is_led_through_all_steps(tmp_path: Path) -> None:
    person = Person()
    assert run(tmp_path / "session", person) is None
    assert [frame.number for frame in person.seen] == list(range(FRAMES))
    assert [prompt.key for prompt in person.prompts] == ["home", "step", "step", "step"]
    assert [prompt.title for prompt in person.prompts[1:]] == [
        "Step 1 of 3: Bright set", "Step 2 of 3: Dark-scene set", "Step 3 of 3: Dark frames",
    ]  # fmt: skip
    assert any("Lights out" in line for line in person.prompts[2].lines)
    with Journal(tmp_path / "session" / "journal.sqlite", read_only=True) as journal:
        told = [event.detail for event in journal.events("prompt")]
    assert [(it["key"], it["title"], it["answer"]) for it in told] == [
        (prompt.key, prompt.title, "go") for prompt in person.prompts
    ]
    last = person.statuses[-1]
    assert (last.step, last.steps, last.done, last.total) == (3, 3, FRAMES - 1, FRAMES)
    assert last.grid == ((-1.0, -1.0, -1.0), (-1.0, 0.75, -1.0))


def test_every_frame_has_its_record(tmp_path: Path) -> None:
    assert run(tmp_path / "session", Person()) is None
    for frame, committed, path in taken_frames(tmp_path / "session"):
        assert path.is_file()
        assert committed.record.position_mm == pytest.approx(list(frame.stop.target), abs=0.02)
        assert committed.record.exposure_s == frame.exposure_s
        assert committed.record.camera["camera"] == "simulated camera"
        assert "median_dn" in committed.record.checks


@pytest.mark.parametrize(("wanted", "answer"), [("stop", None), ("pause", "stop")])
def test_stop_and_go_on(tmp_path: Path, wanted: OperatorRequest, answer: Answer | None) -> None:
    person = Person({"paused": [answer]} if answer else {}, {4: wanted})
    failure = run(tmp_path / "session", person)
    assert isinstance(failure, CaptureStopped)
    assert str(failure) == f"stopped with 4 of {FRAMES} frames taken; run the same command to go on"
    again = Person()
    assert run(tmp_path / "session", again) is None
    assert [frame.number for frame in again.seen] == list(range(4, FRAMES))
    assert_whole(tmp_path / "session")


def test_retake_keeps_both_files_and_counts_the_later(tmp_path: Path) -> None:
    person = Person({}, {3: "retake"})
    assert run(tmp_path / "session", person) is None
    assert [frame.number for frame in person.seen][:5] == [0, 1, 2, 2, 3]
    assert_whole(tmp_path / "session")
    verdict = verify(tmp_path / "session")
    assert verdict.superseded == 1
    assert len(list((tmp_path / "session" / "frames").iterdir())) == FRAMES + 1
    assert taken_frames(tmp_path / "session")[2][1].intent == 4


@pytest.mark.parametrize("late", ["again", "keep"])
def test_skipped_frames_are_asked_for_in_the_end(tmp_path: Path, late: Answer) -> None:
    person = Person({"skipped": [late], "step": ["go", "skip"]}, {1: "skip"})
    assert run(tmp_path / "session", person) is None
    assert person.seen[1].number == 2
    verdict = verify(tmp_path / "session")
    assert verdict.problems == ()
    if late == "again":
        assert_whole(tmp_path / "session")
    else:
        # One frame of the first step, and all six of the second
        assert len(verdict.left_out) == 7
        assert (verdict.present, verdict.sealed, verdict.missing) == (FRAMES - 7, True, ())


def test_nothing_skipped_is_left_out_without_a_person(tmp_path: Path) -> None:
    assert isinstance(run(tmp_path / "session", Person({}, {1: "skip"})), CaptureStopped)
    assert run(tmp_path / "session", Person()) is None
    assert_whole(tmp_path / "session")


def test_declining_to_home_moves_nothing(tmp_path: Path) -> None:
    person = Person({"home": ["stop"]})
    assert isinstance(run(tmp_path / "session", person), CaptureStopped)
    with Journal(tmp_path / "session" / "journal.sqlite", read_only=True) as journal:
        sent = b"".join(data for _, direction, data in journal.traffic() if direction == "sent")
    assert b"$H" not in sent
    assert b"$J" not in sent


def test_what_cannot_be_done_is_refused_before_anything_moves() -> None:
    grid = msgspec.structs.replace(SMALL_RIG.grid, origin_mm=Point(-90.0, -350.0))
    outside = msgspec.structs.replace(SMALL_RIG, grid=grid)
    with pytest.raises(OutsideTravel, match=r"outside the travel"):
        survey(open_rig(outside), outside)
    real_stage = msgspec.structs.replace(
        SMALL_RIG, stage=msgspec.structs.replace(SMALL_RIG.stage, protocol="grbl", port="/dev/ttyUSB0")
    )
    with pytest.raises(PlanRefused, match=r"needs stage\.protocol = 'simulated'"):
        open_rig(real_stage)


SWINGING = msgspec.structs.replace(
    SMALL_RIG,
    camera=SimulatedSettings(size_px=(160, 120)),
    board=(BOARD,),
    grid=Grid(3, 3, 50.0, Point(-350.0, -350.0)),
    step=(StepSettings("charuco", 0.05), StepSettings("dark_scene", 0.1)),
    settle=SettleSettings(exposure_s=0.05),
)


def test_the_stage_rests_before_every_frame(tmp_path: Path) -> None:
    rested_s: list[float] = []
    expose = SimulatedLab.expose

    def watched(lab: SimulatedLab, exposure_s: float, number: int) -> NDArray[np.uint16]:
        rested_s.append(lab._still_s())  # noqa: SLF001
        return expose(lab, exposure_s, number)

    settings = msgspec.structs.replace(SMALL_RIG, settle=SettleSettings(measure=False, wait_s=2.0))
    with mock.patch.object(SimulatedLab, "expose", watched):
        assert isinstance(run(tmp_path / "session", Person({}, {3: "stop"}), settings), CaptureStopped)
        assert run(tmp_path / "session", Person(), settings) is None
    assert len(rested_s) == FRAMES
    assert min(rested_s) >= 2.0


def test_settling_is_measured_once_per_session(tmp_path: Path) -> None:
    folder = tmp_path / "session"
    assert isinstance(run(folder, Person({}, {2: "stop"}), SWINGING), CaptureStopped)
    assert run(folder, Person(), SWINGING) is None
    with Journal(folder / "journal.sqlite", read_only=True) as journal:
        found = journal.details("settling", Settling)
    assert len(found) == 1
    assert found[0].settled
    # The swing of 1.5 mm along both axes, seen at 540 mm, decays by e every 0.25 s; frames are 0.1 s apart, and the
    # controller's reports take the first 0.2 s to 0.4 s
    shift_px = 2**0.5 * 1.5 * 200 / 540
    rest_s = 0.25 * np.log(shift_px / SWINGING.settle.limit_px)
    assert rest_s - 0.4 <= found[0].wait_s <= rest_s - 0.2 + 0.2
    shifts = [shift for _, shift in found[0].curve]
    assert shifts[0] > 5 * max(shifts[-10:])


def test_an_exposure_time_that_the_camera_lacks_is_refused_with_the_nearest() -> None:
    rig = open_rig(SMALL_RIG)
    found = survey(rig, SMALL_RIG)
    rig.stage.connect()
    offered = CameraReport("camera", 1000, exposures_s=(0.05, 0.2, 0.5, 2.0))
    with pytest.raises(PlanRefused, match=r"exposure_s = 0\.1 is not offered .* nearest that is: (0\.05|0\.2);"):
        check_plan(found.plan, rig.stage, offered)
    with pytest.raises(PlanRefused, match=r"exposure_s = 1 is not offered .* nearest that is: (0\.5|2);"):
        check_plan(found.plan, rig.stage, CameraReport("camera", 1000, exposures_s=(0.1, 0.5, 2.0)))
    with pytest.raises(PlanRefused, match=r"exposure_s = 1 is not offered .* nearest that is: 1\.5;"):
        check_plan(found.plan, rig.stage, CameraReport("camera", 1000, exposures_s=(0.1, 0.6, 1.5)))
    check_plan(found.plan, rig.stage, CameraReport("camera", 1000, exposures_s=(0.1005, 0.995)))


def test_the_time_to_go_is_right_after_five_nodes(tmp_path: Path) -> None:
    settings = msgspec.structs.replace(
        SMALL_RIG,
        grid=Grid(2, 7, 50.0, Point(-350.0, -350.0)),
        step=(StepSettings("bright", 0.1), StepSettings("dark_scene", (0.1, 2.0)), StepSettings("dark", 1.0, 20)),
    )
    plan = FrozenPlan(survey(open_rig(settings), settings).plan, settings)
    person, told = Person(), list[tuple[float, float]]()
    with open_session(tmp_path / "session", plan) as session:
        rig = open_rig(settings, session.journal)
        person.on_status = lambda status: told.append((rig.clock.now_s(), status.to_go_s))
        Capture(session, rig, person, lambda path: None).run()
        end_s = rig.clock.now_s()
    # One status for the prompt and two for each frame, moving and exposing; in the first step each frame is a node
    for now_s, to_go_s in told[11 : len(told) - 10]:
        assert to_go_s == pytest.approx(end_s - now_s, rel=0.1, abs=2.0)
    now_s, to_go_s = told[11]
    assert to_go_s == pytest.approx(end_s - now_s, rel=0.1)
