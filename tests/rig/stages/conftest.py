"""A homed stage on a simulated controller."""

import pytest

from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.stages.gantry import Gantry
from tests.rig.stages.benches import homed


@pytest.fixture
def bench() -> Bench:
    """A simulated GRBL controller; files about other controllers have a bench of their own."""
    return Bench(SimulatedGrbl)


@pytest.fixture
def stage(bench: Bench) -> Gantry:
    return homed(bench)


@pytest.fixture
def unhomed(bench: Bench) -> Gantry:
    """A stage that is connected only."""
    stage = bench.stage()
    stage.connect()
    return stage
