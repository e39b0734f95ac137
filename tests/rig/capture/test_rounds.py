"""Rounds over the grid until a noise is reached: when they end, and what a session holds then."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from msgspec.structs import replace

from faintfield.rig.capture.guide import Status
from faintfield.rig.capture.rounds import NoisePredictor
from faintfield.rig.errors import CaptureStopped, SessionCorrupt
from faintfield.rig.plan import CaptureStep, Until
from faintfield.rig.session.journal import FrameRecord, Journal, RoundsEnded
from faintfield.rig.session.session import taken_frames
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import StepSettings
from tests.faults.capturing import DRIFTING, SMALL_RIG, Operator, capture, events
from tests.faults.laboratory import Lab, at_exposures
from tests.faults.stage_faults import lose_steps
from tests.rig.stages.benches import CONTROLLERS

NODES, DARKS = 6, 2
STEPS = (StepSettings("dark_scene", 0.1, until=Until(0.5, 8)), StepSettings("dark", 0.1, DARKS))
RIG = replace(SMALL_RIG, step=STEPS)


def noise_of(one_round_e: float) -> NoisePredictor:
    """Return a predictor by which one round has a noise, which falls with the root of the rounds."""

    def predict(step: CaptureStep, records: Sequence[FrameRecord]) -> Callable[[float], float]:
        assert step.until == Until(0.5, 8)
        return lambda rounds: one_round_e / math.sqrt(rounds)

    return predict


def rounds_of(folder: Path) -> list[int]:
    return [frame.round for frame, _, _ in taken_frames(folder) if frame.kind == "dark_scene"]


@pytest.mark.parametrize(("one_round_e", "rounds"), [(0.4, 1), (0.85, 3), (1.4, 8), (9.0, 8)])
def test_rounds_end_once_noise_is_reached(tmp_path: Path, one_round_e: float, rounds: int) -> None:
    operator = Operator()
    assert capture(tmp_path / "s", operator, RIG, noise=noise_of(one_round_e)) is None
    assert rounds_of(tmp_path / "s") == [number for number in range(rounds) for _ in range(NODES)]
    assert [prompt.key for prompt in operator.prompts] == ["home", "step", "step"]
    verdict = verify(tmp_path / "s")
    frames = rounds * NODES + DARKS
    assert (verdict.problems, verdict.missing, verdict.left_out, verdict.sealed) == ((), (), (), True)
    assert (verdict.planned, verdict.present) == (frames, frames)
    assert verdict.rounds == (() if rounds == 8 else (RoundsEnded(0, rounds, one_round_e / math.sqrt(rounds)),))
    assert (operator.statuses[-1].done, operator.statuses[-1].total) == (frames, frames)


def test_unknown_noise_takes_all_rounds(tmp_path: Path) -> None:
    operator = Operator()
    assert capture(tmp_path / "s", operator, RIG, noise=lambda step, records: None) is None
    assert len(rounds_of(tmp_path / "s")) == 8 * NODES
    unknown = "σ is not known until a frame shows the light, wanted 0.5 e⁻; at most 8 rounds"
    assert unknown in {status.rounds for status in operator.statuses}


def test_interrupted_round_is_completed_on_resume(tmp_path: Path) -> None:
    noise = noise_of(0.85)
    assert isinstance(capture(tmp_path / "s", Operator({}, {2 * NODES + 1: "stop"}), RIG, noise=noise), CaptureStopped)
    assert verify(tmp_path / "s").sealed is False
    assert capture(tmp_path / "s", settings=RIG, noise=noise_of(0.1)) is None  # the light is brighter now
    assert len(rounds_of(tmp_path / "s")) == 3 * NODES
    assert verify(tmp_path / "s").problems == ()


def test_reached_noise_is_kept_in_journal(tmp_path: Path) -> None:
    stops = Operator({}, {3 * NODES: "stop"})  # before the first dark frame
    assert isinstance(capture(tmp_path / "s", stops, RIG, noise=noise_of(0.85)), CaptureStopped)
    verdict = verify(tmp_path / "s")
    assert (len(verdict.missing), verdict.planned) == (DARKS, 3 * NODES + DARKS)
    assert capture(tmp_path / "s", settings=RIG, noise=noise_of(9.0)) is None
    assert len(rounds_of(tmp_path / "s")) == 3 * NODES


@pytest.mark.parametrize(("paused_at", "rounds"), [(NODES + 2, 2), (2 * NODES, 2), (0, 1)])
def test_operator_ends_step_with_present_round(tmp_path: Path, paused_at: int, rounds: int) -> None:
    operator = Operator({"paused": ["finish"]}, {paused_at: "pause", paused_at + 1: "stop"})
    assert isinstance(capture(tmp_path / "s", operator, RIG, noise=noise_of(9.0)), CaptureStopped)
    assert capture(tmp_path / "s", settings=RIG, noise=noise_of(9.0)) is None  # the journal knows the wish
    assert len(rounds_of(tmp_path / "s")) == rounds * NODES
    [ended] = verify(tmp_path / "s").rounds
    assert (ended.rounds, ended.by_operator) == (rounds, True)


def test_frames_left_out_cost_a_further_round(tmp_path: Path) -> None:
    skipping = Operator({"skipped": ["keep"]}, {1: "skip"})
    assert capture(tmp_path / "s", skipping, RIG, noise=noise_of(0.49)) is None
    assert len(rounds_of(tmp_path / "s")) == 2 * NODES - 1
    assert verify(tmp_path / "s").rounds[0].rounds == 2


def test_wish_to_finish_outlasts_failed_check(tmp_path: Path) -> None:
    """A round that a drift check makes void is taken again before the step ends."""
    operator = Operator({"paused": ["finish"]})

    def pause(status: Status) -> None:  # no frame is shown, as none can be decoded
        if status.done == NODES + 2 and not operator.prompts[-1].key == "paused":
            operator.requests[0] = "pause"

    operator.on_status = pause
    lab = Lab(tmp_path / "s", CONTROLLERS[0], replace(DRIFTING, step=STEPS))
    assert lab.run(at_exposures([NODES + 4], lose_steps(0, -3.0)), operator) is None
    assert len(rounds_of(tmp_path / "s")) == 2 * NODES


@pytest.mark.parametrize(("step", "rounds"), [(99, 1), (1, 1), (0, 8)])
def test_odd_rounds_in_journal_are_damage(tmp_path: Path, step: int, rounds: int) -> None:
    assert isinstance(capture(tmp_path / "s", Operator({}, {2: "stop"}), RIG), CaptureStopped)
    with Journal(tmp_path / "s" / "journal.sqlite") as journal:
        journal.event("rounds_ended", step=step, rounds=rounds, sigma_e=None, by_operator=False)
    assert f"step {step + 1} ended after {rounds} rounds" in verify(tmp_path / "s").problems[0]
    assert isinstance(capture(tmp_path / "s", settings=RIG), SessionCorrupt)


def test_skipping_step_skips_all_rounds(tmp_path: Path) -> None:
    operator = Operator({"step": ["skip"], "skipped": ["keep"]})
    assert capture(tmp_path / "s", operator, RIG, noise=noise_of(0.85)) is None
    assert rounds_of(tmp_path / "s") == []
    assert len(verify(tmp_path / "s").left_out) == 8 * NODES


def test_status_states_noise_rounds_and_time(tmp_path: Path) -> None:
    operator = Operator()
    assert capture(tmp_path / "s", operator, RIG, noise=noise_of(0.85)) is None
    words = {status.done: status for status in operator.statuses if status.step == 1 and status.doing == "exposing"}
    assert words[0].rounds.startswith("σ wanted 0.5: 3 more rounds, about")
    assert words[NODES].rounds.startswith("σ now 0.85 e⁻, wanted 0.5: 2 more rounds, about")
    assert ": the rest of round 1 and 2 more rounds, about" in words[3].rounds
    assert operator.statuses[-1].step == 2
    last = [status for status in operator.statuses if status.step == 1][-1]
    assert last.rounds.startswith("σ now 0.505 e⁻, wanted 0.5: the rest of round 3, about")
    # Only the rounds that will be needed count
    assert words[0].step_to_go_s[0] == pytest.approx(3 * words[2 * NODES].step_to_go_s[0], rel=0.3)
    assert (words[0].total, words[0].step_frames) == (3 * NODES + DARKS, (3 * NODES, DARKS))


def test_every_round_is_checked_for_drift(tmp_path: Path) -> None:
    settings = replace(DRIFTING, step=STEPS)
    assert capture(tmp_path / "s", settings=settings, noise=noise_of(0.85)) is None
    verdict = verify(tmp_path / "s")
    assert (verdict.suspect, len(rounds_of(tmp_path / "s"))) == ((), 3 * NODES)
    assert len(events(tmp_path / "s", "drift_check")) == 3
