"""The poses that explain the views best, given the light of other views: coarse to fine, with a test that they help."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.alignment.cameras import POSE, PosedViews, Poses, moved, steps_between
from faintfield.recon.alignment.light import Light
from faintfield.recon.alignment.prior import PosePrior
from faintfield.recon.alignment.score import Cells, Score, log_likelihood, score


class _Level(NamedTuple):
    """Rounds with pictures in bins: blurs of the light in each, and whether variances are estimated.

    The depth is found in bins of `depth_bins` before the first round.
    """

    bins: int
    blurs: tuple[float, ...]
    estimate_variances: bool


# Coarse to fine. Variances are left alone at first, when wrong poses look like noise.
_LEVELS = (
    _Level(4, (1.0, 0.5), estimate_variances=False),
    _Level(2, (0.5,) * 4, estimate_variances=True),
    _Level(1, (0.5,) * 3, estimate_variances=True),
)
_DEPTH_BINS = 2

# Steps of the variances in each round; step relative to its standard deviation below which a level is done.
_VARIANCE_STEPS, _SMALL_STEP = 3, 0.15

# Share of the cells that are held out.
_HELD_OUT = 0.12

# Standard errors by which the gain on held-out pixels must exceed zero.
_SURE = 3.0


@dataclass(frozen=True)
class Gain:
    """Log-likelihood of held-out pixels at the new poses less that at the old ones.

    Attributes
    ----------
    value, sigma : float
        The gain and its standard error, by its scatter over cells.
    cells : int
        Number of cells that were held out.
    """

    value: float
    sigma: float
    cells: int

    @property
    def sure(self) -> bool:
        """True if the gain is beyond chance."""
        return self.value > _SURE * self.sigma


@dataclass(frozen=True)
class Round:
    """One round of light and poses: width of the bins, and the step relative to its standard deviation, rms."""

    bins: int
    step: float
    dispersion: float


@dataclass(frozen=True)
class Alignment:
    """Poses by the views.

    Attributes
    ----------
    rt_cam_ref : float array (view, 6)
        The new poses, Rodrigues rad and mm.
    covariance : float array (parameter, parameter)
        Covariance of the steps to all poses but the reference's: a rotation in the frame of the camera, then t.
    prior : PosePrior
        The errors of the old poses, as they were estimated.
    gain : Gain
        How much better held-out pixels are predicted.
    dispersion : float
        Variance of the gradient relative to what the noise explains; the covariance counts it.
    steps, last_steps : float array (view, 6)
        Steps from the old poses to the new ones, and those of the last round: what the new poses may still lack.
    pictures : tuple of float32 array (row, column)
        The light by the old and by the new poses.
    rounds : list of Round
        All rounds.
    """

    rt_cam_ref: Poses
    covariance: NDArray[np.float64]
    prior: PosePrior
    gain: Gain
    dispersion: float
    steps: Poses
    last_steps: Poses
    pictures: tuple[NDArray[np.float32], NDArray[np.float32]]
    rounds: list[Round]


class _Solution(NamedTuple):
    steps: Poses
    covariance: NDArray[np.float64]
    scene: NDArray[np.float64]
    prior: PosePrior


class Aligner:
    """Finds poses by the views; the reference view's stays as it is.

    Each round finds the light of each fold from the views of the others, and takes a step of all poses by Gauss–Newton.
    Changes of the scene that all views share are solved for beside the poses, so that poses do not count as known
    what light or depth could explain as well.

    Parameters
    ----------
    posed : PosedViews
        The views at their old poses, in the finest bins.
    reference : int
        The reference view.
    prior : PosePrior
        The errors of the old poses.
    light : Light
        The scene.
    """

    def __init__(self, posed: PosedViews, reference: int, prior: PosePrior, light: Light) -> None:
        self._posed, self._reference, self._light = posed, reference, light
        self._others = np.delete(np.arange(len(posed.rt_cam_ref)), reference)
        self._start, self._poses, self._prior = posed.rt_cam_ref, posed.rt_cam_ref.copy(), prior
        self._binned = {level.bins: posed.binned(level.bins) for level in _LEVELS}
        self._cells = Cells.of(posed.views.light_e.shape, _HELD_OUT)
        self.rounds: list[Round] = []

    @property
    def total(self) -> int:
        """Most rounds."""
        return sum(len(level.blurs) for level in _LEVELS) + 1

    def run(self) -> Iterator[Round]:
        """Do all rounds, and yield each; then `result` is known."""
        self._light.find_depth(self._binned[_DEPTH_BINS].views)
        finest = self._binned[1]
        self._light.fit(finest.views, afresh=True)
        before = log_likelihood(finest, self._light, self._cells)
        picture = self._light.picture()
        for level in _LEVELS:
            if level is not _LEVELS[0]:
                self._light.find_depth(self._at(_DEPTH_BINS).views)
            for blur in level.blurs:
                self._round(level.bins, blur, self._cells, estimate_variances=level.estimate_variances)
                yield self.rounds[-1]
                if self.rounds[-1].step < _SMALL_STEP:
                    break
        self._light.find_depth(self._at(_DEPTH_BINS).views)  # as at first: a depth that was adapted would be better
        self._light.fit(self._at(1).views, afresh=True)
        after = log_likelihood(self._at(1), self._light, self._cells)
        gain = self._gain(np.nan_to_num(after - before))
        solution, last = self._round(1, _LEVELS[-1].blurs[-1], self._cells.none_held_out(), estimate_variances=True)
        yield self.rounds[-1]
        self.result = Alignment(
            self._poses,
            solution.covariance,
            self._prior,
            gain,
            last.dispersion,
            steps_between(self._start, self._poses),
            solution.steps,
            (picture, self._light.picture()),
            self.rounds,
        )

    def _gain(self, difference: NDArray[np.float32]) -> Gain:
        """Return the gain, given the difference of log-likelihood of each pixel."""
        of_cells = self._cells.sums(difference, 1)
        return Gain(float(of_cells.sum()), float(np.sqrt(np.sum(of_cells**2))), int(np.count_nonzero(of_cells)))

    def _at(self, bins: int) -> PosedViews:
        return self._binned[bins].at(self._poses)

    def _round(self, bins: int, blur: float, cells: Cells, *, estimate_variances: bool) -> tuple[_Solution, Score]:
        posed = self._at(bins)
        self._light.fit(posed.views, blur)
        precision = np.repeat([1 / self._prior.variances[0], 1 / self._prior.variances[1]], 3)
        scores = score(posed, self._light, cells, precision, bins)
        solution = self._solved(scores, _VARIANCE_STEPS if estimate_variances else 0)
        self._poses, self._prior = moved(self._poses, solution.steps), solution.prior
        self._light.change_depth(solution.scene[POSE:])
        sigmas = np.sqrt(np.diag(solution.covariance))
        step = float(np.sqrt(np.mean((solution.steps[self._others].ravel() / sigmas) ** 2)))
        self.rounds.append(Round(bins, step, scores.dispersion))
        return solution, scores

    def _solved(self, scores: Score, variance_steps: int) -> _Solution:
        """Return the step of all poses, without what changes of the scene explain as well."""
        of_scene = scores.information[:, POSE:, POSE:].sum(axis=0)
        scale = 1 / np.sqrt(np.maximum(np.diag(of_scene), 1e-300))
        inverse = np.outer(scale, scale) * np.linalg.pinv(of_scene * np.outer(scale, scale), rcond=1e-9, hermitian=True)
        cross = scores.information[self._others, :POSE, POSE:].reshape(-1, len(of_scene))
        information = -cross @ inverse @ cross.T
        for number, view in enumerate(self._others):
            part = slice(POSE * number, POSE * (number + 1))
            information[part, part] += scores.information[view, :POSE, :POSE]
        by_scene = scores.gradient[:, POSE:].sum(axis=0)
        gradient = scores.gradient[self._others, :POSE].ravel() - cross @ (inverse @ by_scene)
        error = steps_between(self._start, self._poses)[self._others].ravel()
        prior = self._prior
        for left in reversed(range(variance_steps + 1)):
            precision = prior.precision()
            covariance = np.linalg.inv(information + precision)
            step = covariance @ (gradient - precision @ error)
            if left:
                prior = prior.updated(error + step, covariance)
        steps = np.zeros_like(self._poses)
        steps[self._others] = step.reshape(-1, POSE)
        return _Solution(steps, covariance, inverse @ (by_scene - cross.T @ step), prior)
