"""False proposals: the data shrink details that they contradict, and bring back those that they show.

Scenes with a lit square, a thin line and a texture. The proposals are the truth, as blurred as a back-projection, with
a line or a letter that is not there, or without one that is.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.metrics import signal_scale_for_snr
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.prior.evidence import evidence_of_planes
from faintfield.recon.prior.proposal import WEIGHT_ABOUT_PROPOSAL
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.solver.initialization import mean_light_e
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.penalty_weight import cross_validated_weight, universal_penalty_weight
from faintfield.recon.solver.pmlem import pmlem
from tests.recon.displaced import noisy_images, run_until, views_displaced_by

SHAPE, VIEWS = (72, 88), 49
LIT = np.s_[8:64, 8:80]
BACKGROUND_E, VARIANCE_E2 = 0.3, 9.0
CALM = np.s_[36:60, 12:76]  # where structures are, beside which nothing changes


def line() -> Image:
    """Two samples wide and thirty long."""
    structure = np.zeros(SHAPE, np.float32)
    structure[47:49, 30:60] = 1
    return structure


def letter() -> Image:
    """An E twenty samples high."""
    structure = np.zeros(SHAPE, np.uint8)
    cv2.putText(structure, "E", (36, 58), cv2.FONT_HERSHEY_SIMPLEX, 0.95, (1,), 2)
    return structure.astype(np.float32)


@dataclass(frozen=True)
class Scene:
    """A scene without structures, and how dark it is."""

    truth: Image
    operator: PlaneOperator
    sigma: float
    weight: float


@cache
def scene(snr: float) -> Scene:
    """The scene, the deviation of its back-projection, and the penalty weight chosen by held-out views."""
    light_e = signal_scale_for_snr(np.ones(1), snr, BACKGROUND_E, VARIANCE_E2**0.5)
    truth = np.full(SHAPE, 0.05 * light_e, np.float32)
    truth[LIT] = light_e
    row, column = np.indices((16, 30))
    truth[12:28, 44:74] *= (1 + 0.4 * np.sin(row) * np.sin(column)).astype(np.float32)
    truth[14:30, 20] *= 3
    operator = views_displaced_by(np.random.default_rng(1).uniform(-0.5, 0.5, (VIEWS, 2)), SHAPE)
    images = noisy_images(operator, truth, BACKGROUND_E, VARIANCE_E2, 0)
    (evidence,) = evidence_of_planes(operator, images, truth)
    guess = universal_penalty_weight(operator, images, truth)
    weight = cross_validated_weight(SceneProblem(operator, images), guess, Penalty()).weight
    return Scene(truth, operator, float(np.sqrt(np.median(evidence.noise.variance[LIT]))), weight)


def as_blurred(operator: PlaneOperator, plane: Image) -> Image:
    return operator.adjoint_of_forward(plane) / operator.coverage()


def vetoed(of: Scene, images: ElementalImages, proposal: Image) -> Image:
    """The optimum of the likelihood and the variation about a proposal, as certified as that of `reconstruct`."""
    problem = SceneProblem(of.operator, images)
    start = problem.start()
    iterates = pmlem(
        problem.fit(mean_light_e(of.operator, start)),
        np.maximum(proposal, 1e-3 * start),
        penalty_weight=WEIGHT_ABOUT_PROPOSAL * of.weight,
        dual=replace(problem.dual(), proposal=proposal),
    )
    return run_until(iterates, 0.01, 30).plane


def along(change: NDArray[np.floating], structure: Image) -> float:
    """The amplitude of a structure in a picture, beside its surroundings, by least squares."""
    part, change = structure[CALM] - structure[CALM].mean(), change[CALM]
    return float(np.vdot(part, change) / np.vdot(part, part))


def share_left(snr: float, structure: Image, amplitude: float, seed: int, *, missing: bool = False) -> float:
    """The false part of the certified plane along a structure, relative to that of the proposal."""
    of = scene(snr)
    false = np.float32(amplitude * of.sigma) * structure
    truth = of.truth + false if missing else of.truth
    images = noisy_images(of.operator, truth, BACKGROUND_E, VARIANCE_E2, 100 + seed)
    blurred = as_blurred(of.operator, of.truth)
    proposal = blurred if missing else blurred + false
    result = vetoed(of, images, proposal)
    return along(result - truth, structure) / along(proposal - truth, structure)


SEEDS = range(3)


@pytest.mark.parametrize(
    ("snr", "structure", "amplitude", "most", "missing"),
    [
        (0.16, line, 3, 0.75, False),
        (0.16, letter, 10, 0.2, True),
        (0.16, line, 10, 0.3, True),
        (1.0, letter, 1, 0.85, False),
        (1.0, letter, 3, 0.5, True),
    ],
)
def test_data_shrink_false_structures(
    snr: float, structure: Callable[[], Image], amplitude: float, most: float, missing: bool
) -> None:
    """In units of the back-projection's noise; relative to the false part of the proposal."""
    left = [share_left(snr, structure(), amplitude, seed, missing=missing) for seed in SEEDS]
    assert 0 < np.mean(left) < most


@pytest.mark.parametrize(("snr", "most"), [(0.16, 0.2), (1.0, 0.4)])
def test_true_proposal_hardly_moves(snr: float, most: float) -> None:
    """At the higher signal it moves more, since the truth is not blurred as the proposal is."""
    of = scene(snr)
    proposal = as_blurred(of.operator, of.truth)
    for seed in SEEDS:
        result = vetoed(of, noisy_images(of.operator, of.truth, BACKGROUND_E, VARIANCE_E2, 100 + seed), proposal)
        assert np.sqrt(np.mean(np.square(result - proposal))) < most * of.sigma


def test_proposal_decides_invisible_structures() -> None:
    """A falsehood of a tenth of the noise stays: the record says that the data did not object, not that it is true."""
    assert share_left(0.16, line(), 0.1, 0) > 0.5
