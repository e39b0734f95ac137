"""A simulated bench, a camera that records where the stage truly is, and the session captured with both."""

import math
from collections.abc import Callable, Iterable
from pathlib import Path

import msgspec
import numpy as np

from faintfield.rig.cameras.protocol import CameraReport, Decode, Exposure
from faintfield.rig.capture.guide import OperatorInterface
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import Rig
from faintfield.rig.errors import RigError
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan, read_plan, taken_frames
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import RigSettings
from faintfield.rig.simulation.controller.bench import Bench, PtyLink
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.stages.protocol import Point
from tests.faults.capturing import FRAMES, SMALL_RIG, Operator
from tests.rig.stages.benches import Controller
from tests.rig.stages.socket_link import SocketLink

type MakeLink = Callable[[], PtyLink | SocketLink]

# Half a step of 1/80 mm
ON_TARGET_MM = 0.5 / 80.0
_LOOK_S = 0.005


class TruthfulCamera:
    """A camera whose frames hold all true positions of the stage during the exposure, in mm."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.exposures = 0
        self.on_exposure: dict[int, Callable[[], None]] = {}

    def open(self) -> None:
        pass

    def report(self) -> CameraReport:
        return CameraReport("truthful", 1000)

    def expose(self, exposure_s: float, number: int) -> Exposure:
        self.exposures += 1
        self.on_exposure.pop(self.exposures, lambda: None)()
        places = []
        for _ in range(math.ceil(exposure_s / _LOOK_S) + 1):
            firmware = self.bench.firmware
            moving = firmware.homing or firmware.mechanics.moving
            places.append((math.inf, math.inf) if moving else self.bench.true_position())
            self.bench.clock.sleep_s(_LOOK_S)
        return Exposure(".tiff", content=np.array(places, np.float64).tobytes())

    def close(self) -> None:
        pass


type Prepare = Callable[[Bench, TruthfulCamera], object]


def at_exposures(numbers: Iterable[int], strike: Callable[[Bench], None], delay_s: float = 0.0) -> Prepare:
    """Return what lets a fault strike when some exposures begin, or some time after."""

    def prepare(bench: Bench, camera: TruthfulCamera) -> None:
        def act() -> None:
            bench.clock.after(delay_s, lambda: strike(bench)) if delay_s else strike(bench)

        camera.on_exposure = dict.fromkeys(numbers, act)

    return prepare


def error_mm(path: Path, node: Point) -> float:
    """Return how far from a node the stage was during the exposure of a frame, at most; infinite if it moved."""
    places_mm = np.frombuffer(path.read_bytes()).reshape(-1, 2)
    if np.any(places_mm != places_mm[0]):
        return math.inf
    return math.dist(places_mm[0], node)


class Lab:
    """A bench and the session captured on it; a new bench for each run, as after switching everything off and on."""

    def __init__(
        self, folder: Path, controller: Controller, settings: RigSettings = SMALL_RIG, link: MakeLink | None = None
    ) -> None:
        self.folder = folder
        self.controller = controller
        origin = Point(50.0, 50.0) if controller is SimulatedMarlin else Point(-350.0, -350.0)
        grid = msgspec.structs.replace(settings.grid, origin_mm=origin)
        self.settings = msgspec.structs.replace(settings, grid=grid)
        self.ended_s = 0.0
        self._link = link

    def run(
        self,
        prepare: Prepare = lambda bench, camera: None,
        operator: OperatorInterface | None = None,
        decode: Decode = lambda path: None,
    ) -> RigError | None:
        """Capture; return how it failed, None when it did not."""
        frozen = read_plan(self.folder) if (self.folder / "plan.json").exists() else self.plan()
        link = self._link() if self._link else None
        bench = Bench(self.controller, link) if link else Bench(self.controller)
        try:
            with open_session(self.folder, frozen) as session:
                camera = TruthfulCamera(bench)
                rig = Rig(bench.stage(traffic=session.journal), camera, bench.clock, lambda kind, sweep: None)
                prepare(bench, camera)
                Capture(session, rig, operator or Operator(), decode).run()
        except RigError as failure:
            return failure
        finally:
            self.ended_s = bench.clock.now_s()
            if link:
                link.close()
        return None

    def plan(self) -> FrozenPlan:
        bench = Bench(self.controller)
        rig = Rig(bench.stage(), TruthfulCamera(bench), bench.clock, lambda kind, sweep: None)
        return FrozenPlan(survey(rig, self.settings).plan, self.settings)

    def assert_true_positions(self) -> None:
        """Assert that the session is whole and that every frame was taken where the plan says."""
        verdict = verify(self.folder)
        assert verdict.problems == ()
        assert (verdict.present, verdict.sealed) == (FRAMES, True)
        for frame, committed, path in taken_frames(self.folder):
            assert error_mm(path, frame.stop.target) <= ON_TARGET_MM, committed.file
