"""A campaign of random faults at random moments of captures, judged by where the carriages truly were.

The judge knows nothing of the driver: it looks at the simulated kinematics every five milliseconds of each exposure.
"""

import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
import pytest

from faintfield.rig.cameras.protocol import CameraReport, Exposure
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import Rig
from faintfield.rig.errors import RigError
from faintfield.rig.session.journal import Journal, Suspect
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan, is_sealed
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import DriftSettings, RigSettings
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.stages.protocol import Point
from tests.faults.capturing import SMALL_RIG, Unattended
from tests.faults.stage_faults import Fault, faults_of
from tests.rig.stages.benches import CONTROLLERS, Controller

HALF_STEP_MM = 0.5 / 80.0
LIMIT_MM = DriftSettings().limit_mm
FAULTS_PER_CAPTURE = 6
LOOK_S = 0.005


@dataclass
class Witness:
    """A camera that records the true positions of the carriages while it exposes, by the number of the exposure."""

    bench: Bench
    seen: dict[int, list[Point]] = field(default_factory=dict)
    in_motion: set[int] = field(default_factory=set)
    failures: list[RigError] = field(default_factory=list)

    def open(self) -> None:
        pass

    def report(self) -> CameraReport:
        return CameraReport("witness", 1000)

    def expose(self, exposure_s: float, number: int) -> Exposure:
        places = self.seen[number] = []
        for _ in range(math.ceil(exposure_s / LOOK_S) + 1):
            places.append(self.bench.true_position())
            if self.bench.firmware.homing or self.bench.firmware.mechanics.moving:
                self.in_motion.add(number)
            self.bench.clock.sleep_s(LOOK_S)
        return Exposure(".tiff", content=b"%d" % number)

    def close(self) -> None:
        pass

    def error_mm(self, number: int, node: Point) -> float:
        """Return how far the carriages were from a node, at most; infinite if they moved."""
        places = self.seen[number]
        moved = number in self.in_motion or len(set(places)) > 1
        return math.inf if moved else max(math.dist(place, node) for place in places)


@contextmanager
def scratch() -> Iterator[Path]:
    """Yield a folder in memory if there is such, since journals flush after each entry."""
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        yield Path(folder) / "session"


def rig_of(controller: Controller) -> RigSettings:
    origin = Point(50.0, 50.0) if controller.protocol == "marlin" else Point(-350.0, -350.0)
    grid = msgspec.structs.replace(SMALL_RIG.grid, origin_mm=origin)
    return msgspec.structs.replace(SMALL_RIG, grid=grid, drift=DriftSettings())


def capture(folder: Path, controller: Controller, faults: list[tuple[float, Fault]]) -> tuple[Witness, int, float]:
    """Capture with faults at their times, and resume without faults until the session is complete.

    Returns
    -------
    Witness, int, float
        What all exposures saw, how many faults have struck, and how long the first capture took.
    """
    settings = rig_of(controller)
    survey_bench = Bench(controller)
    plan = survey(Rig(survey_bench.stage(), Witness(survey_bench), survey_bench.clock, lambda *_: None), settings).plan
    everything, struck, first_s = Witness(survey_bench), 0, 0.0

    for run in range(4):
        bench = Bench(controller)
        witness = Witness(bench, everything.seen, everything.in_motion)

        def strike(fault: Fault, bench: Bench = bench) -> None:
            nonlocal struck
            struck += 1
            fault.strike(bench)

        for at_s, fault in faults if run == 0 else ():
            bench.clock.after(at_s, lambda fault=fault, strike=strike: strike(fault))  # type: ignore[misc]
        try:
            with open_session(folder, FrozenPlan(plan, settings)) as session:
                rig = Rig(bench.stage(traffic=session.journal), witness, bench.clock, lambda *_: None)
                Capture(session, rig, Unattended(), lambda path: None).run()
        except RigError as failure:
            everything.failures.append(failure)
        if run == 0:
            first_s = bench.clock.now_s()
        if is_sealed(folder):
            return everything, struck, first_s
    raise AssertionError(f"not complete after {[fault.name for _, fault in faults]}")


def judge(folder: Path, witness: Witness, faults: list[tuple[float, Fault]]) -> None:
    """Assert that no frame that counts was taken in motion or away from its node."""
    assert verify(folder).problems == ()
    assert all("; " in str(failure) for failure in witness.failures), "a failure says what is wrong; and what to do"
    with Journal(folder / "journal.sqlite", read_only=True) as journal:
        committed = journal.committed()
        suspect = {intent for event in journal.details("suspect", Suspect) for intent in event.intents}
    nodes = nodes_of(folder)
    # Lost steps show in no report: they are found by the next drift check, if they exceed its limit
    hidden = any(fault.nature == "mechanics" for _, fault in faults)
    told = ", ".join(f"{fault} at {at_s:.3f} s" for at_s, fault in faults)
    for frame in committed:
        node, relied_on = nodes[frame.frame]
        error_mm = witness.error_mm(frame.intent, node)
        if not hidden:
            assert error_mm <= HALF_STEP_MM, f"frame {frame.frame}, exposure {frame.intent}: {error_mm} mm; {told}"
        elif relied_on and frame.void is None and frame.intent not in suspect:
            assert error_mm <= LIMIT_MM + HALF_STEP_MM, f"exposure {frame.intent}: {error_mm} mm; {told}"


def nodes_of(folder: Path) -> list[tuple[Point, bool]]:
    """Return the node of each frame of a plan, read without the code that drives to it, and if drift is checked there.

    Dark frames, at the centre, are not followed by a check, since they are the same everywhere.
    """
    plan = msgspec.json.decode((folder / "plan.json").read_bytes())["plan"]
    nodes = []
    for step in plan["steps"]:
        per_stop = len(step["exposure_s"]) * step["frames_per_node"]
        stops = plan["stops"] if step["at"] == "grid" else [plan["centre"]]
        nodes += [(Point(*stop["target"]), step["at"] == "grid") for stop in stops for _ in range(per_stop)]
    return nodes


def campaign(controller: Controller, wanted: int, seed: int) -> None:
    """Let `wanted` faults strike in as many captures as that takes."""
    generator = np.random.default_rng(seed)
    with scratch() as folder:
        witness, struck, usual_s = capture(folder, controller, [])
        judge(folder, witness, [])
        assert struck == 0
    known = faults_of(controller)
    loud = [fault for fault in known if fault.nature != "mechanics"]
    silent = [fault for fault in known if fault.nature == "mechanics"]
    while struck < wanted:
        # Two drifts between two checks may cancel, which no check can find: so one at most
        drawn = [loud[index] for index in generator.integers(len(loud), size=FAULTS_PER_CAPTURE)]
        if generator.random() < 0.3:
            drawn[0] = silent[generator.integers(len(silent))]
        times_s = generator.uniform(0.0, usual_s, FAULTS_PER_CAPTURE)
        faults = sorted(zip(times_s.tolist(), drawn, strict=True), key=lambda fault: fault[0])
        with scratch() as folder:
            witness, now_struck, _ = capture(folder, controller, faults)
            judge(folder, witness, faults)
        struck += now_struck


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_no_frame_that_counts_was_taken_in_motion_or_away_from_its_node(controller: Controller) -> None:
    campaign(controller, 60, seed=20)


@pytest.mark.campaign
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_nor_was_one_in_a_thousand_faults(controller: Controller) -> None:
    campaign(controller, 1000, seed=21)


def test_the_witness_sees_motion_and_distance() -> None:
    bench = Bench(CONTROLLERS[0])
    stage = bench.stage()
    stage.connect()
    stage.home()
    stage.move_to(-100.0, -100.0)
    witness = Witness(bench)
    witness.expose(0.1, 1)
    bench.clock.after(0.05, lambda: bench.firmware.mechanics.queue((-101.0, -100.0), 50.0, 500.0))
    witness.expose(0.1, 2)
    bench.clock.sleep_s(1.0)
    bench.clock.after(0.05, lambda: setattr(bench.firmware.mechanics.axes[0], "slip_mm", 0.02))
    witness.expose(0.1, 3)
    witness.expose(0.1, 4)
    errors_mm = [witness.error_mm(number, Point(-101.0, -100.0)) for number in (1, 2, 3, 4)]
    assert errors_mm == pytest.approx([1.0, math.inf, math.inf, 0.02])
