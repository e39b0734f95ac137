"""A rig.toml checked without motion: `faintfield check`."""

import shutil
from collections.abc import Mapping
from pathlib import Path

import msgspec

from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.formats.files import require_room, write_json
from faintfield.pipelines.formats.toml_files import read_rig, read_stage_settings, stage_settings_path
from faintfield.pipelines.termination import interrupt_on_termination
from faintfield.rig.capture.guide import describe_frame_count, format_capture_duration
from faintfield.rig.capture.survey import Survey, survey
from faintfield.rig.devices import open_rig
from faintfield.rig.session.resume import check_same_rig, find_changes, present_settings
from faintfield.rig.session.session import has_session, is_sealed, read_plan
from faintfield.rig.settings import RigSettings
from faintfield.rig.stages.protocol import StageSettings


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
    lights: dict[str, str] = {}


def check_rig(rig: Path, remember: bool, session: Path | None) -> RigCheck:
    """Ask stage, camera and disk whether a capture is possible, and print the answers."""
    settings = read_rig(rig)
    since = [] if session is None else _changes_since(session, settings)
    with interrupt_on_termination():  # lights that are tried go off
        found = survey(open_rig(settings), settings, lights=True)
    stored = read_stage_settings(rig)
    changed = [] if stored is None else _changed_settings(stored, found.stage.settings)
    require_room(rig, found.plan.wanted_room_bytes())
    for line in _survey_lines(found, settings.stage, rig):
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
        lights=found.lights,
    )


def _changes_since(session: Path, settings: RigSettings) -> list[str]:
    """Print what has changed since a session was begun or resumed last, and return it.

    Raises PlanRefused if a setting that the session keeps has changed, so that it cannot be resumed.
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


def _survey_lines(rig: Survey, stage: StageSettings, rig_file: Path) -> list[str]:
    """Return a line each about stage, camera, lights, plan and the disk of the rig.toml."""
    plan, travel = rig.plan, rig.stage.travel_mm
    duration = format_capture_duration(rig.duration_s, stage)
    size_mb, need_mb = plan.disk_bytes() / 1e6, plan.wanted_room_bytes() / 1e6
    free_mb = shutil.disk_usage(rig_file.absolute().parent).free / 1e6
    return [
        f"stage: {rig.stage.firmware}, travel {travel}; all {len(plan.path())} points of the path are allowed",
        f"camera: {rig.camera.name}; all exposure times are offered",
        *(f"light {name}: {outcome}" for name, outcome in rig.lights.items()),
        f"plan: {describe_frame_count(plan)} in {len(plan.steps)} steps, {duration}",
        f"disk: {size_mb:.0f} MB of frames; {need_mb:.0f} MB are wanted, {free_mb:.0f} MB are free",
    ]


def _changed_settings(stored: Mapping[str, str], present: Mapping[str, str]) -> list[str]:
    """Return a warning for each setting of the stage that differs from the stored one."""
    return [
        f"the stage's {key} was {stored.get(key, 'absent')} when stored and is {present.get(key, 'absent')} now; "
        "set it back, or store it with --remember"
        for key in sorted(stored.keys() | present.keys())
        if stored.get(key) != present.get(key)
    ]
