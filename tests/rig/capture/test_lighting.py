"""Lights of a session: set for each step, verified, judged by the frames, and off at its end."""

from pathlib import Path

import pytest
from msgspec.structs import replace

from faintfield.rig.cameras.protocol import Exposure
from faintfield.rig.capture.guide import Answer, OperatorRequest, Status
from faintfield.rig.errors import CaptureStopped, LightError
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.session import taken_frames
from faintfield.rig.settings import DriftSettings, StepSettings
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.simulation.lab import TRUE_LIGHTS
from tests.faults.capturing import Operator, events
from tests.faults.lit_laboratory import STEPS, Killed, LitLab, WatchingCamera
from tests.rig.stages.benches import firmware, on_homing


@pytest.fixture
def lab(tmp_path: Path) -> LitLab:
    return LitLab(tmp_path / "session", SimulatedGrbl)


def test_only_what_needs_a_hand_is_asked_for(lab: LitLab) -> None:
    operator = Operator()
    assert lab.run(operator) is None
    lab.assert_lights_and_positions()
    steps = [prompt for prompt in operator.prompts if prompt.key == "step"]
    # The board, and its removal
    assert [prompt.title for prompt in steps] == ["Step 1 of 5: Board sweep 1", "Step 2 of 5: Bright set"]
    assert not any("lights" in line.lower() for prompt in steps for line in prompt.lines)
    for frame, committed, _ in taken_frames(lab.folder):
        lights = ",".join(sorted(STEPS[frame.step].lights or ()))
        assert committed.record.camera[TRUE_LIGHTS] == lights
        assert committed.record.lights == tuple(lights.split(",") if lights else ())
    switched = [event.detail["on"] for event in events(lab.folder, "lights")]
    assert switched == [
        [], ["board", "shutter"], [], ["room", "shutter"], [], ["scene", "shutter"], [], ["room"], [],
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("answers", "requests", "asked"),
    [
        ({"step": ["go", "skip"], "skipped": ["keep"]}, {}, ["Board sweep 1", "Bright set", "Dark-scene set"]),
        (
            {"skipped": ["again"]},
            {1: "skip", 13: "skip"},
            ["Board sweep 1", "Bright set", "Board sweep 1", "Dark-scene set"],
        ),
    ],
)
def test_board_is_taken_away_before_any_later_step(
    lab: LitLab, answers: dict[str, list[Answer]], requests: dict[int, OperatorRequest], asked: list[str]
) -> None:
    operator = Operator(answers, requests)
    assert lab.run(operator) is None
    titles = [prompt.title.partition(": ")[2] for prompt in operator.prompts if prompt.key == "step"]
    assert titles == asked


def test_light_that_stays_on_is_shown(lab: LitLab) -> None:
    operator = Operator()
    lab.on_exposure[12] = lambda: setattr(lab.shutter, "broken", True)
    assert isinstance(lab.run(operator), LightError)
    assert any("was not switched off" in warning for warning in operator.statuses[-1].warnings)


@pytest.mark.parametrize("test", [False, True])
def test_watched_camera_is_triggered_for_every_frame(lab: LitLab, test: bool) -> None:
    calls: list[str] = []

    class Untriggered(WatchingCamera):
        def await_silence(self, exposure_s: float) -> None:
            calls.append("silence")

        def expose(self, exposure_s: float, number: int) -> Exposure:
            calls.append("exposure")
            return super().expose(exposure_s, number)

    lab.camera_type = Untriggered
    lights = None if test else ("room", "shutter")
    lab.settings = replace(lab.settings, step=(StepSettings("bright", 0.1, lights=lights),))
    operator = Operator({"step": ["test", "go"]} if test else {})
    operator.on_status = lambda status: calls.append("told") if status.doing.startswith("exposing") else None
    lab.run(operator)
    assert calls[:6] == ["silence", "told", "exposure"] * 2  # of a frame that is not kept, and of the first one
    assert calls.count("told") == calls.count("exposure") > 2


def test_stopped_capture_leaves_no_light_on(lab: LitLab) -> None:
    stops: list[int] = []
    for failure in (CaptureStopped, KeyboardInterrupt):
        operator = Operator({}, {3: "stop"})
        if failure is KeyboardInterrupt:
            operator = Operator()

            def interrupt(status: Status) -> None:
                if status.doing == "moving" and status.done >= 5 and not stops:
                    stops.append(status.done)
                    lab.bench.clock.after(0.5, stop)

            def stop() -> None:
                raise KeyboardInterrupt

            operator.on_status = interrupt
            with pytest.raises(KeyboardInterrupt):
                lab.run(operator)
        else:
            assert isinstance(lab.run(operator), CaptureStopped)
        assert lab.lights_on() == set()
        assert not lab.bench.firmware.mechanics.moving
        assert events(lab.folder, "lights")[-1].detail == {"on": []}
    assert lab.run() is None
    lab.assert_lights_and_positions()


def test_lights_that_a_kill_left_on_are_set_anew(lab: LitLab) -> None:
    lab.resets_on_open = False
    lab.switch_on()
    lab.on_exposure[12] = lab.kill
    assert isinstance(lab.run(), Killed)
    assert lab.lights_on() == {"room", "shutter"}
    assert lab.run() is None
    lab.assert_lights_and_positions()


def test_recovery_between_frames_sets_lights_anew(tmp_path: Path) -> None:
    lab = LitLab(tmp_path / "session", SimulatedMarlin)  # which reports no outputs
    lab.settings = replace(lab.settings, drift=DriftSettings(every_nodes=2))

    def restart(homing: int) -> None:
        if homing == 1:
            lab.bench.clock.after(0.5, lab.bench.firmware.restart)

    lab.on_exposure[16] = lambda: on_homing(lab.bench, restart)  # of the drift check within the dark scene
    assert lab.run() is None
    lab.assert_lights_and_positions()
    assert events(lab.folder, "suspect")
    assert events(lab.folder, "light_failed") == []


@pytest.mark.parametrize("exposure", [1, 11])
def test_burnt_out_lamp_ends_the_capture(lab: LitLab, exposure: int) -> None:
    def burn_out() -> None:
        lab.shutter.burnt_out = True

    lab.on_exposure[exposure] = burn_out
    failure = lab.run()
    assert isinstance(failure, LightError)
    assert "above that of a frame without light, limit" in str(failure)
    assert len(events(lab.folder, "light_failed")) == 3
    lab.switch_on()
    assert lab.run() is None
    lab.assert_lights_and_positions()


def test_faint_light_that_never_shone_gives_a_warning(lab: LitLab) -> None:
    lab.on_exposure[15] = lambda: setattr(lab.shutter, "burnt_out", True)  # before the first frame of the dark scene
    assert lab.run() is None
    (frame,) = [committed.record for frame, committed, _ in taken_frames(lab.folder) if frame.number == 12]
    assert any("DN can be told from noise; look whether the light shines" in warning for warning in frame.warnings)
    lit = [committed.record for frame, committed, _ in taken_frames(lab.folder) if frame.number < 12]
    assert not any("from noise" in warning for record in lit for warning in record.warnings)


def test_light_in_the_dark_is_refused(lab: LitLab) -> None:
    """The shutter is stuck and reports nothing of it, while the room is lit for the dark frames."""
    for number in range(29, 32):
        lab.on_exposure[number] = lambda: setattr(lab.shutter, "stuck_open", True)
    failure = lab.run()
    assert isinstance(failure, LightError)
    assert "above that of a dark frame, limit 8 DN" in str(failure)


def test_light_switched_by_others_repeats_the_frame(lab: LitLab) -> None:
    grbl = firmware(lab.bench, SimulatedGrbl)
    lab.on_exposure[17] = lambda: grbl.receive(b"\xa0")
    assert lab.run() is None
    lab.assert_lights_and_positions()
    (failed,) = events(lab.folder, "light_failed")
    assert "light scene: reports that it is off, and has to be on" in str(failed.detail["message"])
    with Journal(lab.folder / "journal.sqlite", read_only=True) as journal:
        assert len(journal.uncommitted()) == 1


def test_lights_out_of_reach_are_named(lab: LitLab) -> None:
    lab.on_exposure[3] = lambda: setattr(lab.shutter, "broken", True)
    assert isinstance(lab.run(), LightError)
    assert lab.lights_on() == {"shutter"}
    (*_, warning) = events(lab.folder, "warning")
    assert str(warning.detail["message"]).startswith(
        "light shutter was not switched off: light shutter: does not answer"
    )
