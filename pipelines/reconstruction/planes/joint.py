"""All planes of a scene together, in one colour: g = Σ_z H_z f_z + b, optionally with nearer planes hiding others."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace

import numba
import numpy as np
from msgspec import structs

from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import MemoryShort
from faintfield.pipelines.formats.large_arrays import available_bytes
from faintfield.pipelines.formats.plane_poses import Place
from faintfield.pipelines.formats.results.records import Method, SolveRecord
from faintfield.pipelines.reconstruction.operators import OperatorFactory
from faintfield.pipelines.reconstruction.planes.penalised import Objective, solve_pmlem
from faintfield.pipelines.reconstruction.planes.prior import with_prior
from faintfield.pipelines.reconstruction.planes.solutions import Pilot, Settings, Solution, mean_e
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.occlusion import opacity
from faintfield.recon.solver.data_fit import SceneProblem

# Arrays as large as all planes that their fit needs, beside one for each thread: while a weight is chosen, or planes
# hide others.
_ARRAYS_OF_SAMPLES = 23


def solve_together(
    factory: OperatorFactory,
    images: ElementalImages,
    grids: Mapping[Place, PlaneGrid],
    methods: Collection[Method],
    settings: Settings,
    pilots: Mapping[Place, Pilot] | None = None,
) -> dict[Method, dict[Place, Solution]]:
    """Reconstruct all planes of one colour together, so that no plane has to explain the light of the others.

    Parameters
    ----------
    grids : mapping of Place to PlaneGrid
        The samples of each plane.
    methods : collection of Method
        "joint", "occlusion" or both; with the latter planes hide those behind them if that explains the images better.
    pilots : mapping of Place to Pilot, optional
        What a prior begins with: planes of "joint" by total variation.

    Returns
    -------
    dict of Method to dict of Place to Solution
        All records are of one iteration: its penalty weight, passes, objective and certificate.
    """
    _check_memory(grids.values())
    operator = factory.of_scene(grids)
    objective = Objective.of(SceneProblem(operator, images), settings)
    joint = [pilots[place].solution for place in grids] if pilots else solve_pmlem(objective, settings)
    other_colours = operator.samples_of([pilots[place].other_colours for place in grids]) if pilots else None
    found: dict[Method, list[Solution]] = {}
    if "joint" in methods:
        found["joint"] = with_prior(objective, joint, settings, other_colours=other_colours)
    if "occlusion" in methods:
        found["occlusion"] = _with_occlusion(
            factory, objective, grids, joint, settings, other_colours, found.get("joint")
        )
    return {method: dict(zip(grids, planes, strict=True)) for method, planes in found.items()}


def _check_memory(grids: Iterable[PlaneGrid]) -> None:
    """Refuse to begin without memory for the arrays as large as all planes."""
    samples = sum(rows * columns for rows, columns in (grid.shape for grid in grids))
    arrays = _ARRAYS_OF_SAMPLES + int(numba.config.NUMBA_NUM_THREADS)
    needed, free = arrays * samples * np.dtype(np.float32).itemsize, available_bytes()
    if needed > free:
        raise MemoryShort(
            f"planes found together need {needed / 1e9:.3g} GB beside the images, and {free / 1e9:.3g} GB of "
            "memory are free; ask for fewer planes, a larger --pitch-mm, or --method pmlem"
        )


def _with_occlusion(
    factory: OperatorFactory,
    objective: Objective,
    grids: Mapping[Place, PlaneGrid],
    joint: list[Solution],
    settings: Settings,
    other_colours: Image | None,
    done: list[Solution] | None,
) -> list[Solution]:
    """Estimate opacity from the planes, then reconstruct the light again behind it with the same penalty weight.

    Where that explains the images no better, the planes of joint stay, which may be done already.

    Likelihood and penalty stay the same, too, so that the lower of both objectives explains the images better.
    The plane written is `α f`: where a plane is transparent it has no light of its own. The certificate is that of f.
    """
    first = joint[0].record
    settings = replace(settings, penalty_weight=first.penalty_weight)
    try:
        occluded = factory.of_scene(grids, [opacity(solution.plane) for solution in joint])
    except GeometryMismatch:
        unchanged = done or with_prior(objective, joint, settings, other_colours=other_colours)
        return _without_occlusion(unchanged, "a plane would be hidden from all views")
    behind = replace(objective, posed=replace(objective.posed, operator=occluded))
    better = solve_pmlem(behind, settings)
    objectives = better[0].record.objective, first.objective
    assert objectives[0] is not None
    assert objectives[1] is not None
    if objectives[0] >= objectives[1]:
        unchanged = done or with_prior(objective, joint, settings, other_colours=other_colours)
        return _without_occlusion(unchanged, "it explains the images no better")
    return [
        _of_opaque_part(solution, first)
        for solution in with_prior(behind, better, settings, other_colours=other_colours)
    ]


def _of_opaque_part(solution: Solution, first: SolveRecord) -> Solution:
    """Return a plane as `α f` with α beside it, its weight recorded as chosen in the first run."""
    alpha = opacity(solution.plane)
    plane = alpha * solution.plane
    record = structs.replace(
        solution.record,
        penalty_weight_chosen=first.penalty_weight_chosen,
        penalty_weight_curve=first.penalty_weight_curve,
        passes_before=first.passes_before,
        mean_e=mean_e(plane),
        occlusion=True,
    )
    return Solution(plane, record, solution.sidecars | {"opacity": alpha})


def _without_occlusion(joint: list[Solution], reason: str) -> list[Solution]:
    """Return the planes unchanged, and inform the user."""
    inform(f"occlusion is left out: {reason}; the planes are those of joint")
    return [
        replace(solution, record=structs.replace(solution.record, occlusion=False, occlusion_left_out=reason))
        for solution in joint
    ]
