"""Capture of a session with guidance, and the planes to show meanwhile."""

import sys
from pathlib import Path

import msgspec

from faintfield.pipelines.console import console
from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.toml_files import read_rig
from faintfield.pipelines.live.guided import capture_session
from faintfield.pipelines.live.planes_client import MAX_DEPTHS, LiveOrder
from faintfield.pipelines.reconstruction.options import sweep_values


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
    known: tuple[Path | None, Path | None, float | None],
) -> Captured:
    """Capture a session, or go on with it; `known` are noise, geometry and focal length for the live planes."""
    if not (yes or page or (console.is_terminal and sys.stdin.isatty())):
        raise WrongUsage("there is no terminal to answer prompts on; give --yes, or --page and answer there")
    planes = _live_order(rig, session, live_depth_mm, live_sweep_mm, known)
    if planes is not None and not page:
        raise WrongUsage("live planes are shown on the page, and there is none; give --page, too")
    taken = capture_session(read_rig(rig), session, unattended=yes, page=page, planes=planes)
    return Captured(str(session), complete=True, taken=taken)


def _live_order(
    rig: Path,
    session: Path,
    depth_mm: list[float] | None,
    sweep_mm: str | None,
    known: tuple[Path | None, Path | None, float | None],
) -> LiveOrder | None:
    """Return which live planes are asked for, None if none are; `known` are noise, geometry and focal length."""
    depths = [*(depth_mm or []), *([] if sweep_mm is None else sweep_values("--live-sweep-mm", sweep_mm, "400:900:16"))]
    noise, geometry, fx_px = known
    if not depths:
        if any(value is not None for value in known):
            raise WrongUsage("--noise, --geometry and --fx-px are of live planes; give --live-depth-mm, too")
        return None
    if min(depths) <= 0:
        raise WrongUsage(f"--live-sweep-mm {sweep_mm}: planes lie before the camera; give positive depths")
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
