"""A simulated lab with a room, a board and a scene light and a shutter, which the rig switches, and its sessions."""

import math
from collections.abc import Callable
from pathlib import Path

from msgspec.structs import replace

from faintfield.rig.cameras.protocol import Exposure
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.capture.guide import OperatorInterface
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import Rig, true_lights
from faintfield.rig.errors import RigError
from faintfield.rig.lights.controller import ControllerLight
from faintfield.rig.lights.protocol import Light
from faintfield.rig.lights.settings import ControllerSettings
from faintfield.rig.lights.settings import SimulatedSettings as ShutterSettings
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan, taken_frames
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import StepSettings
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.simulation.lab import SimulatedCamera, SimulatedLab, SimulatedLight
from faintfield.rig.stages.protocol import Point
from tests.faults.capturing import BOARD, DRIFTING, Operator
from tests.faults.laboratory import ON_TARGET_MM
from tests.rig.stages.benches import Controller

_LOOK_S = 0.005
GRBL_LIGHTS = (
    ControllerSettings(name="room", output="spindle"),
    ControllerSettings(name="board", output="mist"),
    ControllerSettings(name="scene", output="flood"),
    ShutterSettings(name="shutter", steady_s=0.1),
)
MARLIN_LIGHTS = (
    ControllerSettings(name="room", output="fan", number=1),
    ControllerSettings(name="board", output="pin", number=57),
    ControllerSettings(name="scene", output="pin", number=58),
    ShutterSettings(name="shutter", steady_s=0.1),
)
STEPS = (
    StepSettings("charuco", 0.1, lights=("board", "shutter")),
    StepSettings("bright", 0.1, lights=("room", "shutter")),
    StepSettings("dark_scene", 0.1, lights=("scene", "shutter")),
    StepSettings("noise_reference", 0.1, lights=()),
    StepSettings("dark", (0.1, 1.0), 2, lights=("room",)),  # before the shutter
)
LIT_FRAMES = 4 * 6 + 4


class Killed(BaseException):
    """The end of a process without any of its cleaning up."""


class LitLab:
    """A bench and a lab with lights, and the session captured there.

    `seen` holds, by the number of each exposure, the lights that were on at any time of it, and where the stage was;
    infinity while it moved. `on_exposure` has what happens at an exposure, by how many came before.
    """

    def __init__(self, folder: Path, controller: Controller, *, resets_on_open: bool = True) -> None:
        self.folder = folder
        self.controller = controller
        self.resets_on_open = resets_on_open
        marlin = controller is SimulatedMarlin
        self.camera = SimulatedSettings(size_px=(16, 12), unlit_photons_per_s=4000.0)
        self.settings = replace(
            DRIFTING,
            camera=self.camera,
            grid=replace(DRIFTING.grid, origin_mm=Point(50.0, 50.0) if marlin else Point(-350.0, -350.0)),
            step=STEPS,
            board=(BOARD,),
            light=MARLIN_LIGHTS if marlin else GRBL_LIGHTS,
        )
        self.seen: dict[int, set[tuple[frozenset[str], Point]]] = {}
        self.switch_on()

    def switch_on(self) -> None:
        """Switch everything off and on, with everything repaired."""
        self.bench = Bench(self.controller, resets_on_open=self.resets_on_open)
        self.shutter = SimulatedLight("shutter")
        self.on_exposure: dict[int, Callable[[], object]] = {}
        self.exposures = 0
        self.camera_type: type[WatchingCamera] = WatchingCamera

    def kill(self) -> None:
        """End the capture at once; what the rig was told to do lasts."""
        self.bench.unplug()
        self.shutter.broken = True
        raise Killed

    def run(self, operator: OperatorInterface | None = None) -> RigError | Killed | None:
        """Capture; return how it ended, None when it is complete."""
        self.bench.link.plug()
        self.bench.wire.connected, self.shutter.broken = True, False
        try:
            planned = FrozenPlan(survey(self._rig(Bench(self.controller)), self.settings).plan, self.settings)
            with open_session(self.folder, planned) as session:
                Capture(session, self._rig(self.bench), operator or Operator(), lambda path: None).run()
        except (RigError, Killed) as failure:
            return failure
        return None

    def lights_on(self) -> set[str]:
        """Return the lights that shine now."""
        shines = {
            light.name: self.bench.firmware.output_on(light.in_controller())
            if isinstance(light, ControllerSettings)
            else self.shutter.shines
            for light in self.settings.light
        }
        return {name for name, on in shines.items() if on}

    def assert_lights_and_positions(self, story: str = "") -> None:
        """Assert that the session is whole, and that every frame had its lights and its node."""
        verdict = verify(self.folder)
        assert (verdict.problems, verdict.present, verdict.sealed) == ((), LIT_FRAMES, True), story
        for frame, committed, _ in taken_frames(self.folder):
            lights = STEPS[frame.step].lights
            assert lights is not None
            assert committed.record.lights == tuple(sorted(lights)), story
            for on, place in self.seen[committed.intent]:
                assert on == set(lights), f"{committed.file}: {sorted(on)} instead of {sorted(lights)}; {story}"
                assert math.dist(place, frame.stop.target) <= ON_TARGET_MM, f"{committed.file}: {place}; {story}"

    def _rig(self, bench: Bench) -> Rig:
        stage = bench.stage()
        lights: dict[str, Light] = {
            light.name: ControllerLight(light.name, stage, light.in_controller())
            if isinstance(light, ControllerSettings)
            else self.shutter
            for light in self.settings.light
        }
        truth = true_lights(self.settings.light, lights, bench)
        centre = self.settings.grid.centre().target
        lab = SimulatedLab(centre, bench.true_position, bench.still_s, (BOARD,), self.camera, truth)
        return Rig(stage, self.camera_type(self, bench, lab), bench.clock, lab.arrange, lights=lights)


class WatchingCamera(SimulatedCamera):
    """The simulated camera; while it exposes, lights and stage are looked at every few milliseconds."""

    def __init__(self, laboratory: LitLab, bench: Bench, lab: SimulatedLab) -> None:
        super().__init__(laboratory.camera, self, lab)
        self._laboratory = laboratory
        self._bench = bench
        self._exposing: int | None = None

    def expose(self, exposure_s: float, number: int) -> Exposure:
        self._exposing = number
        self._laboratory.seen[number] = set()
        self._laboratory.on_exposure.pop(self._laboratory.exposures, lambda: None)()
        self._laboratory.exposures += 1
        return super().expose(exposure_s, number)

    def now_s(self) -> float:
        return self._bench.clock.now_s()

    def sleep_s(self, duration_s: float) -> None:
        """Wait; the first time after an exposure began is that of the exposure, the second that of reading it."""
        number, self._exposing = self._exposing, None
        if number is None:
            self._bench.clock.sleep_s(duration_s)
            return
        for _ in range(math.ceil(duration_s / _LOOK_S)):
            self._look(number)
            self._bench.clock.sleep_s(_LOOK_S)
        self._look(number)

    def _look(self, number: int) -> None:
        firmware = self._bench.firmware
        moves = firmware.homing or firmware.mechanics.moving
        place = Point(math.inf, math.inf) if moves else self._bench.true_position()
        self._laboratory.seen[number].add((frozenset(self._laboratory.lights_on()), place))
