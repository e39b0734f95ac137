"""One colour of planes by each method, one after the other or all together: g = Σ_z H_z f_z + b."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace

import numba
import numpy as np
from msgspec import structs

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import MemoryShort
from faintfield.pipelines.formats.large_arrays import available_bytes
from faintfield.pipelines.formats.plane_poses import Place
from faintfield.pipelines.formats.results.records import Certificate, Method, SolveRecord
from faintfield.pipelines.reconstruction.operators import OperatorFactory
from faintfield.pipelines.reconstruction.planes.penalised import Objective, Pilot, Solution, solve_pmlem
from faintfield.pipelines.reconstruction.planes.prior import with_prior
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages, select_likelihood
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.occlusion import opacity
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.solver.initialization import back_projection, mean_light_e, smooth_start
from faintfield.recon.solver.one_step_late import (
    IterationStep,
    oscillates,
    pmlem_one_step_late,
    settled,
    updated_samples,
)
from faintfield.recon.solver.penalties import total_variation
from faintfield.recon.solver.penalty_weight import universal_penalty_weight

# Largest number of passes over the data. MLEM is stopped early on purpose: further passes fit the noise.
_MAX_PASSES = {"mlem": 20, "pmlem-osl": 50}

# A one-step-late iteration has settled when a pass changes the plane by less than this, relative to the plane.
_SETTLED = 1e-3

# ε of eq. (3) relative to the square of the image's scale; the paper asks for less than 1 %.
_EPSILON_OF_SCALE = 0.005

# What the last pass says, in words.
_ONE_STEP_LATE_CERTIFICATE = "relative change of the last pass; one-step-late iterations prove no optimum"

# Arrays as large as all planes that their fit needs, beside one for each thread: while a weight is chosen, or planes
# hide others.
_ARRAYS_OF_SAMPLES = 23


def solve(
    operator: PlaneOperator,
    images: ElementalImages,
    method: Method,
    options: SolverOptions,
    pilot: Pilot | None = None,
) -> Solution:
    """Reconstruct one plane of one colour, by a prior if the options have one, from its pilot if there is one.

    Raises NotConverged if the penalty weight is too large for the views.
    """
    if method == "backprojection":
        plane = back_projection(operator, images)
        chosen = "none: a mean of the views"
        return Solution(plane, SolveRecord(penalty_weight=None, penalty_weight_chosen=chosen, passes=1))
    if method == "pmlem":
        problem = SceneProblem(operator, images)
        if pilot:
            objective = Objective.of(problem, options, pilot.solution.plane, pilot.other_colours)
            return with_prior(objective, [pilot.solution])[0]
        objective = Objective.of(problem, options)
        return with_prior(objective, solve_pmlem(objective, as_pilot=options.has_prior))[0]
    return _solve_one_step_late(operator, images, method, options)


def solve_pilot(operator: PlaneOperator, images: ElementalImages, options: SolverOptions) -> Solution:
    """Return the plane of total variation from which a prior begins."""
    return solve_pmlem(Objective.of(SceneProblem(operator, images), options), as_pilot=True)[0]


def _solve_one_step_late(
    operator: PlaneOperator, images: ElementalImages, method: Method, options: SolverOptions
) -> Solution:
    start = smooth_start(operator, images)
    likelihood = select_likelihood(images, options.likelihood, mean_light_e(operator, start))
    images = replace(images, likelihood=likelihood)
    epsilon = _EPSILON_OF_SCALE * float(np.quantile(start, 0.99)) ** 2
    if method == "mlem":
        weight, chosen = 0.0, "none: maximum likelihood"
    elif options.penalty_weight != "auto":
        weight, chosen = options.penalty_weight, "given"
    else:
        weight, chosen = universal_penalty_weight(operator, images, start), "from the noise level"
    steps: list[IterationStep] = []
    limit = options.passes or _MAX_PASSES[method]
    for iterate in pmlem_one_step_late(operator, images, start, penalty_weight=weight, epsilon=epsilon):
        steps.append(iterate.step)
        if len(steps) >= limit or settled(steps, _SETTLED):
            break
    plane = iterate.plane
    record = SolveRecord(
        penalty_weight=weight,
        penalty_weight_chosen=chosen,
        epsilon_e2=epsilon,
        passes=len(steps),
        objective=operator.negative_log_likelihood(plane, images) + weight * total_variation(plane, epsilon),
        certificate=Certificate(
            kind=_ONE_STEP_LATE_CERTIFICATE,
            relative_change=steps[-1].relative_change,
            settled=settled(steps, _SETTLED),
            oscillates=oscillates(steps, _SETTLED),
            kept_at_start=int(np.count_nonzero(~updated_samples(operator.sensitivity(), weight))),
        ),
        likelihood=images.likelihood.name,
    )
    return Solution(plane, record)


def solve_together(
    factory: OperatorFactory,
    images: ElementalImages,
    grids: Mapping[Place, PlaneGrid],
    methods: Collection[Method],
    options: SolverOptions,
    pilots: Mapping[Place, Pilot] | None = None,
) -> dict[Method, dict[Place, Solution]]:
    """Reconstruct all planes of one colour together, so that no plane has to explain the light of the others.

    The methods are "joint", "occlusion" or both; with the latter planes hide those behind them if that explains the
    images better. `pilots` are planes of "joint" by total variation, with which a prior begins. All records are of one
    iteration: its penalty weight, passes, objective and certificate.
    """
    _check_memory(grids.values())
    operator = factory.of_scene(grids)
    problem = SceneProblem(operator, images)
    if pilots:
        joint = [pilots[place].solution for place in grids]
        near = operator.samples_of([solution.plane for solution in joint])
        other_colours = operator.samples_of([pilots[place].other_colours for place in grids])
        objective = Objective.of(problem, options, near, other_colours)
    else:
        objective = Objective.of(problem, options)
        joint = solve_pmlem(objective)
    found: dict[Method, list[Solution]] = {}
    if "joint" in methods:
        found["joint"] = with_prior(objective, joint)
    if "occlusion" in methods:
        found["occlusion"] = _with_occlusion(factory, objective, grids, joint, found.get("joint"))
    return {method: dict(zip(grids, planes, strict=True)) for method, planes in found.items()}


def _check_memory(grids: Iterable[PlaneGrid]) -> None:
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
    done: list[Solution] | None,
) -> list[Solution]:
    """Estimate opacity from the planes, then reconstruct the light again behind it with the same penalty weight.

    Where that explains the images no better, the planes of joint stay, which may be done already.

    Likelihood and penalty stay the same, too, so that the lower of both objectives explains the images better.
    The plane written is `α f`: where a plane is transparent it has no light of its own. The certificate is that of f.
    """
    first = joint[0].record

    def without(reason: str) -> list[Solution]:
        inform(f"occlusion is left out: {reason}; the planes are those of joint")
        return [
            replace(solution, record=structs.replace(solution.record, occlusion=False, occlusion_left_out=reason))
            for solution in done or with_prior(objective, joint)
        ]

    try:
        occluded = factory.of_scene(grids, [opacity(solution.plane) for solution in joint])
    except GeometryMismatch:
        return without("a plane would be hidden from all views")
    options = replace(objective.options, penalty_weight=first.penalty_weight or 0.0)
    behind = replace(objective, posed=replace(objective.posed, operator=occluded), options=options)
    near = objective.posed.operator.samples_of([solution.plane for solution in joint])
    better = solve_pmlem(replace(behind, start=behind.positive(near)))
    if (better[0].record.objective or 0.0) >= (first.objective or 0.0):
        return without("it explains the images no better")
    return [_of_opaque_part(solution, first) for solution in with_prior(behind, better)]


def _of_opaque_part(solution: Solution, first: SolveRecord) -> Solution:
    """Return a plane as `α f` with α beside it, its weight recorded as chosen in the first run."""
    alpha = opacity(solution.plane)
    record = structs.replace(
        solution.record,
        penalty_weight_chosen=first.penalty_weight_chosen,
        penalty_weight_curve=first.penalty_weight_curve,
        passes_before=first.passes_before,
        occlusion=True,
    )
    return Solution(alpha * solution.plane, record, solution.sidecars | {"opacity": alpha})
