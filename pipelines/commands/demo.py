"""`faintfield demo`: the whole experiment on a simulated rig, ending with report.html."""

from pathlib import Path
from typing import TYPE_CHECKING

from faintfield.pipelines.arguments import Positive, Seed

if TYPE_CHECKING:
    from faintfield.pipelines.workflows.demo import DemoResult

type Result = DemoResult


def demo(out: Path = Path("demo"), /, *, quick: bool = False, snr: Positive = 0.16, seed: Seed = 1) -> Result:
    """Run the paper's experiment on a simulated rig, from the first board sweep to the report.

    A simulated gantry behind a pseudo-terminal carries a simulated camera, which captures boards, objects, dark and
    flat frames as a session; noise, geometry and planes are found from that session. The truth is looked up last, in
    OUT/truth, and metrics.json gives the errors of the results: with measured poses, with nominal ones, and with the
    true ones.

    Parameters
    ----------
    out
        Folder to write; the results of an earlier demo are replaced.
    quick
        Capture fewer nodes and pixels.
    snr
        SNR of the dark views, eq. (4).
    seed
        Seed of the random generator.
    """
    from faintfield.pipelines.workflows.demo import run_demo

    return run_demo(out, quick, snr, seed)
