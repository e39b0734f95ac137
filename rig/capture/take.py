"""Take one frame: move, rest, verify the position, expose, write, check and commit; and check for drift."""

import itertools
import math
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
from msgspec.structs import replace

from faintfield.rig.cameras.protocol import Decode, Exposure, Pixels, UntriggeredCamera
from faintfield.rig.cameras.settings import CoolingSettings
from faintfield.rig.capture.checks import LIT_KINDS, Findings, Settling, board_warnings, check_frame, measure_settling
from faintfield.rig.capture.guide import MAX_UNATTENDED_TRIES, Answer, Dialogue, Prompt, ShownFrame
from faintfield.rig.capture.lighting import Lighting
from faintfield.rig.capture.survey import read_temperature
from faintfield.rig.errors import (
    CameraError,
    CameraTimeout,
    DriftUnknown,
    LightError,
    NotHomed,
    PositionDrifted,
    RigError,
    StageError,
)
from faintfield.rig.plan import PlannedFrame
from faintfield.rig.session.journal import CommittedFrame, FrameRecord
from faintfield.rig.stages.drift import DriftWatch
from faintfield.rig.stages.protocol import Point


class DriftChecks:
    """The drift checks of a capture; `watch`, which measures the drift, is None if `drift.check` is off.

    `nodes` counts those with an exposure since the last check.
    """

    def __init__(self, dialogue: Dialogue) -> None:
        self._dialogue = dialogue
        self._session, self._rig, self._pace = dialogue.session, dialogue.rig, dialogue.pace
        settings = self._session.frozen.rig.drift
        self._every_nodes = settings.every_nodes
        self.nodes = 0
        self._failures = 0
        self.watch = DriftWatch(self._rig.stage, limit_mm=settings.limit_mm) if settings.check else None

    def begin(self) -> None:
        """Home, and learn how long homing and a check take if drift is checked."""
        if self.watch is None:
            self._rig.stage.home()
            return
        self.watch.begin()
        begun_s = self._rig.clock.now_s()
        self.watch.check()
        self._pace.check_s = self._rig.clock.now_s() - begun_s

    def add(self, frame: CommittedFrame) -> None:
        """Note that a frame relies on the position of the stage."""
        if self.watch is not None:
            self.watch.unchecked.append(frame)

    def is_due(self) -> bool:
        """Return whether a check is due once the present node is done."""
        return self.watch is not None and 0 < self._every_nodes <= self.nodes

    def check_after(self, nodes: int) -> None:
        """Check for drift if at least `nodes` nodes were visited since the last check; 0 means no check."""
        if self.watch is None or nodes == 0 or self.nodes < nodes or not self.watch.unchecked:
            return
        self.nodes = 0
        self._pace.here = None
        self._dialogue.stage = "homes, to check for drift"
        last = self.watch.unchecked[-1]
        if isinstance(last, CommittedFrame):
            self._dialogue.show_status(self._session.frames[last.frame], "checking that the stage kept its position")
        try:
            drift = self.watch.check()
        except PositionDrifted as failure:
            self._failures += 1
            self.ask_to_retake(failure, "The stage lost its scale", self._failures, "taken from a doubtful position")
            self._rig.stage.recover()
            self.begin()
        else:
            self._session.journal.event("drift_check", away_mm=drift.away_mm)
            self._dialogue.stage = "homed, its position checked"

    def ask_to_retake(self, failure: PositionDrifted | DriftUnknown, title: str, failures: int, reason: str) -> None:
        """Record which frames are suspect, and ask whether to take them again, or to stop (`CaptureStopped`)."""
        suspect = [frame for frame in failure.suspect if isinstance(frame, CommittedFrame)]
        self._session.journal.event("suspect", message=str(failure), intents=[frame.intent for frame in suspect])
        self._dialogue.warn(str(failure))
        unattended: Answer = "retake" if failures < MAX_UNATTENDED_TRIES else "stop"
        prompt = Prompt("drift", title, (str(failure),), ("retake", "keep", "stop"), unattended)
        if self._dialogue.ask_or_stop(prompt) == "retake":
            self._session.void(suspect, reason)


# Exposures that are not kept are numbered from here, beyond the number of any frame.
_FIRST_UNKEPT_NUMBER = 10**9

# Interval in s at which the temperature is read, and the time for which it must stay within the tolerance: a cooler
# that overshoots passes it twice.
_POLL_S, _STEADY_S = 2.0, 10.0


class FrameTaker:
    """Takes the frames of a session one by one, with a rig that is connected and homed.

    `decode` reads the pixels of a frame's file; it returns None if it cannot, and raises `CameraError` for a damaged
    file. `last` is the frame taken last.
    """

    def __init__(self, dialogue: Dialogue, drift: DriftChecks, lighting: Lighting, decode: Decode) -> None:
        self._dialogue, self._drift, self._lighting, self._decode = dialogue, drift, lighting, decode
        self._session, self._rig, self._pace = dialogue.session, dialogue.rig, dialogue.pace
        self._settings = self._session.rig
        self._cooled_step: int | None = None
        self._layouts: dict[str, str | None] = {}
        self._refused_layout: str | None = None
        self._unkept_numbers = itertools.count(_FIRST_UNKEPT_NUMBER)
        self.last: PlannedFrame | None = None
        self._arrived = False  # since the last exposure
        self._failure_ahead: StageError | NotHomed | None = None
        triggered_by_us = not isinstance(self._rig.camera, UntriggeredCamera)  # others expose long after the move
        self._measures = self._settings.settle.measure and self._rig.camera_sees_stage and triggered_by_us
        for settling in self._session.journal.details("settling", Settling):
            self._rest_as(settling)

    def take(self, frame: PlannedFrame, following: PlannedFrame | None = None) -> None:
        """Move to the node of a frame and take it; before the first frame of a step, wait for the sensor to be cool.

        While the frame is written, checked and committed, the stage moves on to the `following` one, if that is given.
        A failure on this way is raised when the following frame, or any other, is to be taken.

        Raises `StageError`, `NotHomed`, `CameraError`, `LightError` or `SessionUnwritable`, after which the frame is
        still missing.
        """
        settings = self._settings.camera
        if settings.settle_temperature_c is not None and frame.step != self._cooled_step:
            self._wait_for_temperature(frame, settings, settings.settle_temperature_c)
        self._cooled_step = frame.step
        try:
            self._lighting.prepare(frame, partial(self._look, frame))
            if self._pace.here != frame.stop.target:
                self._dialogue.stage = _towards(frame)
                self._dialogue.show_status(frame, "moving")
            self._go_to(frame)
            self._expose(frame, following)
        except CameraError:
            self._cooled_step = None  # a camera that failed was perhaps switched off
            raise
        except RigError:
            self._lighting.forget()
            raise

    def _await_silence(self, frame: PlannedFrame, exposure_s: float) -> None:
        """Let a camera that we do not trigger finish what it may have begun before the frame's place and light."""
        if isinstance(self._rig.camera, UntriggeredCamera):
            self._dialogue.show_status(frame, "waiting for silence of the camera, trigger nothing yet")
            self._rig.camera.await_silence(exposure_s)

    def _show_exposure(self, frame: PlannedFrame, exposure_s: float, purpose: str = "") -> None:
        """Tell that the shutter opens now: whoever triggers the camera waits for it."""
        self._dialogue.camera = f"exposes for {exposure_s:g} s"
        self._dialogue.show_status(frame, f"exposing{purpose}")

    def take_test(self, frame: PlannedFrame) -> None:
        """Expose as for `frame` and show the picture; nothing of it is recorded.

        Raises `StageError`, `NotHomed`, `CameraError` or `LightError`.
        """
        self._lighting.prepare(frame, partial(self._look, frame))
        self._dialogue.stage = f"{_towards(frame)}, for a test frame"
        self._dialogue.show_status(frame, "taking a test frame")
        self._go_to(frame, test=True)
        self._await_silence(frame, frame.exposure_s)
        self._show_exposure(frame, frame.exposure_s, " a test frame")
        exposure, pixels = self._expose_unkept(frame.exposure_s)
        record = FrameRecord(frame.stop.target, frame.exposure_s, dict(exposure.metadata))
        self._note_temperature(record.temperature_c)
        findings = self._check(frame, pixels)
        self._dialogue.warnings = tuple(f"test frame: {warning}" for warning in findings.warnings)
        if pixels is not None:
            shown = ShownFrame(frame, pixels, findings, record.temperature_c, recorded=False)
            self._dialogue.operator.show_frame(shown)

    def _note_temperature(self, temperature_c: float | None) -> None:
        words = "" if temperature_c is None else f", sensor at {temperature_c:.1f} °C"
        self._dialogue.camera = f"ready{words}"

    def _wait_for_temperature(self, frame: PlannedFrame, settings: CoolingSettings, target_c: float) -> None:
        """Wait until the sensor is at its temperature: dark current doubles over a few kelvins."""
        clock = self._rig.clock
        begun_s, steady_s = clock.now_s(), math.inf
        while True:
            temperature_c = read_temperature(self._rig.camera)
            if temperature_c is None:
                raise CameraError(
                    f"camera.settle_temperature_c = {target_c:g}, but the camera reports no temperature; check cooler "
                    "and cable"
                )
            now_s = clock.now_s()
            near = abs(temperature_c - target_c) <= settings.settle_tolerance_c
            steady_s = min(steady_s, now_s) if near else math.inf
            if now_s - steady_s >= _STEADY_S:
                break
            if now_s - begun_s >= settings.settle_limit_s:
                raise CameraTimeout(
                    f"the sensor is at {temperature_c:.1f} C after {now_s - begun_s:.0f} s, and did not stay within "
                    f"{settings.settle_tolerance_c:g} K of {target_c:.1f} C for {_STEADY_S:g} s; check its cooler and "
                    "the set point in the camera's settings, or raise camera.settle_limit_s"
                )
            self._dialogue.show_status(frame, f"sensor at {temperature_c:.1f} C, waiting for {target_c:.1f} C")
            request = self._dialogue.operator.take_request()
            if request is not None:  # other wishes than to stop are for the frames
                self._session.journal.event("wish", frame=frame.number, wish=request)
                if request == "stop":
                    self._dialogue.stop()
                self._dialogue.warn(f"there is nothing to {request} while the sensor settles; stop, or wait")
            clock.sleep_s(_POLL_S)
        self._session.journal.event(
            "temperature", frame=frame.number, temperature_c=temperature_c, waited_s=round(now_s - begun_s, 3)
        )

    def _go_to(self, frame: PlannedFrame, *, test: bool = False) -> None:
        target = frame.stop.target
        failure, self._failure_ahead = self._failure_ahead, None
        if failure is not None:
            raise failure
        if self._pace.here == target:
            return
        self._pace.depart()
        self._rig.stage.move_to(*target)
        self._dialogue.stage = _at(target)
        self._arrived = True
        measures = self._measures and frame.kind in LIT_KINDS and not test
        if measures:
            self._measure_settling(frame)
        self._rig.clock.sleep_s(self._pace.rest_s[frame.kind])
        self._pace.arrive(target, frame.kind, timed=not measures)

    def _expose(self, frame: PlannedFrame, following: PlannedFrame | None) -> None:
        """Take a frame at the present node; the order of these steps makes a kill at any moment harmless."""
        rig, session = self._rig, self._session
        begun_s, repeated = rig.clock.now_s(), not self._arrived
        if self._arrived or self.last is None or self.last.step != frame.step:
            self._await_silence(frame, frame.exposure_s)
        self._drift.nodes += self._arrived
        self._arrived = False
        intent = session.intend(frame)
        position = rig.stage.verify_at(*frame.stop.target)
        self._lighting.verify(frame)
        self._show_exposure(frame, frame.exposure_s)
        exposure = rig.camera.expose(frame.exposure_s, intent)
        rig.stage.verify_at(*frame.stop.target)
        self._lighting.verify(frame)
        # Leaving the block waits for the record, so that an interrupted motion loses no frame
        with ThreadPoolExecutor(1, "record of a frame") as recorder:
            recording = recorder.submit(self._record, frame, intent, position.point, exposure)
            begun_s += self._go_ahead(frame, following)
            committed, pixels, findings = recording.result()
        record = committed.record
        self._drift.add(committed)
        self.last = frame
        if record.warnings:
            self._dialogue.warnings = tuple(f"{frame.name}: {warning}" for warning in record.warnings)
        if frame.kind == "charuco":
            corners = {
                number: int(taken.record.checks["board_corners"])
                for number, taken in session.valid().items()
                if "board_corners" in taken.record.checks
            }
            for warning in board_warnings(frame, session.frames, corners, self._settings.checks.board_corners):
                self._dialogue.warn(warning)
        self._pace.finish_frame(begun_s, frame.exposure_s, repeated=repeated)
        self._note_temperature(record.temperature_c)
        if pixels is not None:
            self._dialogue.operator.show_frame(ShownFrame(frame, pixels, findings, record.temperature_c))

    def _go_ahead(self, frame: PlannedFrame, following: PlannedFrame | None) -> float:
        """Move to the node of the following frame, unless there is something to do before; return the time taken."""
        if following is None or following.stop == frame.stop or self._drift.is_due():
            return 0.0
        if self._measures and following.kind in LIT_KINDS:
            return 0.0
        begun_s = self._rig.clock.now_s()
        self._dialogue.stage, self._dialogue.camera = _towards(following), "ready"
        self._dialogue.show_status(following, "moving", recording=frame)
        try:
            self._go_to(following)
        except (StageError, NotHomed) as failure:
            self._failure_ahead = failure
        return self._rig.clock.now_s() - begun_s

    def _record(
        self, frame: PlannedFrame, intent: int, position: Point, exposure: Exposure
    ) -> tuple[CommittedFrame, Pixels | None, Findings]:
        """Write, check and commit a frame; set one aside that is none of this session, and raise `CameraError`."""
        session = self._session
        written = session.write(frame, intent, exposure)
        try:
            pixels = self._decode_frame(frame, written.path, exposure)
            findings = self._check(frame, pixels)
        except (CameraError, LightError) as failure:
            session.reject(frame, written, str(failure))
            raise
        lights = self._lighting.of(frame)
        record = FrameRecord(
            *(position, frame.exposure_s, dict(exposure.metadata), findings.values, findings.warnings),
            lights=None if lights is None else tuple(sorted(lights)),
        )
        return session.commit(frame, written, record), pixels, findings

    def _decode_frame(self, frame: PlannedFrame, path: Path, exposure: Exposure) -> Pixels | None:
        """Return the pixels of a frame, None if it cannot be decoded here; its layout must be that of the session.

        Where that is the layout of a single frame, two exposures in a row that agree on another one outvote it.
        """
        pixels = exposure.pixels if exposure.pixels is not None else self._decode(path)
        layout = self._layouts[path.name] = _layout(pixels)
        numbers = self._session.valid().keys() - {frame.number}  # a frame is not compared with an earlier take of it
        first = self._session.valid()[min(numbers)] if numbers else None
        expected = None if first is None else self._layout_of(first)
        refused, self._refused_layout = self._refused_layout, None
        if first is None or expected is None or layout == expected:
            return pixels
        if len(numbers) == 1 and layout is not None and layout == refused:
            self._session.void([first], f"has {expected}, and the next exposures {layout}")
            self._dialogue.warn(f"{first.file} has {expected}, and the next exposures {layout}; it is taken again")
            return pixels
        self._refused_layout = layout
        only = " or, if that one was odd, just take this frame again" if len(numbers) == 1 and layout else ""
        raise CameraError(
            f"{path.name}: {f'has {layout}' if layout else 'cannot be decoded'}, but {first.file} has {expected}; "
            f"set the camera as it was when the session was begun, and take this frame again{only}"
        )

    def _layout_of(self, committed: CommittedFrame) -> str | None:
        if committed.file not in self._layouts:
            with suppress(CameraError):  # a session of an earlier version may hold such a frame
                self._layouts[committed.file] = _layout(self._decode(self._session.path_of(committed)))
        return self._layouts.setdefault(committed.file, None)

    def _check(self, frame: PlannedFrame, pixels: Pixels | None) -> Findings:
        if pixels is None:
            warning = "the file cannot be decoded here, so nothing was checked; look at it with the camera's program"
            return Findings({}, (warning,))
        earlier = [
            committed.record.checks
            for committed in self._session.valid().values()
            if committed.frame != frame.number
            and self._session.frames[committed.frame].step == frame.step
            and self._session.frames[committed.frame].exposure_s == frame.exposure_s
        ]
        light = self._lighting.judge(frame, pixels, earlier)
        findings = check_frame(pixels, frame.kind, self._settings.checks, self._settings.board, earlier)
        return replace(findings, values=findings.values | light.values, warnings=findings.warnings + light.warnings)

    def _measure_settling(self, frame: PlannedFrame) -> None:
        settings = self._settings.settle
        self._dialogue.show_status(frame, "measuring how long the rig swings")
        settling = measure_settling(self._take_unkept, self._rig.clock, settings)
        self._session.journal.event("settling", frame=frame.number, **msgspec.to_builtins(settling))
        self._rest_as(settling)
        kinds = {step.kind for step in self._session.plan.steps}
        swinging = {kind for kind in kinds if settling.rest_s(kind, settings) is None}
        if swinging:
            self._dialogue.warn(
                f"the rig was not seen at rest to {max(map(settings.limit_of, swinging)):g} px within "
                f"{settings.longest_s:g} s, which is the rest {'of board sweeps ' * (swinging == {'charuco'})}from now "
                "on; light the scene, stiffen the rig or lower its acceleration, or set settle.measure = false"
            )

    def _rest_as(self, settling: Settling) -> None:
        """Let the rest at each stop be the measured one; where none was seen, it is as long as the measurement."""
        self._measures, settings = False, self._settings.settle
        for kind in self._pace.rest_s:
            rest_s = settling.rest_s(kind, settings)
            self._pace.rest_s[kind] = settings.longest_s if rest_s is None else rest_s

    def _take_unkept(self, exposure_s: float) -> Pixels:
        _, pixels = self._expose_unkept(exposure_s)
        if pixels is None:
            raise CameraError("frames cannot be decoded, so settling is not measured; set settle.measure = false")
        return pixels

    def _look(self, frame: PlannedFrame, exposure_s: float) -> Pixels | None:
        """Return a frame without light before that of a step, not kept; None if it cannot be decoded here."""
        self._await_silence(frame, exposure_s)
        self._show_exposure(frame, exposure_s, " a frame without light")
        return self._expose_unkept(exposure_s)[1]

    def _expose_unkept(self, exposure_s: float) -> tuple[Exposure, Pixels | None]:
        """Take a frame that is not kept; its pixels are None if it cannot be decoded here."""
        exposure = self._rig.camera.expose(exposure_s, next(self._unkept_numbers))
        if exposure.content is None:
            return exposure, exposure.pixels
        with TemporaryDirectory(prefix="faintfield-") as folder:
            path = Path(folder) / f"frame{exposure.suffix}"
            path.write_bytes(exposure.content)
            return exposure, self._decode(path)


def _towards(frame: PlannedFrame) -> str:
    return "moves to node {}, {}".format(*frame.stop.node)


def _at(target: Point) -> str:
    return f"at rest at {target.x_mm:.1f}, {target.y_mm:.1f} mm"


def _layout(pixels: Pixels | None) -> str | None:
    """Return size and type of the pixels of a frame, such as `640 x 480 pixels of uint16`."""
    if pixels is None:
        return None
    colours = f" x {pixels.shape[2]} colours" if pixels.ndim == 3 else ""
    return f"{pixels.shape[1]} x {pixels.shape[0]} pixels{colours} of {pixels.dtype.name}"
