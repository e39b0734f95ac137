"""The stage goes ahead to the next node while a frame is recorded: nothing is lost by it, and little time is added."""

import threading
from itertools import pairwise
from pathlib import Path
from unittest import mock

import pytest
from msgspec.structs import replace

from faintfield.rig.cameras.protocol import Exposure, Pixels
from faintfield.rig.capture.loop import Capture
from faintfield.rig.devices import open_rig
from faintfield.rig.errors import CameraError
from faintfield.rig.plan import Grid, planned_frames
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import read_plan
from faintfield.rig.settings import SettleSettings, StepSettings
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.lab import SimulatedCamera
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.motion import one_sided_path, path_duration_s
from faintfield.rig.stages.protocol import MotionLimits, Point, Position
from tests.faults.capturing import SMALL_RIG, Operator, capture, events, frozen_plan
from tests.faults.laboratory import Lab, at_exposures
from tests.patience import HANG_S
from tests.rig.stages.benches import firmware


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return Lab(tmp_path / "session", SimulatedGrbl)


def uncommitted(lab: Lab) -> list[tuple[int, int]]:
    with Journal(lab.folder / "journal.sqlite", read_only=True) as journal:
        return journal.uncommitted()


def test_frame_is_recorded_during_next_motion(tmp_path: Path) -> None:
    moving, meanwhile = threading.Event(), list[bool]()
    move, expose = Gantry.move_to, SimulatedCamera.expose

    def watched_move(stage: Gantry, x_mm: float, y_mm: float) -> Position:
        moving.set()
        return move(stage, x_mm, y_mm)

    def watched_expose(camera: SimulatedCamera, exposure_s: float, number: int) -> Exposure:
        moving.clear()
        exposure = expose(camera, exposure_s, number)
        return Exposure(".raw", content=b"raw", metadata=exposure.metadata)

    def decode(path: Path) -> Pixels | None:
        if path.name.endswith("_x1.raw"):
            meanwhile.append(moving.wait(HANG_S))
        return None

    with (
        mock.patch.object(Gantry, "move_to", watched_move),
        mock.patch.object(SimulatedCamera, "expose", watched_expose),
    ):
        assert capture(tmp_path / "session", decode=decode) is None
    assert meanwhile[0]


def test_refused_frame_is_retaken_at_its_node(lab: Lab) -> None:
    def refuse(path: Path) -> Pixels | None:
        if "_x3." in path.name:
            raise CameraError("the frame is damaged; take it again")
        return None

    assert lab.run(decode=refuse) is None
    lab.assert_true_positions()
    assert uncommitted(lab) == [(3, 2)]


def test_failure_on_the_way_keeps_last_frame(lab: Lab) -> None:
    assert lab.run(at_exposures([3], lambda bench: firmware(bench, SimulatedGrbl).alarm(3), delay_s=0.3)) is None
    lab.assert_true_positions()
    assert uncommitted(lab) == []
    (failed,) = events(lab.folder, "stage_failed")
    assert failed.frame == 3
    assert "ALARM:3" in str(failed.detail["message"])


def test_interrupt_on_the_way_keeps_last_frame(lab: Lab) -> None:
    def interrupt(bench: Bench) -> None:
        assert bench.firmware.mechanics.moving
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lab.run(at_exposures([3], interrupt, delay_s=0.3))
    with Journal(lab.folder / "journal.sqlite", read_only=True) as journal:
        assert [frame.intent for frame in journal.committed()] == [1, 2, 3]
    assert lab.run() is None
    lab.assert_true_positions()
    assert uncommitted(lab) == []


def test_nodes_add_quarter_second_to_plan(tmp_path: Path) -> None:
    begun_s: list[float] = []
    settings = replace(
        SMALL_RIG,
        grid=Grid(3, 4, 30.0, Point(-350.0, -350.0)),
        step=(StepSettings("dark_scene", 0.1),),
        settle=SettleSettings(measure=False, wait_s=0.0),
    )
    with open_session(tmp_path / "session", frozen_plan(settings)) as session:
        rig = open_rig(settings, session.journal)
        expose = rig.camera.expose

        def watched(exposure_s: float, number: int) -> Exposure:
            begun_s.append(rig.clock.now_s())
            return expose(exposure_s, number)

        with mock.patch.object(rig.camera, "expose", watched):
            Capture(session, rig, Operator(), lambda path: None).run()
    motion = MotionLimits((100.0, 100.0), (500.0, 500.0))
    targets = [frame.stop.target for frame in planned_frames(read_plan(tmp_path / "session").plan)]
    motions_s = [
        path_duration_s((start, *one_sided_path(start, end, settings.stage.approach_mm)), motion, 100.0)
        for start, end in pairwise(targets)
    ]
    added_s = [
        later - sooner - 0.15 - motion_s for (sooner, later), motion_s in zip(pairwise(begun_s), motions_s, strict=True)
    ]
    assert 0.0 < max(added_s) < 0.25
