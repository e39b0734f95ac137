"""Take one frame: move, rest, verify the position, expose, write, check and commit; and check for drift."""

import itertools
import math
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

from faintfield.rig.cameras.protocol import Decode, Exposure, Pixels
from faintfield.rig.cameras.settings import CoolingSettings
from faintfield.rig.capture.checks import LIT_KINDS, Findings, Settling, board_warnings, check_frame, measure_settling
from faintfield.rig.capture.guide import MAX_UNATTENDED_TRIES, Answer, Dialogue, Prompt, ShownFrame
from faintfield.rig.capture.survey import read_temperature
from faintfield.rig.errors import CameraError, CameraTimeout, DriftUnknown, PositionDrifted
from faintfield.rig.plan import PlannedFrame
from faintfield.rig.session.journal import CommittedFrame, FrameRecord
from faintfield.rig.stages.drift import DriftWatch
from faintfield.rig.stages.protocol import Point


class DriftChecks:
    """The drift checks of a capture; `watch`, which measures the drift, is None if `drift.check` is off.

    `nodes` counts those that the stage moved to since the last check.
    """

    def __init__(self, dialogue: Dialogue) -> None:
        self._dialogue = dialogue
        self._session, self._rig, self._pace = dialogue.session, dialogue.rig, dialogue.pace
        settings = self._session.frozen.rig.drift
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

    def __init__(self, dialogue: Dialogue, drift: DriftChecks, decode: Decode) -> None:
        self._dialogue, self._drift, self._decode = dialogue, drift, decode
        self._session, self._rig, self._pace = dialogue.session, dialogue.rig, dialogue.pace
        self._settings = self._session.rig
        self._cooled_step: int | None = None
        self._layouts: dict[str, str | None] = {}
        self._unkept_numbers = itertools.count(_FIRST_UNKEPT_NUMBER)
        self.last: PlannedFrame | None = None
        self._measures = self._settings.settle.measure and self._rig.camera_sees_stage
        for settling in self._session.journal.details("settling", Settling):
            self._rest_as(settling)

    def take(self, frame: PlannedFrame) -> None:
        """Move to the node of a frame and take it; before the first frame of a step, wait for the sensor to be cool.

        Raises `StageError`, `NotHomed`, `CameraError` or `SessionUnwritable`, after which the frame is still missing.
        """
        settings = self._settings.camera
        if settings.settle_temperature_c is not None and frame.step != self._cooled_step:
            self._wait_for_temperature(frame, settings, settings.settle_temperature_c)
        self._cooled_step = frame.step
        self._dialogue.stage = "moves to node {}, {}".format(*frame.stop.node)
        self._dialogue.show_status(frame, "moving")
        self._go_to(frame)
        self._dialogue.stage = _at(frame.stop.target)
        self._dialogue.camera = f"exposes for {frame.exposure_s:g} s"
        self._dialogue.show_status(frame, "exposing")
        try:
            self._expose(frame)
        except CameraError:
            self._cooled_step = None  # a camera that failed was perhaps switched off
            raise

    def take_test(self, frame: PlannedFrame) -> None:
        """Expose as for `frame` and show the picture; nothing of it is recorded.

        Raises `StageError`, `NotHomed` or `CameraError`.
        """
        self._dialogue.stage = "moves to node {}, {}, for a test frame".format(*frame.stop.node)
        self._dialogue.show_status(frame, "taking a test frame")
        self._go_to(frame, test=True)
        self._dialogue.stage = _at(frame.stop.target)
        self._dialogue.camera = f"exposes a test frame for {frame.exposure_s:g} s"
        self._dialogue.show_status(frame, "taking a test frame")
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
        if self._pace.here == target:
            return
        self._pace.depart()
        self._rig.stage.move_to(*target)
        self._drift.nodes += 1
        measures = self._measures and frame.kind in LIT_KINDS and not test
        if measures:
            self._measure_settling(frame)
        self._rig.clock.sleep_s(self._pace.rest_s[frame.kind])
        self._pace.arrive(target, frame.kind, timed=not measures)

    def _expose(self, frame: PlannedFrame) -> None:
        """Take a frame at the present node; the order of these steps makes a kill at any moment harmless."""
        rig, session = self._rig, self._session
        begun_s = rig.clock.now_s()
        intent = session.intend(frame)
        position = rig.stage.verify_at(*frame.stop.target)
        exposure = rig.camera.expose(frame.exposure_s, intent)
        rig.stage.verify_at(*frame.stop.target)
        written = session.write(frame, intent, exposure)
        try:
            pixels = self._decode_frame(frame, written.path, exposure)
        except CameraError as failure:
            session.reject(frame, written, str(failure))
            raise
        findings = self._check(frame, pixels)
        metadata = dict(exposure.metadata)
        record = FrameRecord(position.point, frame.exposure_s, metadata, findings.values, findings.warnings)
        self._drift.add(session.commit(frame, written, record))
        self.last = frame
        if findings.warnings:
            self._dialogue.warnings = tuple(f"{frame.name}: {warning}" for warning in findings.warnings)
        if frame.kind == "charuco":
            corners = {
                number: int(committed.record.checks["board_corners"])
                for number, committed in session.valid().items()
                if "board_corners" in committed.record.checks
            }
            for warning in board_warnings(frame, session.frames, corners, self._settings.checks.board_corners):
                self._dialogue.warn(warning)
        self._pace.finish_frame(begun_s, frame.exposure_s)
        self._note_temperature(record.temperature_c)
        if pixels is not None:
            self._dialogue.operator.show_frame(ShownFrame(frame, pixels, findings, record.temperature_c))

    def _decode_frame(self, frame: PlannedFrame, path: Path, exposure: Exposure) -> Pixels | None:
        """Return the pixels of a frame, None if it cannot be decoded here; its layout must be that of the session."""
        pixels = exposure.pixels if exposure.pixels is not None else self._decode(path)
        layout = self._layouts[path.name] = _layout(pixels)
        numbers = self._session.valid().keys() - {frame.number}  # a frame is not compared with an earlier take of it
        first = self._session.valid()[min(numbers)] if numbers else None
        expected = None if first is None else self._layout_of(first)
        if first is not None and expected is not None and layout != expected:
            raise CameraError(
                f"{path.name}: {f'has {layout}' if layout else 'cannot be decoded'}, but {first.file} has {expected}; "
                "set the camera as it was when the session was begun, and take this frame again"
            )
        return pixels

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
        return check_frame(pixels, frame.kind, self._settings.checks, self._settings.board, earlier)

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

    def _expose_unkept(self, exposure_s: float) -> tuple[Exposure, Pixels | None]:
        """Take a frame that is not kept; its pixels are None if it cannot be decoded here."""
        exposure = self._rig.camera.expose(exposure_s, next(self._unkept_numbers))
        if exposure.content is None:
            return exposure, exposure.pixels
        with TemporaryDirectory(prefix="faintfield-") as folder:
            path = Path(folder) / f"frame{exposure.suffix}"
            path.write_bytes(exposure.content)
            return exposure, self._decode(path)


def _at(target: Point) -> str:
    return f"at rest at {target.x_mm:.1f}, {target.y_mm:.1f} mm"


def _layout(pixels: Pixels | None) -> str | None:
    """Return size and type of the pixels of a frame, such as `640 x 480 pixels of uint16`."""
    if pixels is None:
        return None
    colours = f" x {pixels.shape[2]} colours" if pixels.ndim == 3 else ""
    return f"{pixels.shape[1]} x {pixels.shape[0]} pixels{colours} of {pixels.dtype.name}"
