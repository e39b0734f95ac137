"""Every fault of a stage, at every moment, ends in a named failure or a recovery, and never in a wrong frame."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from faintfield.rig.errors import RigError, StageError
from faintfield.rig.simulation.controller.bench import Bench, PtyLink
from faintfield.rig.stages.drift import DriftWatch, recover
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import Point
from tests.faults.stage_faults import FAULTS, Fault, faults_of
from tests.rig.stages.benches import CONTROLLERS, Controller
from tests.rig.stages.socket_link import SocketLink

DRIFT_LIMIT_MM = 0.5
# Half a step of 1/80 mm and the rounding of reports
ON_TARGET_MM = 0.5 / 80.0 + 0.0055
MOMENTS = {"connecting": 1.02, "homing": 5.0, "moving": 0.35, "exposing": 0.35}


@dataclass(frozen=True)
class KeptFrame:
    """A frame that was kept, and the true positions of the camera at the beginning and the end of its exposure."""

    number: int
    target: Point
    began: Point
    ended: Point

    def error_mm(self) -> float:
        return max(math.dist(self.target, self.began), math.dist(self.target, self.ended))


@dataclass
class RehearsedCapture:
    """A small capture, with the rules by which frames are taken and kept, on a bench with faults."""

    bench: Bench
    struck: list[tuple[float, Fault]] = field(default_factory=list)  # when, in s, and what
    kept: list[KeptFrame] = field(default_factory=list)
    failures: list[RigError] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.stage: Gantry = self.bench.stage()
        self.watch = DriftWatch(self.stage, limit_mm=DRIFT_LIMIT_MM)
        self.on_move: Callable[[], None] = lambda: None
        self.on_expose: Callable[[], None] = lambda: None

    def strike(self, fault: Fault) -> None:
        """Let a fault strike, and record when."""
        self.struck.append((self.bench.clock.now_s(), fault))
        fault.strike(self.bench)

    def run(self) -> None:
        """Take four frames, recovering from failures as a capture does; record every failure."""
        try:
            self.start()
            for target in self.targets():
                for _ in range(3):
                    with self.recovering():
                        self.take(target)
                        break
            self.watch.check()
        except RigError as failure:
            self.failures.append(failure)
        finally:
            self.stage.close()

    def start(self) -> None:
        """Connect and begin the drift watch, repeatedly if it fails."""
        with self.recovering():
            self.stage.connect()
        for _ in range(3):
            with self.recovering():
                self.watch.begin()
                break

    def targets(self) -> list[Point]:
        """Return the positions of the frames."""
        travel = self.stage.travel()
        x, y = travel.x_mm[0] + 100.0, travel.y_mm[0] + 100.0
        return [Point(x, y), Point(x + 50.0, y), Point(x + 50.0, y + 50.0), Point(x, y + 50.0)]

    def take(self, target: Point) -> None:
        """Move, settle, verify, expose, verify again, keep."""
        self.on_move()
        with self.bounded(30.0):
            self.stage.move_to(*target)
        self.bench.clock.sleep_s(0.2)
        self.stage.verify_at(*target)
        began = self.bench.true_position()
        self.on_expose()
        self.bench.clock.sleep_s(1.0)
        self.stage.verify_at(*target)
        frame = KeptFrame(len(self.kept), target, began, self.bench.true_position())
        self.kept.append(frame)
        self.watch.note(frame.number)

    def accepted(self) -> list[KeptFrame]:
        """Return the frames that are neither doubtful nor unchecked."""
        doubtful = {*self.watch.doubtful, *self.watch.unchecked}
        return [frame for frame in self.kept if frame.number not in doubtful]

    @contextmanager
    def recovering(self) -> Iterator[None]:
        """Record a failure of the stage and recover; raise if that is impossible."""
        try:
            yield
        except StageError as failure:
            self.failures.append(failure)
            self.recover()

    def recover(self) -> None:
        """Recover, homing if necessary.

        The stage must be ready within the time that recovery from all faults so far may take, one after the other,
        counted from the last one: it may strike during the recovery, and may bring a port back.
        """
        started_s = self.bench.clock.now_s()
        self.stage.recover()
        last_s = max([started_s, *(when_s for when_s, _ in self.struck)])
        assert self.bench.clock.now_s() - last_s <= sum(fault.recovery_s for _, fault in self.struck)
        recover(self.stage, lambda question: True, self.watch)

    @contextmanager
    def bounded(self, bound_s: float) -> Iterator[None]:
        """Assert that the block takes no longer than `bound_s` of simulated time, also when it fails."""
        started_s = self.bench.clock.now_s()
        try:
            yield
        finally:
            assert self.bench.clock.now_s() - started_s <= bound_s

    def check_frames(self, faults: list[Fault]) -> None:
        """Assert that no frame from a wrong position is accepted, and that failures say what to do."""
        for frame in self.accepted():
            assert frame.error_mm() <= DRIFT_LIMIT_MM + ON_TARGET_MM
        if not any(fault.nature == "mechanics" for fault in faults):
            assert all(frame.error_mm() <= ON_TARGET_MM for frame in self.kept)
        for failure in self.failures:
            assert "; " in str(failure), "a failure says what is wrong; and what to do"
            assert "\n" not in str(failure)


def once(action: Callable[[], None]) -> Callable[[], None]:
    """Return a function that calls `action` the first time only."""
    pending = [action]
    return lambda: pending.pop()() if pending else None


def test_there_are_enough_faults() -> None:
    assert all(len(faults_of(controller)) >= 20 for controller in CONTROLLERS)
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize(
    ("controller", "fault"),
    [(controller, fault) for controller in CONTROLLERS for fault in faults_of(controller)],
    ids=lambda it: it.__name__ if isinstance(it, type) else str(it),
)
def test_one_fault(controller: Controller, fault: Fault, moment: str) -> None:
    capture = RehearsedCapture(Bench(controller))

    def strike() -> None:
        capture.bench.clock.after(MOMENTS[moment], lambda: capture.strike(fault))

    if moment == "moving":
        capture.on_move = once(strike)
    elif moment == "exposing":
        capture.on_expose = once(strike)
    else:
        strike()
    capture.run()
    capture.check_frames([fault])
    if not capture.failures:
        assert len(capture.kept) == 4


def test_an_undisturbed_capture_keeps_everything() -> None:
    for controller in CONTROLLERS:
        capture = RehearsedCapture(Bench(controller))
        capture.run()
        assert len(capture.kept) == 4
        assert not capture.failures
        assert capture.accepted() == capture.kept


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("link", [PtyLink, SocketLink])
@pytest.mark.parametrize("name", ["unplugged", "unplugged and back", "restart", "noise", "controller mute"])
def test_faults_through_the_operating_system(
    controller: Controller, link: type[PtyLink] | type[SocketLink], name: str
) -> None:
    made = link()
    fault = next(fault for fault in FAULTS if fault.name == name)
    capture = RehearsedCapture(Bench(controller, made))
    capture.on_move = once(lambda: fault_soon(capture, fault))
    capture.run()
    made.close()
    capture.check_frames([fault])
    assert capture.failures or name == "noise"


def fault_soon(capture: RehearsedCapture, fault: Fault) -> None:
    """Strike while the stage is on its way."""
    capture.bench.clock.after(0.35, lambda: capture.strike(fault))


@pytest.mark.parametrize("controller", CONTROLLERS)
@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_no_exposure_at_a_wrong_place_whatever_goes_wrong(controller: Controller, data: st.DataObject) -> None:
    capture = RehearsedCapture(Bench(controller))
    known = faults_of(controller)
    silent = [fault for fault in known if fault.nature == "mechanics"]
    loud = [fault for fault in known if fault.nature != "mechanics"]
    # Two drifts between two checks may cancel: no check by homing can find them, so one at most is drawn.
    faults = data.draw(st.lists(st.sampled_from(loud), max_size=4)) + data.draw(
        st.lists(st.sampled_from(silent), max_size=1)
    )
    for fault in faults:
        when_s = data.draw(st.floats(0.0, 90.0))
        capture.bench.clock.after(when_s, lambda fault=fault: capture.strike(fault))  # type: ignore[misc]
    capture.run()
    capture.check_frames(faults)
