"""Planes by a prior: proposals beyond total variation, and what the data make of them."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from msgspec import UNSET, structs

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.console import stage
from faintfield.pipelines.formats.results.records import PriorRecord, SolveRecord
from faintfield.pipelines.reconstruction.planes.custom import CustomOptions
from faintfield.pipelines.reconstruction.planes.learned_prior import learned_estimate, outside_range
from faintfield.pipelines.reconstruction.planes.penalised import (
    Objective,
    Solution,
    certified,
    is_pilot,
    solve_pmlem,
    with_sigma,
    with_weight_of,
)
from faintfield.recon.likelihood.images import Image
from faintfield.recon.prior.collaborative import patch_candidates
from faintfield.recon.prior.denoiser import DenoiserCandidates, name_of
from faintfield.recon.prior.evidence import Evidence, evidence_of_planes, misfits
from faintfield.recon.prior.proposal import (
    WEIGHT_ABOUT_PROPOSAL,
    PlaneProposal,
    ProposalAnswers,
    Regions,
    propose,
    regions_of_planes,
)
from faintfield.recon.prior.scales import Candidates, CandidatesOfScales, scales
from faintfield.recon.solver.penalty_weight import MIN_VIEWS
from faintfield.recon.solver.uncertainty import Answers, LocalProblem


def with_prior(objective: Objective, solutions: Sequence[Solution]) -> list[Solution]:
    """Return planes under the prior of the options, given those of total variation.

    The proposal x̂ is a mixture of candidates chosen by held-out views. What is returned is the certified optimum of
    `min L(f) + 1.2 β TV(f − x̂)` over f ≥ 0, with the β of total variation: where the data contradict the proposal, they
    win. Its record says how far they moved it. Standard deviations are added where the options ask for them.
    """
    found: list[Solution] = list(solutions)
    answers: list[Callable[[LocalProblem], Answers]] = []
    if objective.options.has_prior:
        with stage("proposal of the prior"):
            made = _about_proposals(objective, solutions)
        if isinstance(made, str):
            prior = PriorRecord(name="tv", left_out=made)
            if is_pilot(solutions[0].record):
                found = solve_pmlem(Objective.of(objective.posed, objective.options))
            found = [replace(solution, record=structs.replace(solution.record, prior=prior)) for solution in found]
        else:
            found, answers = made
    return with_sigma(objective, found, answers) if objective.options.uncertainty else found


def _contradiction(objective: Objective, samples: Image, regions: Sequence[Regions]) -> str | None:
    """Return how the views contradict planes by more than noise, None if they do not."""
    operator, images = objective.posed.operator, objective.posed.images
    found = next((misfit for misfit in misfits(operator, images, samples, regions) if misfit.contradicts), None)
    if found is None:
        return None
    return (
        f"the views differ from the plane by more than noise where it has detail ({found.detail:.3g} times the "
        f"variance, {found.smooth:.3g} where it is smooth), as by errors of poses and optics, or objects that hide "
        "others, which a prior may take for detail"
    )


def _about_proposals(
    objective: Objective, solutions: Sequence[Solution]
) -> tuple[list[Solution], list[Callable[[LocalProblem], Answers]]] | str:
    """Return the planes about their proposals, and how each answers to noise; or why nothing is proposed."""
    operator, options, first = objective.posed.operator, objective.options, solutions[0].record
    other_colours = objective.other_colours
    if len(operator.seeing_views) < MIN_VIEWS:
        return "too few views to hold some out"
    weight = first.penalty_weight or 0.0
    samples = operator.samples_of([solution.plane for solution in solutions])
    evidences = evidence_of_planes(operator, objective.posed.images, samples, other_colours=other_colours)
    regions = regions_of_planes(operator, samples, evidences)
    if contradiction := _contradiction(objective, samples, regions):
        return contradiction
    makers, no_network = _makers(options, evidences)
    candidates = CandidatesOfScales(makers)
    proposals = propose(
        objective.posed, samples, evidences, weight, candidates, other_colours=other_colours, regions=regions
    )
    if all(weights.get("tv") == 1 for proposal in proposals for weights in proposal.mixture.values()):
        return "total variation predicts held-out views best"
    proposed = operator.samples_of([proposal.picture for proposal in proposals])
    del evidences, regions
    if not options.uncertainty:
        proposals = [replace(proposal, source=None) for proposal in proposals]
    dual = replace(objective.posed.dual(), proposal=proposed)
    record, found = certified(objective, objective.positive(proposed), WEIGHT_ABOUT_PROPOSAL * weight, dual)
    record = with_weight_of(record, first)
    planes = zip(operator.planes_of(found), solutions, proposals, strict=True)
    return [
        _solution(plane, record, solution.sidecars, proposal, options, no_network)
        for plane, solution, proposal in planes
    ], [
        partial(ProposalAnswers, proposal=proposal, pilot=solution.plane)
        for solution, proposal in zip(solutions, proposals, strict=True)
    ]


def _makers(options: SolverOptions, evidences: Sequence[Evidence]) -> tuple[list[Candidates], str | None]:
    """Return what makes the candidates of each scale, and why the network makes none; None if it makes any."""
    makers: list[Candidates] = []
    reasons: list[str | None] = []
    for of_scale in zip(*map(scales, evidences), strict=False):
        if isinstance(options, CustomOptions) and options.denoiser is not None:
            makers.append(DenoiserCandidates(options.denoiser))
            continue
        if options.prior == "patches":
            makers.append(patch_candidates)
            continue
        why = (outside_range(evidence.pilot, evidence.noise) for evidence in of_scale)
        reasons.append(next((reason for reason in why if reason is not None), None))
        with_network = partial(_with_network, alone=options.prior == "learned")
        makers.append(patch_candidates if reasons[-1] else with_network)
    return makers, reasons[0] if all(reasons) and reasons else None


def _with_network(evidence: Evidence, names: Collection[str] | None = None, *, alone: bool) -> dict[str, Image]:
    """Return the candidates from patches and what the network makes of them; alone: only that and total variation's."""
    names = {"tv", "learned"} if alone else names
    found = patch_candidates(evidence, names)
    if names is not None and "learned" not in names:
        return found
    patches = (found["wiener"] + found["twice"]) / 2
    variance = evidence.noise.variance
    found["learned"] = learned_estimate(evidence.picture, evidence.pilot, patches, variance)
    return {name: found[name] for name in ("tv", "learned")} if alone else found


def _solution(
    plane: Image,
    record: SolveRecord,
    sidecars: dict[str, Image],
    proposal: PlaneProposal,
    options: SolverOptions,
    no_network: str | None,
) -> Solution:
    moved = np.zeros_like(plane)
    np.divide(plane - proposal.picture, proposal.sigma, out=moved, where=proposal.sigma > 0)
    seen = np.isfinite(proposal.sigma)
    rms = float(np.sqrt(np.mean(np.square(moved[seen], dtype=np.float64))))
    denoiser = options.denoiser if isinstance(options, CustomOptions) else None
    prior = PriorRecord(
        name=name_of(denoiser) if denoiser is not None else options.prior or "tv",
        mixture=proposal.mixture,
        moved_sigma=rms,
        penalty_weight=WEIGHT_ABOUT_PROPOSAL * (record.penalty_weight or 0.0),
        no_network=UNSET if no_network is None else no_network,
    )
    if options.proposal:
        sidecars = sidecars | {"proposal": proposal.picture, "moved": moved}
    return Solution(plane, structs.replace(record, prior=prior), sidecars)
