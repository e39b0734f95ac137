"""Small sessions, captured without a person from a rig that exists in the computer alone."""

from collections.abc import Sequence
from pathlib import Path

from faintfield.pipelines.cli import run
from faintfield.pipelines.commands.reconstruction import run as run_session
from faintfield.pipelines.reconstruction.options import Options

_RIG = """
[stage]
protocol = "simulated"

[camera]
backend = "simulated"
size_px = [320, 240]
{camera}

[grid]
rows = {rows}
columns = {columns}
pitch_mm = {pitch_mm}
origin_mm = [-350.0, -350.0]

[checks]
{checks}

[settle]
measure = false
wait_s = 3.0

[drift]
check = false

[[board]]
name = "large"
columns = 9
rows = 7
square_mm = 40.0
marker_mm = 30.0
dictionary = "DICT_4X4_50"
"""
SWEEPS = ("charuco", "charuco", "charuco", "charuco")
STEPS = (*SWEEPS, "dark_scene", "dark", "flat")
_EXPOSURES_S = {"dark": [0.1, 1.0, 10.0, 60.0], "flat": [0.02, 0.05, 0.1], "charuco": 0.05}
_FRAMES = {"dark": 8, "flat": 4}


def rig_toml(
    steps: Sequence[str] = STEPS,
    *,
    rows: int = 3,
    columns: int = 3,
    pitch_mm: float = 100.0,
    camera: str = "",
    checks: str = "",
) -> str:
    """Return a rig.toml; `camera` and `checks` are further lines of these tables."""
    exposures = [(kind, _EXPOSURES_S.get(kind, 0.1), _FRAMES.get(kind, 1)) for kind in steps]
    tables = [f'[[step]]\nkind = "{kind}"\nexposure_s = {e}\nframes_per_node = {n}\n' for kind, e, n in exposures]
    return "\n".join(
        [_RIG.format(rows=rows, columns=columns, pitch_mm=pitch_mm, camera=camera, checks=checks), *tables]
    )


def steps_run(session: Path, options: Options) -> list[str]:
    """Return the steps that `faintfield run` had to do."""
    return [step.step for step in run_session(session, options=options).steps if step.ran]


def captured(folder: Path, text: str) -> Path:
    """Capture the session of a rig.toml within a folder, and return it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.toml").write_text(text)
    assert run(["capture", str(folder / "rig.toml"), str(folder / "session"), "--yes"]) == 0
    return folder / "session"
