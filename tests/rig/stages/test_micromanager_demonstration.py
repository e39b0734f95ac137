"""Micro-Manager's demonstration stage, with the real library."""

from typing import Any

import pytest

from faintfield.rig.cameras.micromanager import MicroManagerCamera
from faintfield.rig.cameras.settings import MicroManagerSettings
from faintfield.rig.clock import WallClock
from faintfield.rig.devices import open_stage
from faintfield.rig.errors import CameraError
from faintfield.rig.micromanager import SharedCore
from faintfield.rig.stages.conformance import check_conformance
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.micromanager import MicroManagerController, MicroManagerStage
from faintfield.rig.stages.protocol import Box, StageSettings
from faintfield.testing import stage_contract

pytestmark = pytest.mark.deep

TRAVEL = Box((0.0, 12.0), (0.0, 12.0))


@pytest.fixture
def adapters() -> str:
    """Return the folder of Micro-Manager's demonstration devices."""
    why = "pymmcore-plus and mm-test-adapters are not installed here: their stage is not tried"
    pytest.importorskip("pymmcore_plus", reason=why)
    return str(pytest.importorskip("mm_test_adapters", reason=why).device_adapter_path())


def demo(adapters: str, **options: Any) -> Gantry:
    """Return the demonstration stage, which moves at 10 mm/s in real time."""
    options = {"adapters": adapters, "rate_mm_per_s": 10.0, "acceleration_mm_per_s2": 1000.0} | options
    return open_stage(StageSettings("micromanager", approach_mm=0.2, travel_mm=TRAVEL, options=options))


def test_contract_of_the_demonstration_stage(adapters: str) -> None:
    stage_contract(demo(adapters))


def test_conformance_of_the_demonstration_stage(adapters: str) -> None:
    stage = demo(adapters)
    stage.connect()
    checks = list(check_conformance(stage))
    stage.close()
    assert [(check.name, check.passed) for check in checks] == [
        (name, True) for name in ("settings", "homing", "limits", "speed", "arrival", "report rate")
    ], checks


def test_camera_and_stage_work_with_one_core(adapters: str) -> None:
    shared = SharedCore(adapters=adapters)
    camera = MicroManagerCamera(MicroManagerSettings(adapters=adapters), shared)
    options = MicroManagerStage(adapters=adapters, rate_mm_per_s=10.0)
    clock = WallClock()
    stage = Gantry(
        MicroManagerController(shared, options, TRAVEL, clock), StageSettings("micromanager", travel_mm=TRAVEL), clock
    )
    stage.connect()
    camera.open()
    stage.home()
    here = stage.move_to(1.0, 0.5).point
    camera.close()
    with pytest.raises(CameraError, match="open it first"):
        camera.expose(0.01, 1)
    camera.open()
    assert camera.expose(0.01, 1).pixels is not None
    assert stage.verify_at(*here).trusted  # closing the camera did not unload the stage
    camera.close()
    stage.close()
