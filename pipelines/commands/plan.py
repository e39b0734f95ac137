"""`faintfield plan`: what a capture will show, before it is made."""

from pathlib import Path
from typing import TYPE_CHECKING

from faintfield.pipelines.planning.options import PlanOptions

if TYPE_CHECKING:
    from faintfield.pipelines.formats.results.prediction import PredictionRecord

_DEFAULTS = PlanOptions()

type Result = PredictionRecord


def plan(rig: Path, /, *, options: PlanOptions = _DEFAULTS) -> Result:
    """Predict what a capture will show: SNR, noise of the planes, smallest contrast, depth, and time.

    Stage and camera are asked for their speeds, and nothing moves. A table compares exposures, grids and frames per
    node, and with --sigma-e names the shortest session that reaches a wanted noise. What is not known is said to be
    unknown, and why. docs/capture.md explains the numbers, and compares them with simulated captures.

    Parameters
    ----------
    rig
        The rig.toml.
    """
    from faintfield.pipelines.workflows.plan import predict_capture

    return predict_capture(rig, options)
