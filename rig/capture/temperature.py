"""Wait until the sensor is at its temperature: dark current doubles over a few kelvins."""

import math

from faintfield.rig.cameras.protocol import Camera, Thermometer
from faintfield.rig.cameras.settings import CameraSettings, CoolingSettings
from faintfield.rig.capture.guide import Dialogue
from faintfield.rig.devices import Rig
from faintfield.rig.errors import CameraError, CameraTimeout, PlanRefused
from faintfield.rig.plan import PlannedFrame
from faintfield.rig.session.session import Session

# Interval in s at which the temperature is read.
_POLL_S = 2.0

# Time in s for which the temperature must stay within the tolerance: a cooler that overshoots passes it twice.
_STEADY_S = 10.0


class TemperatureWait:
    """Waits before the first frame of each step, if `camera.settle_temperature_c` is set.

    Parameters
    ----------
    session, rig, dialogue : Session, Rig, Dialogue
        The journal keeps how long each wait was; the camera is read; the operator sees the temperature, and can stop.
    """

    def __init__(self, session: Session, rig: Rig, dialogue: Dialogue) -> None:
        self._session = session
        self._rig = rig
        self._dialogue = dialogue
        self._settled_step: int | None = None

    def before(self, frame: PlannedFrame) -> None:
        """Wait, if `frame` is the first one of its step since the last wait.

        Raises
        ------
        CameraTimeout
            The temperature does not settle within `settle_limit_s`.
        CameraError
            The camera does not report its temperature any more.
        CaptureStopped
            The operator asked for it.
        """
        settings = self._session.rig.camera
        if frame.step == self._settled_step:
            return
        if settings.settle_temperature_c is not None:
            self._wait(frame, settings, settings.settle_temperature_c)
        self._settled_step = frame.step

    def forget(self) -> None:
        """Wait again before the next frame: a camera that failed was perhaps switched off."""
        self._settled_step = None

    def _wait(self, frame: PlannedFrame, settings: CoolingSettings, target_c: float) -> None:
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


def read_temperature(camera: Camera) -> float | None:
    """Return the temperature of a camera's sensor in °C, None if it reports none."""
    return camera.temperature_c() if isinstance(camera, Thermometer) else None


def require_temperature(camera: Camera, settings: CameraSettings) -> None:
    """Raise unless the camera reports its temperature, if the settings make captures wait for one.

    Raises
    ------
    PlanRefused
        The camera reports none.
    """
    wanted_c = settings.settle_temperature_c
    if wanted_c is not None and read_temperature(camera) is None:
        raise PlanRefused(
            f"camera.settle_temperature_c = {wanted_c:g}, but the camera reports no temperature; remove the key, and "
            "wait for the sensor yourself"
        )
