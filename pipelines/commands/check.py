"""`faintfield check`: could this be captured? Asks stage, camera and disk; nothing moves."""

import json
import shutil
from pathlib import Path
from typing import Any

from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.files import require_room, write_json
from faintfield.pipelines.formats.rig_file import read_rig
from faintfield.rig.capture.guide import format_duration
from faintfield.rig.capture.survey import Survey, survey
from faintfield.rig.devices import is_simulated, open_rig
from faintfield.rig.stages.settings import StageSettings

# Retaken and superseded frames stay: plan for half as much again.
ROOM_FACTOR = 1.5


def check(rig: Path, /, *, remember: bool = False) -> dict[str, Any]:
    """Check a configuration against the rig, without any motion.

    Parameters
    ----------
    rig
        The rig.toml.
    remember
        Store the stage's settings beside the file; later checks say what has changed since.
    """
    settings = read_rig(rig)
    found = survey(open_rig(settings), settings)
    stored = rig.with_suffix(".stage.json")
    changed = _changed_settings(stored, found)
    need = round(ROOM_FACTOR * found.plan.disk_bytes())
    require_room(rig, need)
    for line in _lines(found, settings.stage, rig, need):
        inform(line)
    for warning in (*found.stage.warnings, *changed):
        inform(f"warning: {warning}")
    if remember:
        write_json(stored, found.stage.settings)
        inform(f"stored the stage's settings in {stored}")
    elif not stored.exists():
        inform("the stage's settings are not stored yet; with --remember, later checks say what has changed")
    return {
        "frames": found.plan.frame_count(),
        "disk_bytes": found.plan.disk_bytes(),
        "duration_s": found.duration_s,
        "stage": found.stage.firmware,
        "camera": found.camera.name,
        "changed_settings": changed,
        "warnings": found.stage.warnings,
    }


def time_in_words(duration_s: float, stage: StageSettings) -> str:
    """Return how long a capture takes, and by whose clock if that is not the one on the wall."""
    words = f"{format_duration(duration_s)} without prompts"
    return f"{words} by the simulated stage's clock, far less by yours" if is_simulated(stage) else words


def _lines(found: Survey, stage: StageSettings, rig: Path, need: int) -> list[str]:
    """Return what people want to know."""
    plan, travel = found.plan, found.stage.travel_mm
    size_mb, need_mb = plan.disk_bytes() / 1e6, need / 1e6
    free_mb = shutil.disk_usage(rig.absolute().parent).free / 1e6
    return [
        f"stage: {found.stage.firmware}, travel {travel}; all {len(plan.path())} points of the way are allowed",
        f"camera: {found.camera.name}; all exposure times are offered",
        f"plan: {plan.frame_count()} frames in {len(plan.steps)} steps, {time_in_words(found.duration_s, stage)}",
        f"disk: {size_mb:.0f} MB of frames; {need_mb:.0f} MB are wanted, {free_mb:.0f} MB are free",
    ]


def _changed_settings(stored: Path, found: Survey) -> list[str]:
    """Return in words which of the stage's settings differ from the stored ones."""
    if not stored.exists():
        return []
    try:
        before = json.loads(stored.read_bytes())
        keys = sorted(before.keys() | found.stage.settings.keys())
    except (ValueError, AttributeError) as failure:
        raise BadValue(f"{stored}: is not what --remember writes ({failure}); run with --remember again") from failure
    return [
        f"the stage's {key} was {before.get(key, 'absent')} when stored and is "
        f"{found.stage.settings.get(key, 'absent')} now; set it back, or store it with --remember"
        for key in keys
        if before.get(key) != found.stage.settings.get(key)
    ]
