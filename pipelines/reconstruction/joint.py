"""All planes of a scene together, in one channel: g = Σ_z H_z f_z + b, or with what nearer ones hide of farther."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import MemoryShort
from faintfield.pipelines.formats.large_arrays import available_bytes
from faintfield.pipelines.formats.plane_poses import Place, depth_of
from faintfield.pipelines.reconstruction.channels import OperatorFactory
from faintfield.pipelines.reconstruction.planes import Method, Objective, Settings, Solution, certified, mean_e
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.occlusion import opacity, transmission
from faintfield.recon.solver.problem import SceneProblem

# What is computed of each pixel of each view for all planes together: what it sees, of ones and of light, and ratios.
_ARRAYS_OF_IMAGES = 5


def solve_together(
    factory: OperatorFactory,
    images: ElementalImages,
    grids: Mapping[Place, PlaneGrid],
    methods: Collection[Method],
    settings: Settings,
) -> dict[Method, dict[Place, Solution]]:
    """Reconstruct all planes of one channel together, so that none has to explain the light of the others.

    Parameters
    ----------
    grids : mapping of Place to PlaneGrid
        The samples of each plane.
    methods : collection of Method
        "joint", "occlusion" or both: by the latter planes hide those behind them, where that explains the images
        better.

    Returns
    -------
    dict of Method to dict of Place to Solution
        By method and plane. All records tell of one iteration: its penalty weight, passes, objective and certificate.
    """
    _require_memory(images, len(grids) if "occlusion" in methods else 0)
    operator = factory.of_scene(grids)
    objective = Objective.of(SceneProblem(operator, images), settings)
    joint = certified(objective, settings)
    found: dict[Method, list[Solution]] = {"joint": joint}
    if "occlusion" in methods:
        found["occlusion"] = _with_occlusion(factory, objective, grids, joint, settings)
    return {method: dict(zip(grids, found[method], strict=True)) for method in methods}


def _require_memory(images: ElementalImages, masks: int) -> None:
    """Refuse what memory has no room for: arrays as large as the images, and with occlusion one per plane."""
    needed, free = (_ARRAYS_OF_IMAGES + masks) * images.electrons.nbytes, available_bytes()
    if needed > free:
        raise MemoryShort(
            f"planes found together need {needed / 1e9:.3g} GB beside the images, and {free / 1e9:.3g} GB of "
            "memory are free; ask for fewer planes with --occlusion, for --joint alone, or --method pmlem"
        )


def _with_occlusion(
    factory: OperatorFactory,
    objective: Objective,
    grids: Mapping[Place, PlaneGrid],
    joint: list[Solution],
    settings: Settings,
) -> list[Solution]:
    """Find opacity from the planes, and the light once more behind it, with the penalty weight found without.

    Likelihood and penalty stay, too, so that the least of either objective tells which explains the images better.
    What is written of each plane is `α f`: where a plane lets through what is behind it, it is not there, and has no
    light of its own. The certificate is that of f.
    """
    chosen = {key: joint[0].record[key] for key in ("penalty_weight_chosen", "penalty_weight_curve", "passes_before")}
    settings = replace(settings, penalty_weight=joint[0].record["penalty_weight"])
    opacities = [opacity(one.plane) for one in joint]
    hidden = transmission(objective.posed.operator, opacities, [depth_of(place) for place in grids])
    try:
        occluded = factory.of_scene(grids, hidden)
    except GeometryMismatch:
        return _without_occlusion(joint, "a plane would be hidden from all views")
    better = certified(replace(objective, posed=replace(objective.posed, operator=occluded)), settings)
    if better[0].record["objective"] >= joint[0].record["objective"]:
        return _without_occlusion(joint, "it explains the images no better")
    return [_of_what_is_there(one, chosen) for one in better]


def _of_what_is_there(one: Solution, record: dict[str, Any]) -> Solution:
    """Return a plane as `α f`, with α beside it."""
    alpha = opacity(one.plane)
    plane = alpha * one.plane
    return Solution(
        plane, one.record | record | {"mean_e": mean_e(plane), "occlusion": True}, one.beside | {"opacity": alpha}
    )


def _without_occlusion(joint: list[Solution], why: str) -> list[Solution]:
    """Return the planes as they are, and say so."""
    inform(f"occlusion is left out: {why}; the planes are those of joint")
    return [replace(one, record=one.record | {"occlusion": False, "occlusion_left_out": why}) for one in joint]
