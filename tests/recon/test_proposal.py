"""The edges of a proposal, sample by sample, and its plane where no view sees."""

import numpy as np
import pytest

from faintfield.pipelines.reconstruction.penalised import Objective
from faintfield.pipelines.reconstruction.solutions import Settings
from faintfield.recon.likelihood.images import Image
from faintfield.recon.prior.evidence import Evidence, evidence_of_planes
from faintfield.recon.prior.proposal import propose
from faintfield.recon.solver.data_fit import SceneProblem
from tests.recon.test_cross_validation import dark_views
from tests.recon.test_cross_validation import scene as pieces


def pilot_alone(evidence: Evidence) -> dict[str, Image]:
    return {"tv": evidence.pilot}


def mean_of_nine(picture: Image) -> Image:
    """Return the mean of each sample and its neighbours, weighted by ¼, ½ and ¼ along both axes."""
    wide = np.pad(picture.astype(float), 1, "edge")
    found = np.zeros(picture.shape)
    for row in range(picture.shape[0]):
        for column in range(picture.shape[1]):
            found[row, column] = np.sum(wide[row : row + 3, column : column + 3] * np.outer([1, 2, 1], [1, 2, 1])) / 16
    return found


@pytest.mark.parametrize("light", [1.0, 40.0])
def test_edges_that_noise_cannot_explain_are_those_of_the_plane(light: float) -> None:
    plane = np.float32(light) * pieces(32)
    operator, images = dark_views(pieces(32), 2)
    problem = Objective.of(SceneProblem(operator, images), Settings()).posed
    (evidence,) = evidence_of_planes(operator, images, plane)
    unseen = np.zeros(plane.shape, bool)
    unseen[:3] = True
    variance = np.where(unseen, np.inf, evidence.noise.variance).astype(np.float32)
    evidence = evidence._replace(noise=evidence.noise._replace(variance=variance))
    (found,) = propose(problem, plane, [evidence], 1.0, pilot_alone)
    edges = plane - evidence.pilot
    share = mean_of_nine(edges**2) / (mean_of_nine(edges**2) + 0.1 * np.where(unseen, 1, variance))
    expected = np.where(unseen, plane, np.maximum(evidence.pilot + share * edges, 0))
    np.testing.assert_allclose(found.picture, expected, rtol=1e-3, atol=1e-4 * light)
    np.testing.assert_array_equal(found.again(evidence, plane), found.picture)
    blurred = np.abs(edges) > 0.05 * light
    kept = np.abs((found.picture - evidence.pilot)[blurred & ~unseen]) / np.abs(edges[blurred & ~unseen])
    assert np.median(kept) > 0.9 if light == 40 else np.median(kept) < 0.9
