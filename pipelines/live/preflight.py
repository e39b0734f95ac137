"""Say in words what a survey of the rig found, before anything moves."""

import shutil
from collections.abc import Mapping
from pathlib import Path

from faintfield.rig.capture.guide import format_duration
from faintfield.rig.capture.survey import Survey
from faintfield.rig.devices import is_simulated
from faintfield.rig.plan import CapturePlan
from faintfield.rig.stages.protocol import StageSettings

# Frames that are taken again keep their earlier file: ask for half as much room again.
_ROOM_FACTOR = 1.5


def needed_bytes(plan: CapturePlan) -> int:
    """Return the free room on disk that a capture should have."""
    return round(_ROOM_FACTOR * plan.disk_bytes())


def duration_words(duration_s: float, stage: StageSettings) -> str:
    """Return the duration of a capture in words, and by which clock if the stage is simulated."""
    words = f"{format_duration(duration_s)} without prompts"
    return f"{words} by the simulated stage's clock, far less by yours" if is_simulated(stage) else words


def survey_lines(found: Survey, stage: StageSettings, rig: Path) -> list[str]:
    """Return a line each about stage, camera, plan and the disk of the rig.toml."""
    plan, travel = found.plan, found.stage.travel_mm
    size_mb, need_mb = plan.disk_bytes() / 1e6, needed_bytes(plan) / 1e6
    free_mb = shutil.disk_usage(rig.absolute().parent).free / 1e6
    return [
        f"stage: {found.stage.firmware}, travel {travel}; all {len(plan.path())} points of the path are allowed",
        f"camera: {found.camera.name}; all exposure times are offered",
        f"plan: {plan.frame_count()} frames in {len(plan.steps)} steps, {duration_words(found.duration_s, stage)}",
        f"disk: {size_mb:.0f} MB of frames; {need_mb:.0f} MB are wanted, {free_mb:.0f} MB are free",
    ]


def changed_settings(stored: Mapping[str, str], present: Mapping[str, str]) -> list[str]:
    """Return a warning for each setting of the stage that differs from the stored one."""
    return [
        f"the stage's {key} was {stored.get(key, 'absent')} when stored and is {present.get(key, 'absent')} now; "
        "set it back, or store it with --remember"
        for key in sorted(stored.keys() | present.keys())
        if stored.get(key) != present.get(key)
    ]
