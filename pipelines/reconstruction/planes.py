"""One plane of one channel: run a method on it, watch it, and say how it went."""

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image, LikelihoodName
from faintfield.recon.likelihood.selection import select_likelihood
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.solver.cross_validation import MIN_VIEWS, cross_validated_weight
from faintfield.recon.solver.initialization import (
    back_projection,
    smooth_start,
    universal_penalty_weight,
    well_seen_samples,
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
from faintfield.recon.solver.problem import SceneProblem
from faintfield.recon.solver.proximal import DualField
from faintfield.recon.solver.uncertainty import standard_deviation

type Method = Literal["pmlem", "backprojection", "mlem", "pmlem-osl", "joint", "occlusion"]

# Methods that find all planes together, by `pipelines.reconstruction.joint`.
TOGETHER: tuple[Method, ...] = ("joint", "occlusion")

# Passes over the data that are made at most. MLEM is stopped early on purpose: carried on, it fits the noise.
_PASSES = {"mlem": 20, "pmlem-osl": 50, "pmlem": 30}

# An iteration whose plane changes by less than this per pass has settled.
_SETTLED = 1e-3

# PMLEM is carried on until its plane is this close to the optimum, in root mean square relative to the plane.
_TOLERANCE = 0.01

# Standard deviations are estimated by draws, the same every time.
_SEED = 1

# ε of eq. (3) relative to the square of the image's scale; the paper asks for less than 1 %.
_EPSILON_OF_SCALE = 0.005


@dataclass(frozen=True)
class Settings:
    """How planes are reconstructed.

    Attributes
    ----------
    penalty_weight : float, optional
        β; chosen from the data when None: by held-out views for PMLEM, from the noise level for one-step-late.
    passes : int, optional
        At most this many passes over the data; the method's own limit when None.
    likelihood : str
        How pixels are judged; "auto" chooses by their read noise.
    penalty : str
        What PMLEM holds against a plane; one-step-late knows the smoothed total variation of eq. (3) only.
    uncertainty : bool
        Whether the standard deviation of PMLEM's planes is asked for.
    """

    penalty_weight: float | None = None
    passes: int | None = None
    likelihood: LikelihoodName | Literal["auto"] = "auto"
    penalty: PenaltyName = "tv"
    uncertainty: bool = False


@dataclass(frozen=True)
class Solution:
    """A plane of one channel.

    Attributes
    ----------
    plane : float array (row, column)
        In expected electrons.
    record : dict
        How it came about.
    beside : dict of str to float array (row, column)
        What else is known of each sample: `sigma`, its standard deviation in electrons; `opacity`, 0 to 1.
    """

    plane: Image
    record: dict[str, Any]
    beside: dict[str, Image] = field(default_factory=dict)


def solve(operator: PlaneOperator, images: ElementalImages, method: Method, settings: Settings) -> Solution:
    """Reconstruct one plane of one channel.

    Raises
    ------
    NotConverged
        The penalty weight is too large for the views.
    """
    if method == "backprojection":
        plane = back_projection(operator, images)
        return Solution(plane, _record(plane, None, "none: a mean of the views", 1))
    if method == "pmlem":
        return certified(Objective.of(SceneProblem(operator, images), settings), settings)[0]
    start = smooth_start(operator, images)
    images = replace(images, likelihood=select_likelihood(images, settings.likelihood, _level_e(operator, start)))
    return _one_step_late(operator, images, start, method, settings)


@dataclass(frozen=True)
class Objective:
    """What PMLEM minimises, but for the penalty's weight.

    Attributes
    ----------
    posed : SceneProblem
        The operator, and the images with the likelihood they are judged by.
    penalty : Penalty
        What is held against planes.
    start : float array
        Where to begin.
    level_e : float
        Mean light of what the views see.
    """

    posed: SceneProblem
    penalty: Penalty
    start: Image
    level_e: float

    @classmethod
    def of(cls, posed: SceneProblem, settings: Settings) -> "Objective":
        """Choose likelihood and penalty as asked for, by the level of light and noise."""
        start = posed.start()
        level_e = posed.level_e(start)
        likelihood = select_likelihood(posed.images, settings.likelihood, level_e)
        posed = replace(posed, images=replace(posed.images, likelihood=likelihood))

        def noise_e() -> float:
            return float(1 / np.sqrt(np.median(posed.fit(level_e).metric(start)[posed.well_seen()])))

        return cls(posed, Penalty.for_noise(settings.penalty, noise_e), start, level_e)


def certified(objective: Objective, settings: Settings) -> list[Solution]:
    """Run PMLEM to its certificate, and return the planes; the record of each is that of the one iteration."""
    posed, penalty, level_e = objective.posed, objective.penalty, objective.level_e
    choice = _chosen(posed, objective.start, penalty, settings)
    iterates = pmlem(
        posed.fit(level_e),
        choice.start,
        penalty_weight=choice.weight,
        penalty=penalty,
        tolerance=_TOLERANCE,
        dual=choice.dual,
    )
    limit = settings.passes or _PASSES["pmlem"]
    for done, iterate in enumerate(iterates, 1):
        if iterate.certificate.distance <= _TOLERANCE or max(done, iterate.passes) >= limit:
            break
    record = _record(iterate.plane, choice.weight, choice.how, iterate.passes, None, iterate.objective)
    record |= {
        "passes_before": 1 + choice.passes,
        "penalty_weight_curve": choice.curve,
        "penalty": asdict(penalty),
        "likelihood": posed.images.likelihood.name,
        "certificate": _certificate(iterate),
    }
    planes = posed.planes_of(iterate.plane)
    beside: list[dict[str, Image]] = [{} for _ in planes]
    if settings.uncertainty:
        generator = np.random.default_rng(_SEED)
        for known, plane, metric in zip(beside, planes, posed.metrics(level_e, iterate.plane), strict=True):
            known["sigma"] = standard_deviation(plane, metric, choice.weight, penalty, generator)
    return [
        Solution(plane, record | {"mean_e": mean_e(plane)}, known) for plane, known in zip(planes, beside, strict=True)
    ]


def _certificate(iterate: PmlemIterate) -> dict[str, Any]:
    """Return what reconstruction.json says of the distance to the optimum."""
    certificate = iterate.certificate
    return {
        "kind": "bound on the relative distance to the optimum, from its optimality conditions in the metric of the "
        "data; see docs/physics.md",
        "value": float(certificate.distance),
        "stationarity": float(certificate.stationarity),
        "slack": float(certificate.slack),
        "tolerance": _TOLERANCE,
        "reached": bool(certificate.distance <= _TOLERANCE),
        "passes": iterate.passes,
        "inner_steps": iterate.inner_steps,
    }


@dataclass(frozen=True)
class _Choice:
    """A penalty weight, how it was found, and where a reconstruction with it may start."""

    weight: float
    how: str
    start: Image
    dual: DualField
    passes: float = 0.0
    curve: list[dict[str, float]] | None = None


def _chosen(posed: SceneProblem, start: Image, penalty: Penalty, settings: Settings) -> _Choice:
    """Return the penalty weight for PMLEM."""
    if settings.penalty == "none":
        return _Choice(0.0, "none: no penalty", start, posed.dual())
    if settings.penalty_weight is not None:
        return _Choice(settings.penalty_weight, "given", start, posed.dual())
    guess = posed.usual_weight(start)
    if len(posed.views) < MIN_VIEWS:
        return _Choice(guess, "from the noise level: too few views to hold some out", start, posed.dual())
    found = cross_validated_weight(posed, guess, penalty)
    curve = [{"weight": tried.weight, "held_out": tried.loss} for tried in found.candidates]
    nearest = np.maximum(found.solution.plane, 1e-3 * start)
    return _Choice(found.weight, "predicts held-out views best", nearest, found.solution.dual, found.passes, curve)


def _level_e(operator: PlaneOperator, start: Image) -> float:
    """Return the mean light of what the views see."""
    return float(start[well_seen_samples(operator.sensitivity())].mean(dtype=np.float64))


def _one_step_late(
    operator: PlaneOperator, images: ElementalImages, start: Image, method: Method, settings: Settings
) -> Solution:
    """Run MLEM or one-step-late PMLEM as published."""
    epsilon = _EPSILON_OF_SCALE * float(np.quantile(start, 0.99)) ** 2
    weight, chosen = _penalty_weight(operator, images, start, method, settings)
    steps: list[IterationStep] = []
    limit = settings.passes or _PASSES[method]
    for iterate in pmlem_one_step_late(operator, images, start, penalty_weight=weight, epsilon=epsilon):
        steps.append(iterate.step)
        if len(steps) >= limit or settled(steps, _SETTLED):
            break
    plane = iterate.plane
    objective = operator.negative_log_likelihood(plane, images) + weight * total_variation(plane, epsilon)
    record = _record(plane, weight, chosen, len(steps), epsilon, objective)
    record["likelihood"] = images.likelihood.name
    record["certificate"] = {
        "kind": "relative change of the last pass; one-step-late iterations prove no optimum",
        "relative_change": steps[-1].relative_change,
        "settled": settled(steps, _SETTLED),
        "oscillates": oscillates(steps, _SETTLED),
        "kept_at_start": int(np.count_nonzero(~updated_samples(operator.sensitivity(), weight))),
    }
    return Solution(plane, record)


def _penalty_weight(
    operator: PlaneOperator, images: ElementalImages, start: NDArray[np.floating], method: Method, settings: Settings
) -> tuple[float, str]:
    """Return β and how it was chosen."""
    if method == "mlem":
        return 0.0, "none: maximum likelihood"
    if settings.penalty_weight is not None:
        return settings.penalty_weight, "given"
    return universal_penalty_weight(operator, images, start), "from the noise level"


def _record(
    plane: NDArray[np.floating],
    weight: float | None,
    chosen: str,
    passes: int,
    epsilon: float | None = None,
    objective: float | None = None,
) -> dict[str, Any]:
    """Return what reconstruction.json says of a plane's making, whatever the method."""
    return {
        "penalty_weight": weight,
        "penalty_weight_chosen": chosen,
        "epsilon_e2": epsilon,
        "passes": passes,
        "objective": objective,
        "certificate": None,
        "mean_e": mean_e(plane),
    }


def mean_e(plane: Image) -> float:
    """Return the mean of a plane, summed in float64."""
    return float(np.mean(plane, dtype=np.float64))
