"""A lost cable or camera, lost steps: a named failure or a recovery; the session stays whole."""

from collections.abc import Container
from pathlib import Path
from unittest import mock

import msgspec
import numpy as np
import pytest

from faintfield.rig.cameras.protocol import Exposure
from faintfield.rig.capture.take import DriftChecks
from faintfield.rig.errors import CameraError, CaptureStopped
from faintfield.rig.session.disk import encode_exposure
from faintfield.rig.session.homings import DriftCheck, homing_groups, read_homing_groups
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.session import is_sealed, taken_frames
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import DriftSettings, StepSettings
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from tests.faults.capturing import DRIFTING, FRAMES, Operator, events
from tests.faults.laboratory import ON_TARGET_MM, Lab, at_exposures, error_mm
from tests.faults.stage_faults import lose_steps, unplug_for
from tests.rig.stages.benches import CONTROLLERS, Controller, firmware, keep_host_busy, on_homing

GRBL, _, MARLIN = CONTROLLERS


def test_cause_of_failed_recovery_is_recorded(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", GRBL)
    operator = Operator()
    assert lab.run(at_exposures([3], unplug_for(90.0)), operator) is None
    lab.assert_true_positions()
    (failed,) = events(lab.folder, "recovery_failed")
    assert failed.frame == 2
    assert failed.detail["device"] == "stage"
    assert failed.detail["error"] == "StageLost"
    assert "unplugged" in str(failed.detail["message"])
    warnings = [warning for status in operator.statuses for warning in status.warnings]
    assert any("the stage was not recovered: " in warning and "unplugged" in warning for warning in warnings)


def fail(bench: Bench) -> None:
    raise CameraError("the camera failed at an exposure: I/O problem; check its cable")


def busy_at_homing(bench: Bench, numbers: Container[int]) -> None:
    """Let the computer be busy while some homings end."""
    on_homing(bench, lambda homing: keep_host_busy(bench, 2.0) if homing in numbers else None)


@pytest.mark.parametrize("controller", [GRBL, MARLIN])
def test_busy_computer_ends_no_capture(tmp_path: Path, controller: Controller) -> None:
    lab = Lab(tmp_path / "session", controller, DRIFTING)

    assert lab.run(at_exposures([2], lambda bench: busy_at_homing(bench, (1, 3)))) is None
    lab.assert_true_positions()
    suspects = events(lab.folder, "suspect")
    assert len(suspects) == 2
    assert all("answers were delayed" in str(event.detail["message"]) for event in suspects)


def test_always_busy_computer_ends_resumable_capture(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", GRBL, DRIFTING)

    assert isinstance(lab.run(at_exposures([2], lambda bench: busy_at_homing(bench, range(1, 1000)))), CaptureStopped)
    assert lab.run() is None
    # What was taken before the last check is kept, and stays marked
    assert verify(lab.folder).problems == ()
    assert len(verify(lab.folder).suspect) == 6


def groups_of_frames(folder: Path) -> list[int | None]:
    groups = read_homing_groups(folder).groups
    return [groups[committed.intent] for _, committed, _ in taken_frames(folder)]


def test_homing_begins_a_group(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", GRBL)

    assert lab.run(at_exposures([5], lambda bench: firmware(bench, SimulatedGrbl).alarm(3))) is None
    groups = read_homing_groups(lab.folder)
    # The fifth exposure failed; the stage was homed before the sixth
    assert groups.groups == {intent: 1 if intent < 5 else 2 for intent in range(1, FRAMES + 2) if intent != 5}
    assert groups.spread_mm is None
    assert groups_of_frames(lab.folder) == [1] * 4 + [2] * (FRAMES - 4)


def test_resumed_session_begins_a_homing_group(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", GRBL)

    assert lab.run(at_exposures((4, 5, 6), fail)) is not None
    assert lab.run() is None
    assert set(read_homing_groups(lab.folder).groups.values()) == {1, 2}


def test_spread_of_the_switches_is_that_of_checks(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", MARLIN, DRIFTING)

    assert lab.run(at_exposures([2], lose_steps(0, -0.2))) is None
    with Journal(lab.folder / "journal.sqlite", read_only=True) as journal:
        away_mm = np.array([check.away_mm for check in journal.details("drift_check", DriftCheck)])
        groups = homing_groups(journal)
    assert away_mm.shape == (2, 2)
    assert groups.spread_mm is not None
    assert groups.spread_mm == pytest.approx(np.std(away_mm, axis=0, ddof=1))
    assert groups.spread_mm[0] == pytest.approx(0.2 / 2**0.5, rel=0.01)
    # Each check homes, so that each step of the plan is a group of its own
    assert groups_of_frames(lab.folder) == [1] * 6 + [2] * 6 + [3] * 4


def test_frames_without_a_confirming_check_are_suspect(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", GRBL, DRIFTING)

    def slip_and_stop(bench: Bench) -> None:
        lose_steps(0, -3.0)(bench)
        bench.clock.after(5.0, bench.firmware.restart)

    assert lab.run(at_exposures([8], slip_and_stop)) is None
    verdict = verify(lab.folder)
    # The check after the first step confirms its frames; the next homing was not preceded by a check
    frames = taken_frames(lab.folder)
    wrong = {committed.file for frame, committed, path in frames if error_mm(path, frame.stop.target) > ON_TARGET_MM}
    assert wrong
    assert wrong <= set(verdict.suspect) < {committed.file for _, committed, _ in frames[6:12]}


def test_frames_before_an_interrupted_check_are_suspect(tmp_path: Path) -> None:
    one_step = msgspec.structs.replace(DRIFTING, step=(StepSettings("dark_scene", 0.1),))
    lab = Lab(tmp_path / "session", GRBL, one_step)
    cut_off = mock.patch.object(DriftChecks, "check_after", side_effect=[*(None,) * 6, KeyboardInterrupt])
    with cut_off, pytest.raises(KeyboardInterrupt):
        lab.run()
    assert not is_sealed(lab.folder)
    assert lab.run() is None
    verdict = verify(lab.folder)
    assert (verdict.problems, verdict.sealed, verdict.present) == ((), True, 6)
    assert len(verdict.suspect) == 6


def test_check_waits_for_last_frame_of_node(tmp_path: Path) -> None:
    """It homes, so that the frames of a node would be of two groups."""
    every_two = msgspec.structs.replace(
        DRIFTING, step=(StepSettings("dark_scene", 0.1, 3),), drift=DriftSettings(every_nodes=2)
    )
    lab = Lab(tmp_path / "session", GRBL, every_two)
    assert lab.run() is None
    assert groups_of_frames(lab.folder) == [1] * 6 + [2] * 6 + [3] * 6
    assert verify(lab.folder).suspect == ()


SLIP = at_exposures([9], lose_steps(0, -3.0))  # in the second step of the plan


def test_lost_steps_repeat_their_frames(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", GRBL, DRIFTING)
    assert lab.run(SLIP) is None
    lab.assert_true_positions()
    (suspect,) = events(lab.folder, "suspect")
    assert "lost its scale" in str(suspect.detail["message"])
    with Journal(lab.folder / "journal.sqlite", read_only=True) as journal:
        void = [committed.frame for committed in journal.committed() if committed.void is not None]
    # Everything since the last good check, which was at the end of the first step
    assert void == list(range(6, 12))
    assert verify(lab.folder).superseded == 6


def test_stage_that_keeps_losing_steps_is_given_up(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", GRBL, DRIFTING)

    assert isinstance(lab.run(at_exposures(range(2, 100, 6), lose_steps(0, -3.0))), CaptureStopped)
    assert len(events(lab.folder, "suspect")) == 3
    assert lab.run() is None
    # The frames in doubt when the capture was given up are present and stay marked
    assert verify(lab.folder).problems == ()


def test_frames_kept_despite_lost_steps_stay_suspect(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", GRBL, DRIFTING)
    assert lab.run(SLIP, Operator({"drift": ["keep"]})) is None
    verdict = verify(lab.folder)
    assert verdict.problems == ()
    assert verdict.suspect == tuple(committed.file for _, committed, _ in taken_frames(lab.folder)[6:12])


@pytest.mark.parametrize("failures", [2, 3])
def test_failing_camera(tmp_path: Path, failures: int) -> None:
    lab = Lab(tmp_path / "session", GRBL)

    failure = lab.run(at_exposures(range(4, 4 + failures), fail))
    if failures < 3:
        assert failure is None
    else:
        assert isinstance(failure, CameraError)
        assert lab.run() is None
    lab.assert_true_positions()
    with Journal(lab.folder / "journal.sqlite", read_only=True) as journal:
        assert len(journal.events("camera_failed")) == failures
        assert len(journal.uncommitted()) == failures


def test_bytes_of_the_camera_are_kept() -> None:
    assert bytes(encode_exposure(Exposure(".nef", content=b"raw"))) == b"raw"
