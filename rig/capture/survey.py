"""Before anything moves: who is there, what is planned, and whether it can be done."""

import math

from msgspec import Struct

from faintfield.rig.cameras.protocol import CameraReport
from faintfield.rig.devices import Rig
from faintfield.rig.errors import PlanRefused
from faintfield.rig.plan import CapturePlan
from faintfield.rig.settings import RigSettings
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import Identity


class Survey(Struct, frozen=True):
    """What was found.

    Parameters
    ----------
    stage : Identity
        Who the stage's controller says it is.
    camera : CameraReport
        Who the camera says it is.
    plan : CapturePlan
        What will be captured.
    duration_s : float
        How long it will take, prompts aside.
    """

    stage: Identity
    camera: CameraReport
    plan: CapturePlan
    duration_s: float


def survey(rig: Rig, settings: RigSettings) -> Survey:
    """Connect to stage and camera, lay down the plan, and let both go again; nothing moves, nothing is exposed.

    Raises
    ------
    RigError
        One of them does not answer, or the plan cannot be carried out.
    """
    try:
        rig.stage.connect()
        rig.camera.open()
        report = rig.camera.report()
        plan = CapturePlan.of(
            settings.grid,
            settings.steps(),
            approach_mm=settings.stage.approach_mm,
            frame_bytes=report.frame_bytes,
            settle_s=settings.settle.wait_s,
            readout_s=report.readout_s,
        )
        refuse_what_cannot_be_done(plan, rig.stage, report)
        identity = rig.stage.identify()
        duration_s = plan.duration_s(identity.motion, rig.stage.feed_mm_per_s())
        return Survey(identity, report, plan, duration_s)
    finally:
        rig.camera.close()
        rig.stage.close()


def refuse_what_cannot_be_done(plan: CapturePlan, stage: Gantry, camera: CameraReport) -> None:
    """Raise when a position of the plan is not allowed, or an exposure time not offered.

    Raises
    ------
    PlanRefused
        With the first thing that is wrong.
    """
    plan.check(stage.workspace())
    for exposure_s in sorted({exposure_s for step in plan.steps for exposure_s in step.exposure_s}):
        if not camera.offers(exposure_s):
            offered = camera.exposures_s or ()
            nearest = min(offered, key=lambda it: abs(math.log(it / exposure_s)), default=math.nan)
            raise PlanRefused(
                f"exposure_s = {exposure_s:g} is not offered by the camera; the nearest that is: {nearest:g}; "
                "correct it in rig.toml"
            )
