"""A session captured with guidance, or resumed: `faintfield capture`."""

import sys
from pathlib import Path

import msgspec

from faintfield.pipelines.console import console
from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.results.noise import NOISE_FILE
from faintfield.pipelines.formats.toml_files import read_rig
from faintfield.pipelines.live.guided import capture_session
from faintfield.pipelines.live.light_meter import LightMeter
from faintfield.pipelines.live.planes_client import MAX_DEPTHS, LiveOrder
from faintfield.pipelines.planning.known import calibration_file, known_sensor
from faintfield.pipelines.planning.options import PlanOptions
from faintfield.pipelines.planning.predict import scene_view
from faintfield.pipelines.planning.sample_noise import MeasuredNoise
from faintfield.pipelines.reconstruction.options import sweep_values
from faintfield.rig.capture.rounds import NoisePredictor
from faintfield.rig.session.journal import RoundsEnded
from faintfield.rig.session.session import ROUNDS_ENDED, has_session, is_sealed, open_journal, read_plan
from faintfield.rig.settings import RigSettings

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
    light_e: float | None,
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
    in_rounds = any(step.until is not None for step in settings.step)
    seen = page or console.is_terminal or not yes
    if light_e is not None and not (seen or in_rounds):
        raise WrongUsage("the light is compared on the page or in a terminal, and there is neither; give --page, too")
    if planes is None and not in_rounds:
        if known[1:] != (None, None):
            raise WrongUsage("--geometry and --fx-px are of live planes and of rounds; give --live-depth-mm, too")
        if known[0] is not None and light_e is None:
            raise WrongUsage("--noise is of live planes, rounds and the light; give --live-depth-mm or --light-e, too")
    meter = _light_meter(settings, rig, session, known[0], light_e) if seen else None
    predictor = _predictor(settings, rig, session, known, light_e) if in_rounds else None
    taken = capture_session(settings, session, unattended=yes, page=page, planes=planes, meter=meter, noise=predictor)
    return Captured(str(session), complete=True, taken=taken)


def _light_meter(
    settings: RigSettings, rig: Path, session: Path, noise: Path | None, light_e: float | None
) -> LightMeter:
    """Return the light meter for a planned light in electrons per frame of the dark scene's first exposure."""
    return LightMeter(
        lambda: known_sensor(settings, calibration_file(noise, NOISE_FILE, session, rig.parent)),
        _per_second(settings, light_e),
    )


def _predictor(
    settings: RigSettings, rig: Path, session: Path, known: Known, light_e: float | None
) -> NoisePredictor | None:
    """Return the predictor of the noise of the planes, None where no round is left to be captured."""
    if has_session(session):
        frozen = read_plan(session)
        with open_journal(session, frozen, read_only=True) as journal:
            ended = {ended.step for ended in journal.details(ROUNDS_ENDED, RoundsEnded)}
        steps = {index for index, step in enumerate(frozen.plan.steps) if step.until is not None}
        if is_sealed(session) or steps <= ended:
            return None
    return MeasuredNoise(settings, rig, session, *known, light_e_per_s=_per_second(settings, light_e)).predict


def _per_second(settings: RigSettings, light_e: float | None) -> float | None:
    """Return a light per frame of the dark scene's first exposure as one per second."""
    return None if light_e is None else light_e / scene_view(settings, PlanOptions())[0]


def _live_order(rig: Path, session: Path, depths: list[float], known: Known) -> LiveOrder | None:
    noise, geometry, fx_px = known
    if not depths:
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
