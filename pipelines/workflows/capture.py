"""At the rig: a rig.toml checked without motion, and a session captured with guidance."""

import sys
from pathlib import Path

import msgspec

from faintfield.pipelines.console import console, inform
from faintfield.pipelines.errors import MissingFile, WrongUsage
from faintfield.pipelines.formats.files import require_room, write_json
from faintfield.pipelines.formats.toml_files import read_rig, read_stage_settings, stage_settings_path
from faintfield.pipelines.live.guided import capture_session, changed_settings, needed_bytes, survey_lines
from faintfield.pipelines.live.planes_client import MAX_DEPTHS, LiveOrder
from faintfield.pipelines.reconstruction.options import sweep_values
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.session.resume import check_same_rig, find_changes, present_settings
from faintfield.rig.session.session import has_session, is_sealed, read_plan
from faintfield.rig.settings import RigSettings

# Noise, geometry and focal length for the live planes.
type Known = tuple[Path | None, Path | None, float | None]


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


class Captured(msgspec.Struct, frozen=True):
    """The result of `faintfield capture`: the session, and the number of frames taken by this call."""

    session: str
    complete: bool
    taken: int


def capture_or_resume(
    rig: Path,
    session: Path,
    *,
    yes: bool,
    page: bool,
    live_depth_mm: list[float] | None,
    live_sweep_mm: str | None,
    known: Known,
) -> Captured:
    """Capture a session, or go on with it."""
    if not (yes or page or (console.is_terminal and sys.stdin.isatty())):
        raise WrongUsage("there is no terminal to answer prompts on; give --yes, or --page and answer there")
    depths = [*(live_depth_mm or [])]
    if live_sweep_mm is not None:
        depths += sweep_values("--live-sweep-mm", live_sweep_mm, "400:900:16")
        if min(depths) <= 0:
            raise WrongUsage(f"--live-sweep-mm {live_sweep_mm}: planes lie before the camera; give positive depths")
    planes = _live_order(rig, session, depths, known)
    if planes is not None and not page:
        raise WrongUsage("live planes are shown on the page, and there is none; give --page, too")
    taken = capture_session(read_rig(rig), session, unattended=yes, page=page, planes=planes)
    return Captured(str(session), complete=True, taken=taken)


def _live_order(rig: Path, session: Path, depths: list[float], known: Known) -> LiveOrder | None:
    noise, geometry, fx_px = known
    if not depths:
        if any(value is not None for value in known):
            raise WrongUsage("--noise, --geometry and --fx-px are of live planes; give --live-depth-mm, too")
        return None
    if len(depths) > MAX_DEPTHS:
        raise WrongUsage(f"{len(depths)} live planes are asked for, at most {MAX_DEPTHS} are computed; give fewer")
    return LiveOrder(
        session=session.absolute(),
        rig=rig.absolute(),
        depths_mm=tuple(sorted(set(depths))),
        noise=None if noise is None else noise.absolute(),
        geometry=None if geometry is None else geometry.absolute(),
        fx_px=fx_px,
    )
