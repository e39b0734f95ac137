"""Response of a plane by a prior to noise in the data, which gives its standard deviation."""

from dataclasses import replace

import numpy as np

from faintfield.recon.likelihood.images import Image
from faintfield.recon.prior.proposal import PlaneProposal
from faintfield.recon.solver.proximal import DualField
from faintfield.recon.solver.uncertainty import Expected, LocalProblem, UsualErrors, Weights


class ProposalAnswers:
    """The answers of the certified optimum about a proposal.

    For each change of the data total variation's plane, the proposal from it, by the same mixture, and the optimum
    about that are found again, on the quadratic that L is near the optimum: no pass over the data.

    Parameters
    ----------
    problem : LocalProblem
        What the views say near the optimum about the proposal.
    proposal : PlaneProposal
        The proposal.
    pilot : float array (row, column)
        Total variation's plane, in electrons.
    """

    # A filter that is told the noise of its data answers to more of it as to a picture: the noise added is small.
    # Chosen on the scenes of `CHOSEN_ON` in benchmarks/uncertainty.py.
    usual = UsualErrors(0.2, Expected(1.7, 1.7, 1.0), Expected(0.7, 0.7, 0.4), Weights(0.5, 0.2, 0.1, 0.6))

    def __init__(self, problem: LocalProblem, proposal: PlaneProposal, pilot: Image) -> None:
        self.problem, self._proposal = problem, proposal
        shapes, kind = [pilot.shape], np.dtype(np.float32)
        self._pilot_dual, self._dual = DualField.zero(shapes, kind), DualField.zero(shapes, kind)
        self._pilot = problem.optimum(None, np.asarray(pilot, np.float32), self._pilot_dual)
        self._dual = replace(self._dual, proposal=np.asarray(proposal.picture, np.float32))
        self._optimum = problem.optimum(None, problem.plane, self._dual)

    def __call__(self, change: Image) -> Image:
        """Return by how much the optimum changes if −∇L changes."""
        problem, evidence = self.problem, self._proposal.evidence
        plane = problem.optimum(change, self._pilot, self._pilot_dual.copy())
        seen = np.isfinite(evidence.noise.variance)
        picture = evidence.picture + np.where(seen, change / problem.local.metric, 0).astype(np.float32)
        pilot = evidence.pilot + np.where(seen, problem.as_seen(plane - self._pilot), 0).astype(np.float32)
        proposed = self._proposal.again(evidence._replace(picture=picture, pilot=pilot), plane)
        dual = replace(self._dual.copy(), proposal=proposed)
        return problem.optimum(change, self._optimum, dual) - self._optimum
