"""A session captured with guidance, or resumed: `faintfield capture`."""

import sys
from pathlib import Path

import msgspec

from faintfield.pipelines.console import console
from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.toml_files import read_rig
from faintfield.pipelines.live.guided import capture_session
from faintfield.pipelines.live.planes_client import MAX_DEPTHS, LiveOrder
from faintfield.pipelines.reconstruction.options import sweep_values

# Noise, geometry and focal length for the live planes.
type Known = tuple[Path | None, Path | None, float | None]


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
    settings = read_rig(rig)
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
    taken = capture_session(settings, session, unattended=yes, page=page, planes=planes)
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
