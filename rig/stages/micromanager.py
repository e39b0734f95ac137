"""Drive an XY stage through Micro-Manager; a position counts when two reports in a row are equal."""

import math
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Literal

from msgspec import Struct

from faintfield.rig.clock import Clock, result_within
from faintfield.rig.errors import (
    PlanRefused,
    StageError,
    StageLost,
    StageTimeout,
    StageUnfit,
    WrongFirmware,
    in_one_line,
)
from faintfield.rig.micromanager import NotOffered, SharedCore, set_properties
from faintfield.rig.stages.motion import timeout_s
from faintfield.rig.stages.protocol import AnswerTime, AxisIndex, Box, Identity, MotionLimits, Point

_UM_PER_MM = 1e3
# MM::XYStageDevice
_XY_STAGE = 6
# Time between two reports that are compared, in s; largest difference of equal ones, as a share of the tolerance.
_REST_S = 0.05
_EQUAL_SHARE = 0.1
# Time limit of a stop in s when nothing may wait longer.
_ABORT_S = 2.0


class MicroManagerStage(Struct, frozen=True, forbid_unknown_fields=True):
    """An XY stage of Micro-Manager.

    Parameters
    ----------
    configuration, adapters : str
        Micro-Manager's .cfg file, by default that of the demonstration devices; the same as that of the camera, if
        Micro-Manager drives the camera, too; folder of the device adapters, by default the one pymmcore-plus finds.
    device, properties : str, dict
        Label of the stage in the configuration, by default its XY stage; properties of the stage, set when it is
        connected, such as its speed.
    origin : str
        `home`: homing makes the adapter find its origin. `confirmed`: the adapter cannot; the origin is the one that
        the stage had when it was connected, and you say with this setting that it is right.
    rate_mm_per_s, acceleration_mm_per_s2 : float
        Speed and acceleration of both axes, which no adapter reports: motions are timed by them, and fail if they take
        much longer.
    tolerance_mm : float
        How far a report may be from its target.
    homing_bound_s, answer_s : float
        Time after which homing counts as failed, and time limit for every other call, in addition to the motion.
    """

    configuration: str = ""
    adapters: str = ""
    device: str = ""
    properties: dict[str, str] = {}
    origin: Literal["home", "confirmed"] = "home"
    rate_mm_per_s: float = 5.0
    acceleration_mm_per_s2: float = 50.0
    tolerance_mm: float = 0.005
    homing_bound_s: float = 240.0
    answer_s: float = 20.0

    def __post_init__(self) -> None:
        for name in ("rate_mm_per_s", "acceleration_mm_per_s2", "tolerance_mm", "homing_bound_s", "answer_s"):
            if not 0.0 < (value := getattr(self, name)) <= 3600.0:
                raise ValueError(f"{name} = {value:g}; give more than 0 and at most 3600")


class MicroManagerController:
    """A `Controller` for one XY stage; `travel_mm` is the configured travel, as adapters report none."""

    def __init__(self, shared: SharedCore, options: MicroManagerStage, travel_mm: Box | None, clock: Clock) -> None:
        self._shared = shared
        self._options = options
        self._travel_mm = travel_mm
        self._clock = clock
        self._core: Any = None
        self._label = options.device
        self._origin_confirmed = False

    def connect(self, wait_s: float = 0.0) -> None:
        """Load the configuration and set the stage's properties; there is no port to wait for."""
        self._shared.import_package()
        self.close()
        try:
            self._core, self._label = self._run(self._load, "loading the configuration", connected=False)
        except (StageLost, PlanRefused):
            self._release()
            raise
        self._origin_confirmed = self._options.origin == "confirmed"

    def identify(self) -> Identity:
        """Return what adapter and settings say of the stage; raises `WrongFirmware` if no travel is configured."""
        if self._travel_mm is None:
            raise WrongFirmware("Micro-Manager does not report the travel of a stage; set stage.travel_mm")
        options = self._options
        name, properties = self._run(self._describe, "describing the stage")
        return Identity(
            firmware=name,
            travel_mm=self._travel_mm,
            motion=MotionLimits((options.rate_mm_per_s,) * 2, (options.acceleration_mm_per_s2,) * 2),
            tolerance_mm=(options.tolerance_mm,) * 2,
            homing_bound_s=options.homing_bound_s,
            homes_together=True,
            pull_off_mm=0.0,
            settings=properties,
            has_switches=False,
        )

    def home(self, axis: AxisIndex | None, bound_s: float) -> AnswerTime:
        """Let the adapter home both axes, or take the origin that was confirmed; return how long it took.

        A confirmed origin is good once for each connection: nothing shows that it is still right after a failure.
        """
        begun_s = self._clock.now_s()
        if self._options.origin == "confirmed":
            if not self._origin_confirmed:
                problem = "the position is lost, and with it the confirmed origin"
                raise StageUnfit(f"{problem}; find the origin with the stage's own program, then go on")
            self._origin_confirmed = False
        else:
            self._move("home", (), bound_s, "homing")
        self.read_position()
        return AnswerTime(self._clock.now_s() - begun_s, 0.0)

    def follow(self, path: Sequence[Point], feed_mm_per_s: float, predicted_s: float) -> Point:
        """Move through the points of `path` at the stage's own speed, and return the position at rest."""
        bound_s = timeout_s(predicted_s)
        for point in path:
            self._move("setXYPosition", _in_um(point), bound_s, f"moving to {point}")
        return self.read_position()

    def jog(self, by: Point, feed_mm_per_s: float, predicted_s: float, *, unlock: bool) -> Point:
        """Move relative to the present position; there is no lock to clear."""
        self._move("setRelativeXYPosition", _in_um(by), timeout_s(predicted_s), f"moving to {by}")
        return self.read_position()

    def read_position(self) -> Point:
        """Return the position when two reports in a row are equal; raises `StageTimeout` if the stage moves on."""
        deadline_s = self._clock.now_s() + timeout_s(0.0)
        earlier = self._report()
        while self._clock.now_s() < deadline_s:
            self._clock.sleep_s(_REST_S)
            point = self._report()
            limit_mm = _EQUAL_SHARE * self._options.tolerance_mm
            equal = all(abs(a - b) <= limit_mm for a, b in zip(earlier, point, strict=True))
            if equal and not self._run(lambda: self._core.deviceBusy(self._label), "asking for rest"):
                return point
            earlier = point
        raise StageTimeout(f"the stage does not come to rest at {earlier}; look what moves it, then home it")

    def switches(self) -> frozenset[AxisIndex]:
        """Return no axis: adapters do not report switches."""
        if self._core is None:
            raise StageLost("the stage is not connected; connect it first")
        return frozenset()

    def stop(self) -> bool:
        """Stop and wait for rest. The position counts as lost, since adapters differ in how abruptly they stop."""
        self._run(lambda: self._core.stop(self._label), "stopping")
        self.read_position()
        return False

    def abort(self) -> bool:
        """Tell the stage to stop; the position counts as lost."""
        with suppress(StageError):
            self._run(lambda: self._core.stop(self._label), "stopping", answer_s=min(_ABORT_S, self._options.answer_s))
        return False

    def recover(self, wait_s: float) -> bool:
        """Connect again if the connection was lost, and return whether it was not."""
        kept = self._core is not None
        if not kept:
            self.connect()
            self._origin_confirmed = False  # what the operator confirmed was about the position that is lost now
        self.read_position()
        return kept

    def close(self) -> None:
        """Unload the devices, unless the camera uses them."""
        if self._core is not None:
            self._core = None
            self._release()

    def _release(self) -> None:
        with suppress(TimeoutError, RuntimeError):  # any fault was already raised when the stage was used
            result_within(self._options.answer_s, partial(self._shared.release, "stage"), "stage")

    def _load(self) -> tuple[Any, str]:
        core = self._shared.acquire("stage")
        label = self._options.device or core.getXYStageDevice()
        stages = core.getLoadedDevicesOfType(_XY_STAGE)
        if label not in stages:
            choices = ", ".join(stages) or "those of another stage.configuration"
            raise NotOffered(f"the configuration has no XY stage {label!r}; choose from {choices}")
        set_properties(core, label, self._options.properties)
        return core, label

    def _describe(self) -> tuple[str, dict[str, str]]:
        core, label = self._core, self._label
        name = f"Micro-Manager {core.getDeviceLibrary(label)} {core.getDeviceName(label)} ({core.getVersionInfo()})"
        names = [prop for prop in core.getDevicePropertyNames(label) if not core.isPropertyReadOnly(label, prop)]
        return name, {prop: core.getProperty(label, prop) for prop in names}

    def _move(self, function: str, target_um: tuple[float, ...], bound_s: float, what: str) -> None:
        """Call a function of the core that moves the stage, and wait until the adapter says that it has ended."""
        core = self._core

        def work() -> None:
            getattr(core, function)(self._label, *target_um)
            usual_ms = core.getTimeoutMs()  # the camera's too
            core.setTimeoutMs(math.ceil(1e3 * bound_s))
            try:
                core.waitForDevice(self._label)
            finally:
                core.setTimeoutMs(usual_ms)

        self._run(work, what, waits_s=bound_s)

    def _report(self) -> Point:
        x_um, y_um = self._run(lambda: self._core.getXYPosition(self._label), "its report")
        return Point(x_um / _UM_PER_MM, y_um / _UM_PER_MM)

    def _run[T](
        self,
        call: Callable[[], T],
        what: str,
        *,
        waits_s: float = 0.0,
        answer_s: float | None = None,
        connected: bool = True,
    ) -> T:
        """Call with a time limit, and raise a `StageError` for what the core raises.

        A call that `waits_s` until the adapter is at rest, and fails then, has timed out. A stage that hangs is
        stopped, now and when the call returns.
        """
        if connected and self._core is None:
            raise StageLost("the stage is not connected; connect it first")
        begun_s, bound_s = self._clock.now_s(), waits_s + (answer_s or self._options.answer_s)
        stop, given_up = partial(_stop, self._core, self._label), threading.Event()

        def work() -> T:
            try:
                return call()
            finally:
                if given_up.is_set():
                    stop()

        try:
            return result_within(bound_s, work, "stage")
        except TimeoutError as failure:
            given_up.set()
            with suppress(TimeoutError):
                result_within(min(_ABORT_S, self._options.answer_s), stop, "stage")
            self._core = None
            self._shared.abandon("stage")
            problem = f"the stage did not finish {what} within {bound_s:g} s, and its adapter hangs"
            raise StageTimeout(f"{problem}; check power and cable, end the program if it hangs again") from failure
        except NotOffered as failure:
            raise PlanRefused(f"[stage]: {failure}") from failure
        except (RuntimeError, OSError) as failure:
            reason = in_one_line(failure)
            if waits_s and self._clock.now_s() - begun_s >= waits_s:
                problem = f"the stage did not finish {what} within {waits_s:.1f} s ({reason})"
                raise StageTimeout(
                    f"{problem}; look for an obstacle, or lower stage.rate_mm_per_s, then home it"
                ) from failure
            problem = f"the stage failed at {what}: {reason}"
            raise StageLost(f"{problem}; check its cable, its power and the configuration, then home it") from failure


def _in_um(point: Point) -> tuple[float, float]:
    return _UM_PER_MM * point.x_mm, _UM_PER_MM * point.y_mm


def _stop(core: Any, label: str) -> None:
    """Tell a stage to stop, if it is loaded; what the adapter then reports is of no use any more."""
    if core is not None:
        with suppress(Exception):
            core.stop(label)
