"""`faintfield capture`: capture a session with guidance, or resume one."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from faintfield.pipelines.arguments import Positive
from faintfield.pipelines.console import console
from faintfield.pipelines.errors import WrongUsage

if TYPE_CHECKING:
    from faintfield.pipelines.live.planes_messages import LiveOrder


def capture(
    rig: Path,
    session: Path,
    /,
    *,
    yes: bool = False,
    page: bool = False,
    live_depth_mm: Annotated[list[Positive] | None, Parameter(consume_multiple=True)] = None,
    live_sweep_mm: str | None = None,
    noise: Path | None = None,
    geometry: Path | None = None,
    fx_px: Positive | None = None,
) -> dict[str, Any]:
    """Capture a session, step by step; run it again to go on where it stopped.

    Keys: p pause, r take the last frame again, s skip, q stop. Ctrl-C stops after the present frame, a second one at
    once.

    Parameters
    ----------
    rig
        The rig.toml.
    session
        Folder of the session.
    yes
        Answer every prompt with its usual answer: for scripts.
    page
        Also serve a local web page, on this computer alone.
    live_depth_mm
        Show planes at these depths on the page, of the dark frames so far; without it there are none.
    live_sweep_mm
        The same, at FIRST:LAST:COUNT depths.
    noise
        For these planes: noise.json or its folder; by default that of the session, or beside the rig.toml.
    geometry
        For these planes: geometry.json or its folder; by default that of the session, or beside the rig.toml.
    fx_px
        For these planes: focal length in pixels, where there is no geometry.json.
    """
    from faintfield.pipelines.formats.rig_file import read_rig
    from faintfield.pipelines.live.guided import capture_session

    if not (yes or page or (console.is_terminal and sys.stdin.isatty())):
        raise WrongUsage("there is no terminal to answer prompts on; give --yes, or --page and answer there")
    planes = _live_order(rig, session, live_depth_mm, live_sweep_mm, (noise, geometry, fx_px))
    if planes is not None and not page:
        raise WrongUsage("live planes are shown on the page, and there is none; give --page, too")
    taken = capture_session(read_rig(rig), session, unattended=yes, page=page, planes=planes)
    return {"session": str(session), "complete": True, "taken": taken}


def _live_order(
    rig: Path,
    session: Path,
    depth_mm: list[float] | None,
    sweep_mm: str | None,
    known: tuple[Path | None, Path | None, float | None],
) -> "LiveOrder | None":
    """Return which live planes are asked for, None if none are; `known` are noise, geometry and focal length."""
    from faintfield.pipelines.live.planes_messages import MAX_DEPTHS, LiveOrder
    from faintfield.pipelines.reconstruction.request import sweep_values

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
