"""All planes of a scene together, in one channel: g = Σ_z H_z f_z + b, or with what nearer planes hide of farther ones."""

from collections.abc import Mapping
from dataclasses import replace

from pipelines.channels import OperatorFactory
from pipelines.console import say
from pipelines.planes import Method, Settings, Solution, certified
from recon.errors import GeometryMismatch
from recon.images import ElementalImages
from recon.occlusion import opacity, transmission
from recon.plane import PlaneGrid
from recon.posed import PosedScene
from recon.scene import SceneOperator

# How often opacity and light are found in turn at most.
_ROUNDS = 2


def solve_joint(
    factory: OperatorFactory,
    images: ElementalImages,
    grids: Mapping[float, PlaneGrid],
    method: Method,
    settings: Settings,
) -> dict[float, Solution]:
    """Reconstruct all planes of one channel together, so that none has to explain the light of the others.

    Parameters
    ----------
    grids : mapping of float to PlaneGrid
        The samples at each depth in mm.
    method : Method
        "joint", or "occlusion": then planes hide those behind them, where that explains the images better.

    Returns
    -------
    mapping of float to Solution
        By depth. All records tell of the one iteration: its penalty weight, passes, objective and certificate.
    """
    operator = factory.of_scene(grids)
    found = certified(PosedScene(operator, images), settings)
    if method == "occlusion":
        found = _with_occlusion(factory, operator, images, grids, found, settings)
    return dict(zip(grids, found, strict=True))


def _with_occlusion(
    factory: OperatorFactory,
    operator: SceneOperator,
    images: ElementalImages,
    grids: Mapping[float, PlaneGrid],
    found: list[Solution],
    settings: Settings,
) -> list[Solution]:
    """Find opacity and light in turn, with the penalty weight found without, for as long as the objective falls."""
    chosen = {key: found[0].record[key] for key in ("penalty_weight_chosen", "penalty_weight_curve", "passes_before")}
    settings = replace(settings, penalty_weight=found[0].record["penalty_weight"])
    for done in range(_ROUNDS):
        opacities = [opacity(solution.plane) for solution in found]
        try:
            occluded = factory.of_scene(grids, transmission(operator, opacities, list(grids)))
        except GeometryMismatch:
            break  # a plane would be hidden from all views
        better = certified(PosedScene(occluded, images), settings)
        if better[0].record["objective"] >= found[0].record["objective"]:
            break
        found = [
            replace(one, record=one.record | chosen | {"occlusion_rounds": done + 1}, opacity=of_plane)
            for one, of_plane in zip(better, opacities, strict=True)
        ]
    if found[0].opacity is None:
        say("occlusion explains the images no better; the planes are those without")
        found = [replace(one, record=one.record | {"occlusion_rounds": 0}) for one in found]
    return found
