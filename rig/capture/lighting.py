"""Switch the lights of a capture: set and verify those of each step, and judge frames by their mean."""

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.capture.checks import DARK_KINDS, LIT_KINDS, Findings, mean_and_error
from faintfield.rig.devices import Rig
from faintfield.rig.errors import LightError, RigError
from faintfield.rig.plan import PlannedFrame
from faintfield.rig.session.session import Session

# Name of the mean of a frame among its checks.
MEAN = "mean_dn"
# A frame has less light than this share of the usual one if its lights were off. Boards may leave the field of view.
_DARK_SHARE = 0.1
# Light is sure that lies this many standard errors of a mean above the dark, and this many DN.
_SURE, _SURE_DN = 8.0, 1.0
# Fewer standard errors can be noise.
_FAINT = 3.0


class Lighting:
    """The lights of a capture's rig, as its plan has them.

    A step that names lights has these on and all others off. What they report is read before and after each exposure.
    As a light may report nothing, or have burnt out, the mean of each frame is compared with that of a frame with all
    lights off, and with earlier frames of its step.
    """

    def __init__(self, session: Session, rig: Rig) -> None:
        self._session = session
        self._rig = rig
        self._on: frozenset[str] | None = None  # not known
        self._used = False
        self._recoveries = -1
        self._step: int | None = None
        # Mean of a frame without light and its error, by exposure time in s, of the last step with light
        self._dark_dn: dict[float, tuple[float, float]] = {}

    def open(self) -> None:
        """Connect to all lights; they are switched by `prepare`."""
        self._on = None
        for light in self._rig.lights.values():
            light.open()

    def of(self, frame: PlannedFrame) -> frozenset[str] | None:
        """Return the lights that a frame wants on; None if a person sees to them."""
        names = self._session.plan.steps[frame.step].lights
        return None if names is None else frozenset(names)

    def forget(self) -> None:
        """Note that a failure may have switched lights, so that all are set again."""
        self._on = None

    def prepare(self, frame: PlannedFrame, expose: Callable[[float], Pixels | None]) -> None:
        """Set the lights of a frame; before the first one of a step, look how dark a frame is without them.

        `expose` takes a frame that is not kept, given its exposure time in s, and returns None if it cannot be decoded.
        """
        lights = self.of(frame)
        if lights is None or not self._rig.stage.trusted:  # a frame is refused then
            return
        if self._rig.stage.recoveries != self._recoveries:  # which switches the outputs of its controller off
            self._recoveries, self._on = self._rig.stage.recoveries, None
        if lights and frame.step != self._step:
            self._dark_dn.clear()
            self._set(frame, frozenset())
            self.verify(frame, frozenset())
            for exposure_s in self._session.plan.steps[frame.step].exposure_s:
                if (pixels := expose(exposure_s)) is not None:
                    self._dark_dn[exposure_s] = mean_and_error(pixels)
            exposures_s, means_dn = [*self._dark_dn], [mean_dn for mean_dn, _ in self._dark_dn.values()]
            self._session.journal.event("dark_level", frame=frame.number, exposure_s=exposures_s, mean_dn=means_dn)
        self._step = frame.step
        self._set(frame, lights)

    def verify(self, frame: PlannedFrame, lights: frozenset[str] | None = None) -> None:
        """Raise `LightError` if a light reports another state than a frame, or else `lights`, has it in."""
        lights = self.of(frame) if lights is None else lights
        if lights is None:
            return
        for name, light in self._rig.lights.items():
            on = light.is_on()
            if on is not None and on != (name in lights):
                states = f"reports that it is {_state(on)}, and has to be {_state(not on)} for {frame.name}"
                raise LightError(f"light {name}: {states}; look what switches it besides the capture")

    def judge(self, frame: PlannedFrame, pixels: Pixels, earlier: Sequence[Mapping[str, float]]) -> Findings:
        """Return the mean of a frame, and a warning; raise `LightError` if it shows that other lights are on.

        `earlier` are the values of earlier frames of the same step and exposure.
        """
        lights = self.of(frame)
        if lights is None:
            return Findings({}, ())
        warnings: tuple[str, ...] = ()
        mean_dn, _ = mean_and_error(pixels)
        before_dn = [values[MEAN] for values in earlier if MEAN in values]
        usual_dn = statistics.median(before_dn) if before_dn else None
        dark_dn, error_dn = self._dark_dn.get(frame.exposure_s, (None, 0.0))
        if frame.kind in DARK_KINDS:
            self._require_dark(frame, mean_dn, dark_dn if usual_dn is None else usual_dn)
        elif lights and dark_dn is not None:
            self._require_light(frame, mean_dn - dark_dn, 0.0 if usual_dn is None else usual_dn - dark_dn, error_dn)
            warnings = self._warn_of_no_light(mean_dn - dark_dn, error_dn) if usual_dn is None else ()
        return Findings({MEAN: round(mean_dn, 5)}, warnings)

    def _warn_of_no_light(self, light_dn: float, error_dn: float) -> tuple[str, ...]:
        limit_dn = _FAINT * math.sqrt(2.0) * error_dn
        if light_dn >= limit_dn:
            return ()
        return (
            f"the mean is {light_dn:.2f} DN above that of a frame without light, where {limit_dn:.2f} DN can be told "
            "from noise; look whether the light shines",
        )

    def _require_dark(self, frame: PlannedFrame, mean_dn: float, dark_dn: float | None) -> None:
        limit_dn = self._session.rig.checks.leak_dn
        if dark_dn is not None and mean_dn - dark_dn > limit_dn:
            raise LightError(
                f"{frame.name}: its mean is {mean_dn - dark_dn:.1f} DN above that of a dark frame, limit "
                f"{limit_dn:g} DN; look which light is on, or raise checks.leak_dn"
            )

    def _require_light(self, frame: PlannedFrame, light_dn: float, usual_dn: float, error_dn: float) -> None:
        sure_dn = max(_SURE_DN, _SURE * error_dn)
        least_dn = _DARK_SHARE * usual_dn if usual_dn > sure_dn else -math.inf
        if frame.kind in LIT_KINDS:
            least_dn = max(least_dn, sure_dn)
        if light_dn < least_dn:
            raise LightError(
                f"{frame.name}: its mean is {light_dn:.1f} DN above that of a frame without light, limit "
                f"{least_dn:.1f} DN; look whether its lights shine, and whether the lens is free"
            )

    def switch_off(self) -> list[str]:
        """Switch all lights off, and return what failed, one line each."""
        if not self._used or self._on == frozenset():
            return []
        failures = []
        for name, light in self._rig.lights.items():
            try:
                light.switch(False)
            except RigError as failure:
                failures.append(f"light {name} was not switched off: {failure}")
        self._on = None if failures else frozenset()
        self._session.journal.event("lights", on=None if failures else [])
        return failures

    def close(self) -> None:
        """Disconnect from all lights."""
        for light in self._rig.lights.values():
            with suppress(RigError):
                light.close()

    def _set(self, frame: PlannedFrame, lights: frozenset[str]) -> None:
        if lights == self._on:
            return
        known, self._on, self._used = self._on, None, True
        steady_s = {light.name: light.steady_s for light in self._session.rig.light}
        ended = self._rig.lights.keys() if known is None else known - lights
        begun = lights if known is None else lights - known
        for names, on in ((ended, False), (begun, True)):
            for name in sorted(names):
                self._rig.lights[name].switch(on)
        self._rig.clock.sleep_s(max((steady_s[name] for name in ended | begun), default=0.0))
        self._session.journal.event("lights", frame=frame.number, on=sorted(lights))
        self._on = lights


def _state(on: bool) -> str:
    return "on" if on else "off"
