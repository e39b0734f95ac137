"""`faintfield check`: ask stage, camera and disk whether a capture is possible; nothing moves."""

from pathlib import Path
from typing import Any

from faintfield.pipelines.console import inform
from faintfield.pipelines.formats.files import require_room, write_json
from faintfield.pipelines.formats.rig_file import read_rig, read_stage_settings, stage_settings_path
from faintfield.pipelines.live.guided import changed_settings, needed_bytes, survey_lines
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig


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
    stored = read_stage_settings(rig)
    changed = [] if stored is None else changed_settings(stored, found.stage.settings)
    require_room(rig, needed_bytes(found.plan))
    for line in survey_lines(found, settings.stage, rig):
        inform(line)
    for warning in (*found.stage.warnings, *changed):
        inform(f"warning: {warning}")
    if remember:
        write_json(stage_settings_path(rig), found.stage.settings)
        inform(f"stored the stage's settings in {stage_settings_path(rig)}")
    elif stored is None:
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
