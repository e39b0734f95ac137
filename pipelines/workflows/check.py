"""Check of a rig.toml against stage, camera and disk, without any motion."""

from pathlib import Path

import msgspec

from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.formats.files import require_room, write_json
from faintfield.pipelines.formats.toml_files import read_rig, read_stage_settings, stage_settings_path
from faintfield.pipelines.live.guided import changed_settings, needed_bytes, survey_lines
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.session.resume import check_same_rig, find_changes, present_settings
from faintfield.rig.session.session import has_session, is_sealed, read_plan
from faintfield.rig.settings import RigSettings


class RigCheck(msgspec.Struct, frozen=True):
    """The result of `faintfield check`: what the capture takes, who answered, and what has changed."""

    frames: int
    disk_bytes: int
    duration_s: float
    stage: str
    camera: str
    changed_settings: list[str]
    changed_since_session: list[str]
    warnings: list[str]


def check_rig(rig: Path, remember: bool, session: Path | None) -> RigCheck:
    """Ask stage, camera and disk whether a capture is possible, and print the answers."""
    settings = read_rig(rig)
    since = [] if session is None else _changes_since(session, settings)
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
    return RigCheck(
        frames=found.plan.frame_count(),
        disk_bytes=found.plan.disk_bytes(),
        duration_s=found.duration_s,
        stage=found.stage.firmware,
        camera=found.camera.name,
        changed_settings=changed,
        changed_since_session=since,
        warnings=list(found.stage.warnings),
    )


def _changes_since(session: Path, settings: RigSettings) -> list[str]:
    """Print what has changed since a session was begun or resumed last, and return it.

    Raises
    ------
    PlanRefused
        A setting that the session keeps has changed, so that it cannot be resumed.
    """
    if not has_session(session):
        raise MissingFile(f"{session}: holds no session; name the folder of one that was begun")
    changes = find_changes(present_settings(session), settings)
    for change in changes:
        effect = "the session keeps the old value" if change.frozen else "would apply from the resume on"
        inform(f"session: {change}; {effect}")
    check_same_rig(read_plan(session), settings)
    outcome = "it is complete, nothing is left to capture" if is_sealed(session) else "a resume would be accepted"
    inform(f"session: {session}: {outcome}; {len(changes) or 'no'} settings differ")
    return [str(change) for change in changes]
