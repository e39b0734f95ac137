"""All planes of a scene together, in one channel: g = Σ_z H_z f_z + b, or with what nearer planes hide of farther ones."""

from collections.abc import Collection, Mapping
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


def solve_together(
    factory: OperatorFactory,
    images: ElementalImages,
    grids: Mapping[float, PlaneGrid],
    methods: Collection[Method],
    settings: Settings,
) -> dict[Method, dict[float, Solution]]:
    """Reconstruct all planes of one channel together, so that none has to explain the light of the others.

    Parameters
    ----------
    grids : mapping of float to PlaneGrid
        The samples at each depth in mm.
    methods : collection of Method
        "joint", "occlusion" or both: by the latter planes hide those behind them, where that explains the images
        better.

    Returns
    -------
    dict of Method to dict of float to Solution
        By method and depth. All records tell of one iteration: its penalty weight, passes, objective and certificate.
    """
    operator = factory.of_scene(grids)
    joint = certified(PosedScene(operator, images), settings)
    found: dict[Method, list[Solution]] = {"joint": joint}
    if "occlusion" in methods:
        found["occlusion"] = _with_occlusion(factory, operator, images, grids, joint, settings)
    return {method: dict(zip(grids, found[method], strict=True)) for method in methods}


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
            Solution(
                one.plane, one.record | chosen | {"occlusion_rounds": done + 1}, one.beside | {"opacity": of_plane}
            )
            for one, of_plane in zip(better, opacities, strict=True)
        ]
    if "opacity" not in found[0].beside:
        say("occlusion explains the images no better; the planes are those without")
        found = [replace(one, record=one.record | {"occlusion_rounds": 0}) for one in found]
    return found
