"""The Marlin driver with an independent implementation: the virtual printer of OctoPrint, in its own process."""

import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from faintfield.rig.devices import open_stage
from faintfield.rig.errors import StageAlarm, StageLost, StageTimeout
from faintfield.rig.plan import Grid
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import Point, StageSettings
from faintfield.testing import stage_contract

PYTHON = Path(__file__).parents[3] / "build" / "octoprint" / "bin" / "python"
SERVER = Path(__file__).with_name("octoprint_server.py")

pytestmark = [
    pytest.mark.deep,
    pytest.mark.skipif(
        not PYTHON.exists(), reason=f"OctoPrint is not installed in {PYTHON.parents[1]}; make deep does it"
    ),
]

type Command = Callable[[str], None]


@pytest.fixture
def printer(request: pytest.FixtureRequest) -> Iterator[tuple[Gantry, Command]]:
    """A stage connected to a virtual printer, and a function that sends commands to the printer."""
    changes = getattr(request, "param", {})
    with subprocess.Popen(
        [PYTHON, SERVER, json.dumps(changes)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        port = int(process.stdout.readline())
        stage = open_stage(StageSettings(protocol="marlin", port=f"socket://127.0.0.1:{port}"))

        def command(text: str) -> None:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(text + "\n")
            process.stdin.flush()
            assert process.stdout.readline() == "passed on\n"

        yield stage, command
        stage.close()
        process.kill()


def test_contract(printer: tuple[Gantry, Command]) -> None:
    stage_contract(printer[0])


@pytest.mark.parametrize("printer", [{}, {"simulated_errors": ["20:resend", "30:checksum_mismatch"]}], indirect=True)
def test_grid_of_7_by_7(printer: tuple[Gantry, Command]) -> None:
    stage, _ = printer
    stage.connect()
    stage.home()
    for stop in Grid(7, 7, 50.0, Point(20.0, 20.0)).stops():
        assert stage.move_to(*stop.target).is_at(stop.target)


@pytest.mark.parametrize(
    ("fault", "failure"),
    [
        ("trigger_fatal_error_marlin", StageAlarm),
        ("reset", StageLost),
        ("drop_connection", StageLost),
        ("dont_answer", StageTimeout),
    ],
)
def test_faults(printer: tuple[Gantry, Command], fault: str, failure: type[Exception]) -> None:
    stage, command = printer
    stage.connect()
    stage.home()
    command(f"!!DEBUG:{fault}")
    with pytest.raises(failure):
        _move_in_steps(stage)
    assert not stage.trusted
    stage.recover()
    stage.home()
    assert stage.move_to(30.0, 30.0).trusted


def _move_in_steps(stage: Gantry) -> None:
    """Move in many small steps."""
    for x_mm in range(10, 200, 10):
        stage.move_to(x_mm, 20.0)
