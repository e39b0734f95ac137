"""Time to record a frame of 24 MB (intent, file, commit): `python -m benchmarks.speed.journal [FOLDER]`."""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from faintfield.rig.cameras.protocol import Exposure
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.plan import Grid
from faintfield.rig.session.journal import FrameRecord
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan
from faintfield.rig.settings import RigSettings, StepSettings
from faintfield.rig.stages.protocol import Point, StageSettings

FRAMES = 40
SHAPE = (3000, 4000)


def main() -> None:
    """Print the median, 90 % quantile and maximum of the times of frames given as a file and as an array."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed.journal", description=__doc__)
    parser.add_argument("folder", nargs="?")
    parent = parser.parse_args().folder
    settings = RigSettings(
        stage=StageSettings("simulated"),
        camera=SimulatedSettings(),
        grid=Grid(1, 1, 50.0, Point(-350.0, -350.0)),
        step=(StepSettings("dark", 0.1, FRAMES),),
    )
    plan = FrozenPlan(survey(open_rig(settings), settings).plan, settings)
    generator = np.random.default_rng(1)
    pixels = generator.integers(0, 65536, SHAPE, dtype=np.uint16)
    with tempfile.TemporaryDirectory(dir=parent) as folder:
        for name, exposure in (
            ("file", Exposure(".nef", content=pixels.tobytes())),
            ("array", Exposure(".tiff", pixels=pixels)),
        ):
            costs_ms = _costs_ms(Path(folder) / name, plan, exposure)
            median, high = np.quantile(costs_ms, (0.5, 0.9))
            print(f"{name}: median {median:.0f} ms, 90 % {high:.0f} ms, worst {max(costs_ms):.0f} ms, {FRAMES} frames")


def _costs_ms(folder: Path, plan: FrozenPlan, exposure: Exposure) -> list[float]:
    """Return the time of each frame."""
    costs_ms = []
    with open_session(folder, plan) as session:
        for frame in session.frames:
            begun_s = time.perf_counter()
            written = session.write(frame, session.intend(frame), exposure)
            session.commit(frame, written, FrameRecord(frame.stop.target, frame.exposure_s))
            costs_ms.append(1e3 * (time.perf_counter() - begun_s))
    return costs_ms


if __name__ == "__main__":
    main()
