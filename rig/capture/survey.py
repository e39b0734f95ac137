"""Survey the rig before anything moves: identify stage and camera, make the plan, and check that it is possible."""

import math
from contextlib import suppress

from msgspec import Struct

from faintfield.rig.cameras.protocol import Camera, CameraReport, Thermometer
from faintfield.rig.cameras.settings import CameraSettings
from faintfield.rig.devices import Rig
from faintfield.rig.errors import LightError, PlanRefused, RigError, StageError
from faintfield.rig.lights.controller import ControllerLight
from faintfield.rig.lights.protocol import Light
from faintfield.rig.plan import CapturePlan
from faintfield.rig.settings import RigSettings
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import Identity


class Survey(Struct, frozen=True):
    """Identity of stage and camera as they report it, the plan, and its duration in s without prompts.

    `lights` says of each light by its name what came of trying it, if it was.
    """

    stage: Identity
    camera: CameraReport
    plan: CapturePlan
    duration_s: float
    lights: dict[str, str] = {}


def survey(rig: Rig, settings: RigSettings, *, lights: bool = False) -> Survey:
    """Connect to stage and camera, make the plan, and disconnect; nothing moves and nothing is exposed.

    With `lights`, each of these is switched on and off. Raises `RigError` if a device does not answer or obey, or the
    plan is not possible.
    """
    try:
        rig.stage.connect()
        rig.camera.open()
        report = rig.camera.report()
        require_temperature(rig.camera, settings.camera)
        plan = CapturePlan.of(
            settings.grid,
            settings.steps(),
            approach_mm=settings.stage.approach_mm,
            frame_bytes=report.frame_bytes,
            settle_s=settings.settle.wait_s,
            readout_s=report.readout_s,
        )
        check_plan(plan, rig.stage, report)
        identity = rig.stage.identify()
        duration_s = plan.duration_s(identity.motion, rig.stage.feed_mm_per_s())
        tried = {name: try_light(name, light) for name, light in rig.lights.items()} if lights else {}
        return Survey(identity, report, plan, duration_s, tried)
    finally:
        rig.camera.close()
        rig.stage.close()


def try_light(name: str, light: Light) -> str:
    """Switch a light on and off, read it back, and return the outcome; raise `RigError` if it does not obey."""
    try:
        light.open()
        if isinstance(light, ControllerLight):
            try:
                light.unlock()
            except StageError as failure:
                return f"not tried: {failure}"
        reported = []
        for on in (True, False):
            light.switch(on)
            reported.append(light.is_on())
            if reported[-1] not in (on, None):
                raise LightError(
                    f"light {name}: reports that it is {'off' if on else 'on'} after it was switched "
                    f"{'on' if on else 'off'}; check its wiring and its keys in rig.toml"
                )
        return "switched on and off" + (", which it reports" if None not in reported else "; it reports nothing")
    finally:
        with suppress(RigError):
            light.switch(False)
            light.close()


def check_plan(plan: CapturePlan, stage: Gantry, camera: CameraReport) -> None:
    """Raise `PlanRefused` unless the stage allows all positions of a plan and the camera offers all exposure times."""
    stage.workspace().check_path(plan.path())
    for exposure_s in sorted({exposure_s for step in plan.steps for exposure_s in step.exposure_s}):
        if not camera.offers(exposure_s):
            offered = camera.exposures_s or camera.exposure_range_s or ()
            nearest = min(offered, key=lambda offer: abs(math.log(offer / exposure_s)), default=math.nan)
            raise PlanRefused(
                f"the camera does not offer exposure_s = {exposure_s:g}, the nearest is {nearest:g}; correct it"
            )


def require_temperature(camera: Camera, settings: CameraSettings) -> None:
    """Raise `PlanRefused` if the settings make captures wait for a temperature that the camera does not report."""
    wanted_c = settings.settle_temperature_c
    if wanted_c is not None and read_temperature(camera) is None:
        raise PlanRefused(
            f"camera.settle_temperature_c = {wanted_c:g}, but the camera reports no temperature; remove the key, and "
            "wait for the sensor yourself"
        )


def read_temperature(camera: Camera) -> float | None:
    """Return the temperature of a camera's sensor in °C, None if it reports none."""
    return camera.temperature_c() if isinstance(camera, Thermometer) else None
