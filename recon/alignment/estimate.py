"""The poses that explain the views best, given the light of other views: coarse to fine, with a test that they help."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from faintfield.recon.alignment.cameras import POSE, PosedViews, Poses, move_poses, steps_between
from faintfield.recon.alignment.light import Light
from faintfield.recon.alignment.prior import PosePrior
from faintfield.recon.alignment.score import Cells, Comparison, Score, compare, partial_scores, predictions, score


class _Level(NamedTuple):
    """Rounds with pictures in bins: blurs of the light in each, and whether variances are estimated.

    The depth is found in bins of `depth_bins` before the first round.
    """

    bins: int
    blurs: tuple[float, ...]
    depth_bins: int
    estimate_variances: bool


# Coarse to fine. Variances are left alone at first, when wrong poses look like noise.
_DEPTH_BINS = 2
_LEVELS = (
    _Level(4, (1.0, 0.5), _DEPTH_BINS, estimate_variances=False),
    _Level(2, (0.5,) * 4, _DEPTH_BINS, estimate_variances=True),
    _Level(1, (0.5,) * 3, _DEPTH_BINS, estimate_variances=True),
)

# The level for scenes so bright that the error of the depth is larger than that of the noise: the dispersion shows it.
_BRIGHT = _Level(1, (0.5,) * 3, 1, estimate_variances=True)
_BRIGHT_DISPERSION = 2.2

# Steps of the variances in each round; step relative to its standard deviation below which a level is done.
_VARIANCE_STEPS, _SMALL_STEP = 3, 0.15

# Share of the cells that are held out.
_HELD_OUT = 0.12

# Standard deviations of the relative focal length and of the first distortion term: of a lens that is to be found, and
# of one that is not, which the covariance counts. Unknown depths would explain a longer focal length as well.
_LENS_SIGMAS, _KNOWN_LENS_SIGMAS = np.array([0.02, 0.2]), np.array([1e-3, 2e-3])
_LENS_SIGMAS_AT_UNKNOWN_DEPTH = np.array([_KNOWN_LENS_SIGMAS[0], _LENS_SIGMAS[1]])

# Standard errors by which the gain on held-out pixels must exceed zero.
_SURE = 3.0


@dataclass(frozen=True)
class Gain:
    """Log-likelihood of held-out pixels at the new poses less that at the old ones.

    Attributes
    ----------
    value, sigma : float
        The gain and its standard error, by its scatter over patches of the scene.
    patches : int
        Number of patches.
    by_gradient : bool
        True if the value is the slope along a first step from the old poses, which tells small steps better: each part
        of the scene is held out once, and the step found from the others.
    """

    value: float
    sigma: float
    patches: int
    by_gradient: bool = False

    @classmethod
    def of(cls, compared: Comparison) -> "Gain":
        """Return the gain of a comparison.

        Its variance is the information, times the dispersion of patches about gains in proportion to theirs.
        """
        patches = compared.information > 0
        gain, information = compared.gain[patches], compared.information[patches]
        value, number = float(gain.sum()), len(gain)
        left = gain - information * (value / max(information.sum(), 1e-300))
        dispersion = max(1.0, float(np.sum(left**2 / information)) / max(number - 1, 1))
        return cls(value, float(np.sqrt(dispersion * information.sum())), number)

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
        Covariance of the steps to all poses but the reference's: a rotation in the frame of the camera, then t. If the
        lens was to be found, two numbers of its change follow.
    lens_change : (float, float)
        Relative change of the focal length, and change of the first distortion term.
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
    lens_change: tuple[float, float]
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
    lens: NDArray[np.float64]
    scene: NDArray[np.float64]
    scene_by_cameras: NDArray[np.float64]
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
        self._reference, self._light, self._lens = reference, light, np.zeros(posed.lens_parameters)
        self._others = np.delete(np.arange(len(posed.rt_cam_ref)), reference)
        self._start, self._first_prior = posed.rt_cam_ref, prior
        self._poses, self._prior = self._start.copy(), prior
        self._binned = {level.bins: posed.binned(level.bins) for level in _LEVELS}
        self._cells = Cells.of(posed.views.light_e.shape, _HELD_OUT)
        self.rounds: list[Round] = []

    @property
    def total(self) -> int:
        """Most rounds."""
        return sum(len(level.blurs) for level in (*_LEVELS, _BRIGHT)) + 1

    def run(self) -> Iterator[Round]:
        """Do all rounds, and yield each; then `result` is known."""
        self._light.find_depth(self._binned[_DEPTH_BINS].views)
        for level in (*_LEVELS, _BRIGHT):
            if level is _BRIGHT and not self._bright:
                break
            if level is not _LEVELS[0]:
                self._light.find_range(self._at(_DEPTH_BINS).views)
                self._light.find_depth(self._at(level.depth_bins).views)
            for blur in level.blurs:
                self._round(level.bins, blur, self._cells, estimate_variances=level.estimate_variances)
                yield self.rounds[-1]
                if self.rounds[-1].step < _SMALL_STEP:
                    break
        without_final = self._poses, self._lens
        solution, last = self._round(1, _LEVELS[-1].blurs[-1], self._cells.none_held_out(), final=True)
        yield self.rounds[-1]
        new_picture = self._light.picture()
        after, before = self._predictions(*without_final), self._predictions(self._start, np.zeros(0))
        old_picture, gain = self._light.picture(), Gain.of(compare(self._binned[1], self._light, before, after))
        if abs(gain.value) <= _SURE * gain.sigma:  # a sure loss is an answer, too
            slope = self._slope()
            gain = gain if slope is None or not slope.sure else slope
        self.result = Alignment(
            self._poses,
            solution.covariance,
            _lens_change(self._lens),
            self._prior,
            gain,
            last.dispersion,
            steps_between(self._start, self._poses),
            solution.steps,
            (old_picture, new_picture),
            self.rounds,
        )

    @property
    def _bright(self) -> bool:
        """True if errors of a depth that can be found are larger than those by the noise."""
        return self._light.smooth_depth and self.rounds[-1].dispersion > _BRIGHT_DISPERSION

    def _predictions(self, poses: Poses, lens: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the expected electrons of held-out pixels, with light and depth found afresh."""
        for bins, find in ((_DEPTH_BINS, self._light.find_depth), (1, partial(self._light.fit, afresh=True))):
            posed = self._binned[bins].at(poses, _lens_change(lens))
            find(posed.views)
        return predictions(posed, self._light, self._cells)

    def _slope(self) -> Gain | None:
        """Return the slope along a first step from the old poses, at their light; None if the whole step is no gain."""
        posed, dispersion = self._binned[1], self.rounds[-1].dispersion
        scores = partial_scores(posed, self._light)
        slopes, curvature = np.zeros(len(scores.part)), 0.0
        for part, information in enumerate(scores.information):
            others, error = scores.without(part, dispersion), np.zeros(POSE * len(self._others) + len(self._lens))
            solution = self._solve(others, error, self._first_prior, _VARIANCE_STEPS)
            shared = np.concatenate([solution.lens, solution.scene_by_cameras])
            step = np.hstack([solution.steps, np.broadcast_to(shared, (len(self._start), len(shared)))])
            patches = scores.part == part
            slopes[patches] = np.tensordot(scores.gradient[patches], step, 2)
            curvature += float(np.einsum("vi,vij,vj", step, information, step))
        value, sigma = float(slopes.sum()), float(np.sqrt(np.sum(slopes**2)))
        if value <= 0.5 * curvature:
            return None
        return Gain(value, sigma, int(np.count_nonzero(slopes)), by_gradient=True)

    def _at(self, bins: int) -> PosedViews:
        return self._binned[bins].at(self._poses, _lens_change(self._lens))

    def _round(
        self, bins: int, blur: float, cells: Cells, *, estimate_variances: bool = True, final: bool = False
    ) -> tuple[_Solution, Score]:
        posed = replace(self._at(bins), free_lens=final or len(self._lens) > 0)
        self._light.fit(posed.views, blur)
        precision = np.repeat([1 / self._prior.variances[0], 1 / self._prior.variances[1]], 3)
        scores = score(posed, self._light, cells, precision, bins)
        steps = _VARIANCE_STEPS if estimate_variances else 0
        error = np.concatenate([steps_between(self._start, self._poses)[self._others].ravel(), self._lens])
        solution = self._solve(scores, error, self._prior, steps)
        self._poses, self._prior = move_poses(self._poses, solution.steps), solution.prior
        self._lens = self._lens + solution.lens
        self._light.change_depth(solution.scene[POSE + scores.lens :])
        sigmas = np.sqrt(np.diag(solution.covariance)[: POSE * len(self._others)])
        step = float(np.sqrt(np.mean((solution.steps[self._others].ravel() / sigmas) ** 2)))
        self.rounds.append(Round(bins, step, scores.dispersion))
        return solution, scores

    def _solve(self, scores: Score, error: NDArray[np.float64], prior: PosePrior, variance_steps: int) -> _Solution:
        """Return the step of all poses and of the lens, without what changes of the scene explain as well.

        `error` are the steps so far (parameter,).
        """
        lens, free = scores.lens, len(self._lens)
        lens_sigmas = _LENS_SIGMAS_AT_UNKNOWN_DEPTH if self._light.smooth_depth else _LENS_SIGMAS
        of_scene = scores.information[:, POSE + lens :, POSE + lens :].sum(axis=0)
        scale = 1 / np.sqrt(np.maximum(np.diag(of_scene), 1e-300))
        inverse = np.outer(scale, scale) * np.linalg.pinv(of_scene * np.outer(scale, scale), rcond=1e-9, hermitian=True)
        by_scene = scores.gradient[:, POSE + lens :].sum(axis=0)
        information, cross, gradient = self._camera_equations(scores)
        information -= cross @ inverse @ cross.T
        gradient -= cross @ (inverse @ by_scene)
        of_poses, count = slice(0, POSE * len(self._others)), POSE * len(self._others) + free
        by_lens = information[:count, count:]
        information, cross, gradient = information[:count, :count], cross[:count], gradient[:count]
        for left in reversed(range(variance_steps + 1)):
            precision = block_diag(prior.precision(), np.diag(lens_sigmas[:free] ** -2.0))
            covariance = np.linalg.inv(information + precision)
            step = covariance @ (gradient - precision @ error)
            if left:
                prior = prior.updated((error + step)[of_poses], covariance[of_poses, of_poses])
        steps = np.zeros_like(self._start)
        steps[self._others] = step[of_poses].reshape(-1, POSE)
        by_cameras = -inverse @ (cross.T @ step)
        of_lens, turned = step[of_poses.stop :], covariance @ by_lens * _KNOWN_LENS_SIGMAS[: by_lens.shape[1]]
        covariance += turned @ turned.T
        return _Solution(steps, covariance, of_lens, inverse @ by_scene + by_cameras, by_cameras, prior)

    def _camera_equations(self, scores: Score) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the information of poses and lens, what they share with that of the scene, and their gradient.

        The reference's pose has none.
        """
        lens = slice(POSE, POSE + scores.lens)
        scene = slice(lens.stop, None)
        of_views = scores.information[self._others]
        poses = block_diag(*of_views[:, :POSE, :POSE])
        between = of_views[:, :POSE, lens].reshape(len(poses), -1)
        of_lens = scores.information[:, lens, lens].sum(axis=0)
        cross = of_views[:, :POSE, scene].reshape(len(poses), -1), scores.information[:, lens, scene].sum(axis=0)
        gradient = scores.gradient[self._others, :POSE].ravel(), scores.gradient[:, lens].sum(axis=0)
        return np.block([[poses, between], [between.T, of_lens]]), np.concatenate(cross), np.concatenate(gradient)


def _lens_change(lens: NDArray[np.float64]) -> tuple[float, float]:
    return (float(lens[0]), float(lens[1])) if len(lens) else (0.0, 0.0)
