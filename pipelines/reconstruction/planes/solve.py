"""One colour of one plane: run a method on it and record how it went."""

from dataclasses import replace

import numpy as np

from faintfield.pipelines.formats.results.records import Certificate, Method, SolveRecord
from faintfield.pipelines.reconstruction.planes.penalised import Objective, solve_pmlem
from faintfield.pipelines.reconstruction.planes.prior import with_prior
from faintfield.pipelines.reconstruction.planes.solutions import Pilot, Settings, Solution, mean_e
from faintfield.recon.likelihood.images import ElementalImages, Image, select_likelihood
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.solver.initialization import (
    back_projection,
    mean_light_e,
    smooth_start,
    universal_penalty_weight,
)
from faintfield.recon.solver.one_step_late import (
    IterationStep,
    oscillates,
    pmlem_one_step_late,
    settled,
    updated_samples,
)
from faintfield.recon.solver.penalties import total_variation

# Largest number of passes over the data. MLEM is stopped early on purpose: further passes fit the noise.
_MAX_PASSES = {"mlem": 20, "pmlem-osl": 50}

# A one-step-late iteration has settled when a pass changes the plane by less than this, relative to the plane.
_SETTLED = 1e-3

# ε of eq. (3) relative to the square of the image's scale; the paper asks for less than 1 %.
_EPSILON_OF_SCALE = 0.005

# What the last pass says, in words.
_ONE_STEP_LATE_CERTIFICATE = "relative change of the last pass; one-step-late iterations prove no optimum"


def solve(
    operator: PlaneOperator, images: ElementalImages, method: Method, settings: Settings, pilot: Pilot | None = None
) -> Solution:
    """Reconstruct one plane of one colour, by a prior from its pilot if there is one.

    Raises
    ------
    NotConverged
        The penalty weight is too large for the views.
    """
    if method == "backprojection":
        plane = back_projection(operator, images)
        chosen = "none: a mean of the views"
        return Solution(
            plane, SolveRecord(penalty_weight=None, penalty_weight_chosen=chosen, passes=1, mean_e=mean_e(plane))
        )
    if method == "pmlem":
        objective = Objective.of(SceneProblem(operator, images), settings)
        if pilot:
            return with_prior(objective, [pilot.solution], settings, other_colours=pilot.other_colours)[0]
        return with_prior(objective, solve_pmlem(objective, settings), settings)[0]
    start = smooth_start(operator, images)
    likelihood = select_likelihood(images, settings.likelihood, mean_light_e(operator, start))
    images = replace(images, likelihood=likelihood)
    return _solve_one_step_late(operator, images, start, method, settings)


def _solve_one_step_late(
    operator: PlaneOperator, images: ElementalImages, start: Image, method: Method, settings: Settings
) -> Solution:
    """Run MLEM or one-step-late PMLEM as published."""
    epsilon = _EPSILON_OF_SCALE * float(np.quantile(start, 0.99)) ** 2
    weight, chosen = _one_step_late_weight(operator, images, start, method, settings)
    steps: list[IterationStep] = []
    limit = settings.passes or _MAX_PASSES[method]
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
        mean_e=mean_e(plane),
        likelihood=images.likelihood.name,
    )
    return Solution(plane, record)


def _one_step_late_weight(
    operator: PlaneOperator, images: ElementalImages, start: Image, method: Method, settings: Settings
) -> tuple[float, str]:
    """Return β and how it was chosen."""
    if method == "mlem":
        return 0.0, "none: maximum likelihood"
    if settings.penalty_weight is not None:
        return settings.penalty_weight, "given"
    return universal_penalty_weight(operator, images, start), "from the noise level"
