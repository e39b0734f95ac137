"""PMLEM with its weight chosen from the data: planes at the certified optimum of likelihood and penalty."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from msgspec import structs

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.console import stage
from faintfield.pipelines.formats.results.records import Certificate, PenaltyRecord, SolveRecord, WeightScore
from faintfield.pipelines.reconstruction.planes.custom import CustomOptions
from faintfield.recon.likelihood.images import Image, select_likelihood
from faintfield.recon.solver.custom_penalty import ProximalPenalty
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.solver.initialization import mean_light_e
from faintfield.recon.solver.penalties import Penalty, total_variation
from faintfield.recon.solver.penalty_weight import MIN_VIEWS, cross_validated_weight, universal_penalty_weight
from faintfield.recon.solver.pmlem import PmlemIterate, iterate_until, pmlem
from faintfield.recon.solver.proximal import DualField
from faintfield.recon.solver.uncertainty import (
    Answers,
    LocalProblem,
    local_fits,
    standard_deviation,
)

# Largest number of passes over the data.
MAX_PASSES = 30

# Least light of samples to start from, relative to the mean light.
_LEAST_START = 1e-3

# PMLEM stops when its plane is this close to the optimum: root mean square, relative to the plane. A plane from which a
# prior begins may be farther from it.
_TOLERANCE, _PILOT_TOLERANCE = 0.01, 0.03

# Seed of the draws by which standard deviations are estimated: the same result every time.
_SEED = 1

# What bounds the distance to the optimum, in words.
_PMLEM_CERTIFICATE = (
    "bound on the relative distance to the optimum, from its optimality conditions in the metric of the data"
)
_CUSTOM_CERTIFICATE = (
    "relative distance to expect from the lengths of the last two steps; with a penalty of one's own, nothing bounds it"
)


@dataclass(frozen=True)
class Solution:
    """One colour of a plane (row, column), in expected electrons, and how it was solved.

    The `sidecars` say what else is known of each sample: `sigma`, its standard deviation in electrons; `opacity`, 0 to
    1; `proposal`, in electrons, of a prior; `moved`, the plane less the proposal in standard deviations of the noise.
    """

    plane: Image
    record: SolveRecord
    sidecars: dict[str, Image] = field(default_factory=dict)


@dataclass(frozen=True)
class Pilot:
    """Start of the prior of one colour: the plane of total variation, and the sum of the other colours in electrons."""

    solution: Solution
    other_colours: Image


@dataclass(frozen=True)
class Objective:
    """Objective that PMLEM minimises, without the penalty's weight.

    `posed` is the operator, and the images with their likelihood; `start` (samples) are planes that are roughly right,
    and `level_e` the mean light of those samples that the views see, in electrons. In the sum with `other_colours`
    (samples) a prior finds groups of alike patches.
    """

    posed: SceneProblem
    penalty: Penalty | ProximalPenalty
    start: Image
    level_e: float
    options: SolverOptions
    other_colours: Image | None = None

    @classmethod
    def of(
        cls,
        posed: SceneProblem,
        options: SolverOptions,
        start: Image | None = None,
        other_colours: Image | None = None,
    ) -> "Objective":
        """Choose likelihood and penalty according to the options, the light and the noise.

        The light is that of samples to start from, by default the blurred back-projection.
        """
        start = posed.start() if start is None else start
        level_e = mean_light_e(posed.operator, start)
        likelihood = select_likelihood(posed.images, options.likelihood, level_e)
        posed = replace(posed, images=replace(posed.images, likelihood=likelihood))

        def noise_e() -> float:
            return float(1 / np.sqrt(np.median(posed.fit(level_e).metric(start)[posed.well_seen()])))

        custom = options.custom_penalty if isinstance(options, CustomOptions) else None
        penalty = Penalty.for_noise(options.penalty, noise_e) if custom is None else custom
        return cls(posed, penalty, start, level_e, options, other_colours)

    def positive(self, samples: Image) -> Image:
        """Return samples to start from, all of them positive."""
        return np.maximum(samples, samples.dtype.type(_LEAST_START * self.level_e))


def solve_pmlem(objective: Objective, *, as_pilot: bool = False) -> list[Solution]:
    """Run PMLEM to its certificate and return the planes; all their records are of the one iteration.

    Those from which a prior begins, the pilots, have a certificate of a larger tolerance.
    """
    tolerance = _PILOT_TOLERANCE if as_pilot else _TOLERANCE
    with stage("penalty weight"):
        weight, start, dual, how = _choose_weight(objective)
    record, samples = certified(objective, start, weight, dual, tolerance)
    record = structs.replace(record, **{"passes_before": 1.0, "penalty_weight_curve": None} | how)
    return [Solution(plane, record) for plane in objective.posed.operator.planes_of(samples)]


def is_pilot(record: SolveRecord) -> bool:
    """Return whether a plane was solved only as the start of a prior."""
    return record.certificate is not None and record.certificate.tolerance == _PILOT_TOLERANCE


def with_weight_of(record: SolveRecord, first: SolveRecord) -> SolveRecord:
    """Return the record of a solution that began from the first: how its weight was chosen, and passes before it."""
    return structs.replace(
        record,
        penalty_weight=first.penalty_weight,
        penalty_weight_chosen=first.penalty_weight_chosen,
        penalty_weight_curve=first.penalty_weight_curve,
        passes_before=(first.passes_before or 0) + first.passes,
    )


def with_sigma(
    objective: Objective, solutions: list[Solution], responses: Sequence[Callable[[LocalProblem], Answers] | None] = ()
) -> list[Solution]:
    """Return all planes of one colour with their standard deviation beside them.

    `responses` are those of each plane, as for `standard_deviation`; of likelihood and penalty by default.
    """
    operator, weight, penalty = objective.posed.operator, solutions[0].record.penalty_weight or 0.0, objective.penalty
    assert isinstance(penalty, Penalty), "the errors under a penalty of one's own are not known"
    samples = operator.samples_of([solution.plane for solution in solutions])
    generator = np.random.default_rng(_SEED)
    fits = local_fits(operator, objective.posed.fit(objective.level_e), samples)
    found = []
    for solution, local, of_plane in zip(solutions, fits, responses or [None] * len(fits), strict=True):
        with stage("standard deviation"):
            sigma = standard_deviation(local, weight, penalty, generator, of_plane)
        found.append(replace(solution, sidecars=solution.sidecars | {"sigma": sigma}))
    return found


def certified(
    objective: Objective, start: Image, weight: float, dual: DualField, tolerance: float = _TOLERANCE
) -> tuple[SolveRecord, Image]:
    """Run PMLEM with a given weight to its certificate; return its record and samples.

    The dual field says from where, and from which proposal the penalty counts.
    """
    iterates = pmlem(
        objective.posed.fit(objective.level_e),
        start,
        penalty_weight=weight,
        penalty=objective.penalty,
        tolerance=tolerance,
        dual=dual,
    )
    del start  # the iterates drop it after the first step
    with stage("penalised likelihood"):
        iterate = iterate_until(iterates, tolerance, objective.options.passes or MAX_PASSES)
    record = SolveRecord(
        penalty_weight=weight,
        penalty_weight_chosen="given",
        passes=iterate.passes,
        objective=iterate.objective,
        certificate=_certificate(iterate, objective.penalty, tolerance),
        penalty=_penalty_record(objective.penalty),
        likelihood=objective.posed.images.likelihood.name,
    )
    return record, iterate.plane


def _certificate(iterate: PmlemIterate, penalty: Penalty | ProximalPenalty, tolerance: float) -> Certificate:
    if not isinstance(penalty, Penalty):
        return Certificate(
            kind=_CUSTOM_CERTIFICATE,
            tolerance=tolerance,
            passes=iterate.passes,
            relative_change=float(iterate.certificate.expected),
            settled=bool(iterate.certificate.within(tolerance)),
        )
    return Certificate(
        kind=_PMLEM_CERTIFICATE,
        value=float(iterate.certificate.distance),
        stationarity=float(iterate.certificate.stationarity),
        slack=float(iterate.certificate.slack),
        tolerance=tolerance,
        reached=bool(iterate.certificate.within(tolerance)),
        passes=iterate.passes,
        inner_steps=iterate.inner_steps,
    )


def _penalty_record(penalty: Penalty | ProximalPenalty) -> PenaltyRecord:
    if isinstance(penalty, Penalty):
        return PenaltyRecord(penalty.name, penalty.smoothing_e)
    return PenaltyRecord(type(penalty).__name__, 0.0)


def solve_then_sigma(objective: Objective) -> tuple[Solution, Callable[[], Image]]:
    """Reconstruct one colour of one plane by PMLEM; also return a function that computes its standard deviation.

    That takes memory for many planes, but neither the images nor the operator: the caller can drop these first.
    """
    (solution,) = solve_pmlem(objective)
    (local,) = local_fits(objective.posed.operator, objective.posed.fit(objective.level_e), solution.plane)
    weight, generator, penalty = solution.record.penalty_weight or 0.0, np.random.default_rng(_SEED), objective.penalty
    assert isinstance(penalty, Penalty), "the errors under a penalty of one's own are not known"
    return solution, partial(standard_deviation, local, weight, penalty, generator)


def _variation_over(penalty: ProximalPenalty, planes: Sequence[Image]) -> float:
    """Return by how much larger the weight of a penalty is than that of total variation, for equal parts of both."""
    variation, value = (sum(map(of, planes)) for of in (partial(total_variation, epsilon=0.0), penalty.value))
    return variation / value if value > 0 else 1.0


def _choose_weight(objective: Objective) -> tuple[float, Image, DualField, dict[str, Any]]:
    """Return the penalty weight for PMLEM, where a reconstruction with it may start, and how it was chosen."""
    posed, start, options = objective.posed, objective.start, objective.options
    if options.penalty == "none":
        return 0.0, start, posed.dual(), {"penalty_weight_chosen": "none: no penalty"}
    if options.penalty_weight != "auto":
        return options.penalty_weight, start, posed.dual(), {"penalty_weight_chosen": "given"}
    guess = universal_penalty_weight(posed.operator, posed.images, start)
    if not isinstance(objective.penalty, Penalty):
        guess *= _variation_over(objective.penalty, posed.operator.planes_of(start))
    if len(posed.operator.seeing_views) < MIN_VIEWS:
        chosen = "from the noise level: too few views to hold some out"
        return guess, start, posed.dual(), {"penalty_weight_chosen": chosen}
    found = cross_validated_weight(posed, guess, objective.penalty, objective.level_e)
    tried = found.candidates
    best_is_last = min(tried, key=tried.__getitem__) in (min(tried), max(tried))
    how = {
        "penalty_weight_chosen": f"predicts held-out views best{', the last one tried' if best_is_last else ''}",
        "passes_before": 1 + found.passes,
        "penalty_weight_curve": [WeightScore(weight, loss) for weight, loss in found.candidates.items()],
    }
    if found.solution is None:
        how["penalty_weight_chosen"] = f"{how['penalty_weight_chosen']}, in windows of the plane"
        return found.weight, start, posed.dual(), how
    return found.weight, objective.positive(found.solution.plane), found.solution.dual, how
