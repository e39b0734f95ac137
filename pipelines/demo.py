"""`faintfield demo`: the whole experiment on simulated light, ending with report.html."""

from pathlib import Path
from typing import Any

from pipelines.arguments import Positive, Seed
from pipelines.console import say
from pipelines.elemental_set import FILE_NAME
from pipelines.files import check_free, write_json
from pipelines.metrics import METRICS_FILE
from pipelines.reconstruct import reconstruct
from pipelines.report import write_report
from pipelines.simulate import NOISE_FREE, simulate

_DEPTHS_MM = [500.0, 700.0]
_DARK_SCENE = "dark-scene"


def demo(out: Path = Path("demo"), /, *, snr: Positive = 0.16, seed: Seed = 1) -> dict[str, Any]:
    """Run the paper's experiment: simulate it in the dark, reconstruct both objects, and draw the report.

    Parameters
    ----------
    out
        Folder to write; the results of an earlier demo are replaced.
    snr
        Of the dark views, eq. (4).
    seed
        Of all chance.
    """
    check_free(out, replace_if=f"{_DARK_SCENE}/{FILE_NAME}")
    scene = out / _DARK_SCENE
    say("simulating 7 x 7 views of a toy truck at 500 mm and a toy airplane at 700 mm, almost dark")
    simulate(scene, snr=snr, seed=seed, overwrite=True)
    say("reconstructing both planes without noise, for comparison")
    reconstruct(scene / NOISE_FREE, out=out / "noise-free", depth_mm=_DEPTHS_MM, method=["backprojection"])
    say("reconstructing both planes from the dark")
    result = reconstruct(scene, out=out / "dark", depth_mm=_DEPTHS_MM, method=["backprojection", "mlem", "pmlem-osl"])
    write_json(out / METRICS_FILE, result["metrics"])
    return {"out": str(out), "report": str(write_report(out)), "metrics": result["metrics"]}
