"""One colour of one plane: run a method on it and record how it went."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np
from msgspec import structs

from faintfield.pipelines.formats.results.records import Certificate, Method, PenaltyRecord, SolveRecord, WeightScore
from faintfield.recon.likelihood.images import ElementalImages, Image, LikelihoodName, select_likelihood
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.solver.cross_validation import MIN_VIEWS, cross_validated_weight
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
from faintfield.recon.solver.penalties import Penalty, PenaltyName, total_variation
from faintfield.recon.solver.pmlem import PmlemIterate, pmlem
from faintfield.recon.solver.proximal import DualField
from faintfield.recon.solver.uncertainty import local_fits, standard_deviation

# Largest number of passes over the data. MLEM is stopped early on purpose: further passes fit the noise.
_MAX_PASSES = {"mlem": 20, "pmlem-osl": 50, "pmlem": 30}

# A one-step-late iteration has settled when a pass changes the plane by less than this, relative to the plane.
_SETTLED = 1e-3

# PMLEM stops when its plane is this close to the optimum: root mean square, relative to the plane.
_TOLERANCE = 0.01

# Seed of the draws by which standard deviations are estimated: the same result every time.
_SEED = 1

# ε of eq. (3) relative to the square of the image's scale; the paper asks for less than 1 %.
_EPSILON_OF_SCALE = 0.005

# What bounds the distance to the optimum, in words, by method.
_PMLEM_CERTIFICATE = (
    "bound on the relative distance to the optimum, from its optimality conditions in the metric of the data; "
    "see docs/physics.md"
)
_ONE_STEP_LATE_CERTIFICATE = "relative change of the last pass; one-step-late iterations prove no optimum"


@dataclass(frozen=True)
class Settings:
    """How planes are reconstructed.

    Attributes
    ----------
    penalty_weight : float, optional
        β; chosen from the data if None: by held-out views for PMLEM, from the noise level for one-step-late.
    passes : int, optional
        Largest number of passes over the data; the method's own limit if None.
    likelihood : str
        Model of the pixels; "auto" chooses by their read noise.
    penalty : str
        Penalty of PMLEM; one-step-late always takes the smoothed total variation of eq. (3).
    uncertainty : bool
        Estimate the standard deviation of the samples of PMLEM's planes.
    """

    penalty_weight: float | None = None
    passes: int | None = None
    likelihood: LikelihoodName | Literal["auto"] = "auto"
    penalty: PenaltyName = "tv"
    uncertainty: bool = False


@dataclass(frozen=True)
class Solution:
    """One colour of a plane.

    Attributes
    ----------
    plane : float array (row, column)
        In expected electrons.
    record : SolveRecord
        How it was solved.
    sidecars : dict of str to float array (row, column)
        What else is known of each sample: `sigma`, its standard deviation in electrons; `opacity`, 0 to 1.
    """

    plane: Image
    record: SolveRecord
    sidecars: dict[str, Image] = field(default_factory=dict)


def solve(operator: PlaneOperator, images: ElementalImages, method: Method, settings: Settings) -> Solution:
    """Reconstruct one plane of one colour.

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
        return solve_pmlem(Objective.of(SceneProblem(operator, images), settings), settings)[0]
    start = smooth_start(operator, images)
    likelihood = select_likelihood(images, settings.likelihood, mean_light_e(operator, start))
    images = replace(images, likelihood=likelihood)
    return _solve_one_step_late(operator, images, start, method, settings)


@dataclass(frozen=True)
class Objective:
    """What PMLEM minimises, except for the penalty's weight.

    Attributes
    ----------
    posed : SceneProblem
        The operator, and the images with their likelihood.
    penalty : Penalty
        Penalty of a plane.
    start : float array
        Where to begin.
    level_e : float
        Mean light of the samples that the views see, in electrons.
    """

    posed: SceneProblem
    penalty: Penalty
    start: Image
    level_e: float

    @classmethod
    def of(cls, posed: SceneProblem, settings: Settings) -> "Objective":
        """Choose likelihood and penalty according to the settings, the light and the noise."""
        start = posed.start()
        level_e = mean_light_e(posed.operator, start)
        likelihood = select_likelihood(posed.images, settings.likelihood, level_e)
        posed = replace(posed, images=replace(posed.images, likelihood=likelihood))

        def noise_e() -> float:
            return float(1 / np.sqrt(np.median(posed.fit(level_e).metric(start)[posed.well_seen()])))

        return cls(posed, Penalty.for_noise(settings.penalty, noise_e), start, level_e)


def solve_pmlem(objective: Objective, settings: Settings) -> list[Solution]:
    """Run PMLEM to its certificate and return the planes; all their records are of the one iteration."""
    posed, penalty, level_e = objective.posed, objective.penalty, objective.level_e
    choice = _choose_weight(posed, objective.start, penalty, settings)
    iterates = pmlem(
        posed.fit(level_e),
        choice.start,
        penalty_weight=choice.weight,
        penalty=penalty,
        tolerance=_TOLERANCE,
        dual=choice.dual,
    )
    limit = settings.passes or _MAX_PASSES["pmlem"]
    for count, iterate in enumerate(iterates, 1):
        if iterate.certificate.distance <= _TOLERANCE or max(count, iterate.passes) >= limit:
            break
    record = SolveRecord(
        penalty_weight=choice.weight,
        penalty_weight_chosen=choice.chosen,
        passes=iterate.passes,
        objective=iterate.objective,
        certificate=_certificate(iterate),
        mean_e=mean_e(iterate.plane),
        passes_before=1 + choice.passes,
        penalty_weight_curve=choice.curve,
        penalty=PenaltyRecord(penalty.name, penalty.smoothing_e),
        likelihood=posed.images.likelihood.name,
    )
    planes = posed.operator.planes_of(iterate.plane)
    solutions = [Solution(plane, structs.replace(record, mean_e=mean_e(plane))) for plane in planes]
    if settings.uncertainty:
        generator = np.random.default_rng(_SEED)
        for one, local in zip(solutions, local_fits(posed.operator, posed.fit(level_e), iterate.plane), strict=True):
            one.sidecars["sigma"] = standard_deviation(local, choice.weight, penalty, generator)
    return solutions


def solve_then_sigma(
    operator: PlaneOperator, images: ElementalImages, settings: Settings
) -> tuple[Solution, Callable[[], Image]]:
    """Reconstruct one colour of one plane by PMLEM; also return a function that computes its standard deviation.

    That takes memory for many planes, but neither the images nor the operator: the caller can drop these first.
    """
    objective = Objective.of(SceneProblem(operator, images), settings)
    (solution,) = solve_pmlem(objective, replace(settings, uncertainty=False))
    (local,) = local_fits(operator, objective.posed.fit(objective.level_e), solution.plane)
    weight, generator = solution.record.penalty_weight or 0.0, np.random.default_rng(_SEED)
    return solution, partial(standard_deviation, local, weight, objective.penalty, generator)


def _certificate(iterate: PmlemIterate) -> Certificate:
    """Return the distance of an iterate to the optimum."""
    certificate = iterate.certificate
    return Certificate(
        kind=_PMLEM_CERTIFICATE,
        value=float(certificate.distance),
        stationarity=float(certificate.stationarity),
        slack=float(certificate.slack),
        tolerance=_TOLERANCE,
        reached=bool(certificate.distance <= _TOLERANCE),
        passes=iterate.passes,
        inner_steps=iterate.inner_steps,
    )


@dataclass(frozen=True)
class _Choice:
    """A penalty weight, how it was chosen, and where a reconstruction with it may start."""

    weight: float
    chosen: str
    start: Image
    dual: DualField
    passes: float = 0.0
    curve: list[WeightScore] | None = None


def _choose_weight(posed: SceneProblem, start: Image, penalty: Penalty, settings: Settings) -> _Choice:
    """Return the penalty weight for PMLEM: as given, or else by cross-validation."""
    if settings.penalty == "none":
        return _Choice(0.0, "none: no penalty", start, posed.dual())
    if settings.penalty_weight is not None:
        return _Choice(settings.penalty_weight, "given", start, posed.dual())
    guess = universal_penalty_weight(posed.operator, posed.images, start)
    if len(posed.operator.seeing_views) < MIN_VIEWS:
        return _Choice(guess, "from the noise level: too few views to hold some out", start, posed.dual())
    found = cross_validated_weight(posed, guess, penalty)
    curve = [WeightScore(weight, loss) for weight, loss in found.candidates.items()]
    nearest = np.maximum(found.solution.plane, 1e-3 * start)
    return _Choice(found.weight, "predicts held-out views best", nearest, found.solution.dual, found.passes, curve)


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


def mean_e(plane: Image) -> float:
    """Return the mean of a plane, summed in float64."""
    return float(np.mean(plane, dtype=np.float64))
