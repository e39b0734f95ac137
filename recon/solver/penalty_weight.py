"""A penalty weight from the noise alone, or by cross-validation: that under which some views best predict the others.

Windows stand for a large plane.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.solver.custom_penalty import ProximalPenalty
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.solver.initialization import mean_light_e, well_seen_samples
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.pmlem import PmlemIterate, iterate_until, pmlem
from faintfield.recon.solver.proximal import DualField
from faintfield.recon.threads import map_in_threads

# Largest number of folds; each leaves out one view in as many.
MAX_FOLDS = 7

# Pixels that are predicted at least, by several folds if necessary: the score of fewer is mostly noise.
MIN_SCORED_PIXELS = 600_000

# Fewest views for a cross-validation: fewer leave too little to predict, or to predict from.
MIN_VIEWS = 4

# Ratio of successive candidates, and the most steps to either side of the first guess.
_CANDIDATE_RATIO, _MAX_STEPS = 2**0.5, 8

# Accuracy of candidates and limit on their passes: only the differences between them matter.
_TOLERANCE, _MAX_PASSES = 0.02, 4

# Side of a window in samples: what lies beyond its edges is unknown to it, so that it should not be small.
SIDE = 256

# The windows have so many samples together: the darkest scenes, of SNR 0.05, need that many to tell weights that are a
# quarter apart. A plane less than twice that large stands for itself.
WINDOW_SAMPLES = 2**20


@dataclass(frozen=True)
class CrossValidatedWeight:
    """The weight that predicts best.

    Attributes
    ----------
    weight : float
        β for all views: the minimum of a parabola through the best candidates.
    candidates : dict of float to float
        The weights that were tried, in ascending order, each with its loss: the negative log-likelihood of the
        validation views under the plane from the other views, summed over the folds.
    passes : float
        Passes over all the data that the search took; passes over some of the views count in proportion.
    solution : PmlemIterate, optional
        The best candidate's plane, from most of the views; None if only windows of the plane were reconstructed.
    """

    weight: float
    candidates: dict[float, float]
    passes: float
    solution: PmlemIterate | None


def universal_penalty_weight(operator: SceneOperator, images: ElementalImages, samples: Image) -> float:
    """Return a penalty weight from the noise alone: β = 0.7 √( s / (f + b + σ²) ).

    s is its median over the samples that are seen well, and f, b and σ² are means. The root is the standard deviation
    of the likelihood's gradient at each sample. The gradient of the penalty, eq. (3) of
    docs/explanation/physics.md, is of the order of one, so this weight removes fluctuations of about that size. It is a
    starting point, not the best weight for a scene.

    Parameters
    ----------
    operator : SceneOperator
        H, such as a `PlaneOperator`.
    images : ElementalImages
        The data, of which only the noise counts.
    samples : float array (samples)
        The light f in electrons, such as that of `smooth_start`.

    Returns
    -------
    float
        β in the unit of s = Hᵀ 1, for `pmlem`.

    Examples
    --------
    Samples of 2 e that three views with read noise of √12 e see:

    >>> import numpy as np
    >>> from faintfield import ElementalImages, Lens, PlaneGrid, PlaneOperator
    >>> from faintfield import fronto_parallel_rt_ref_plane, plane_from_ray, universal_penalty_weight
    >>> lens = Lens((32, 24), fx_px=40.0, fy_px=40.0, cx_px=15.5, cy_px=11.5)
    >>> poses_rt_cam_ref = np.array([[0.0, 0.0, 0.0, x_mm, 0.0, 0.0] for x_mm in (20.0, 0.0, -20.0)])
    >>> homographies = plane_from_ray(poses_rt_cam_ref, fronto_parallel_rt_ref_plane(depth_mm=400.0))
    >>> grid = PlaneGrid.covering(-160.0, -120.0, 160.0, 120.0, pitch_mm=10.0)
    >>> operator = PlaneOperator(homographies, lens.rays(), grid)
    >>> plane_e = np.full(grid.shape, 2.0)
    >>> images = ElementalImages(operator.forward(plane_e), read_variance_e2=12.0)
    >>> round(universal_penalty_weight(operator, images, plane_e), 3)  # 0.7 * (3 / (2 + 12)) ** 0.5
    0.324
    """
    sensitivity = operator.sensitivity()
    seen = well_seen_samples(sensitivity)
    # A pixel of a scene sees the light of all planes
    light_e = samples if len(operator.grids) == 1 else np.full_like(samples, mean_light_e(operator, samples))
    per_view_e = light_e[seen].mean() + np.mean(images.known_variance_e2())
    return float(0.7 * np.sqrt(np.median(sensitivity[seen]) / per_view_e))


def validation_views(views: int, fold: int = 0) -> NDArray[np.intp]:
    """Return the views that a fold leaves out: about one in seven; folds are disjoint.

    Each is three places further on in the next seven: on a grid of seven columns, one in each row and in each column.
    """
    folds = fold_count(views)
    index = np.arange(views)
    stride = 1 if folds % 3 == 0 else 3
    return np.flatnonzero(index % folds == (stride * (index // folds) + fold) % folds)


def fold_count(views: int) -> int:
    """Return the number of folds that so many views have."""
    return max(2, min(MAX_FOLDS, views // 2))


def cross_validated_weight(
    problem: SceneProblem, guess: float, penalty: Penalty | ProximalPenalty, level_e: float | None = None
) -> CrossValidatedWeight:
    """Return the penalty weight under which the training views best predict the validation views.

    Candidates are tried from larger to smaller weights, each starting from the last solution, until predictions have
    become worse on both sides of the best. Windows that are spread over it stand for a large plane.

    Parameters
    ----------
    problem, penalty : SceneProblem, Penalty or ProximalPenalty
        One plane, or several planes together, that at least `MIN_VIEWS` views see; φ.
    guess : float
        A weight to start from, for all views.
    level_e : float, optional
        Mean light of the samples that the views see, in electrons, for windows; by default that of each window.

    Notes
    -----
    The noise of the data's part of the objective grows as the root of the number of views, and so does the weight from
    the training views to all views.
    """
    samples = int(np.prod(problem.operator.samples_shape))
    windows = windows_of(problem, MIN_VIEWS, WINDOW_SAMPLES, workers=1)
    if windows:
        # A dark window is solved with the light of the whole plane, as that will be
        folds = map_in_threads(lambda window: Fold(window.problem, penalty, 0, level_e), windows)
    else:
        folds = [Fold(problem, penalty, number) for number in range(folds_to_predict(problem))]
    losses = _losses(folds, guess, apply=map_in_threads if windows else map)
    best = min(losses, key=losses.__getitem__)
    offset = _lowest_offset([losses.get(best + n) for n in (-1, 0, 1)])
    candidates = {guess * _CANDIDATE_RATIO**step: loss for step, loss in sorted(losses.items())}
    passes = sum(fold.passes * fold.samples for fold in folds) / float(samples)
    weight = guess * _CANDIDATE_RATIO ** (best + offset)
    return CrossValidatedWeight(weight, candidates, passes, None if windows else folds[0].solutions[best])


def folds_to_predict(problem: SceneProblem) -> int:
    """Return the number of folds that predict `MIN_SCORED_PIXELS`, or that of all."""
    count = len(problem.operator.seeing_views)
    pixels_per_fold = problem.images.electrons[0].size * count / fold_count(count)
    return min(int(np.ceil(MIN_SCORED_PIXELS / pixels_per_fold)), fold_count(count))


class Fold:
    """Training and validation views of a fold, and the solutions so far."""

    def __init__(
        self, problem: SceneProblem, penalty: Penalty | ProximalPenalty, fold: int, level_e: float | None = None
    ) -> None:
        views = problem.operator.seeing_views
        self.validation = views[validation_views(len(views), fold)]
        self.training = np.setdiff1d(views, self.validation)
        self._start = problem.start(self.training)
        self._fit = problem.fit(level_e or mean_light_e(problem.operator, self._start), self.training)
        self._problem, self._penalty = problem, penalty
        self._share = len(self.training) / len(views)
        self.samples = self._start.size
        self.passes = self._share
        self.solutions: dict[int, PmlemIterate] = {}

    def solve(self, weight: float, near: Image | None, dual: DualField) -> PmlemIterate:
        """Return the planes of the training views, given β for all views; `near` are nearby planes to start from."""
        start = self._start if near is None else np.maximum(near, 1e-3 * self._start)
        weight *= self._share**0.5
        iterates = pmlem(
            self._fit, start, penalty_weight=weight, penalty=self._penalty, tolerance=_TOLERANCE, dual=dual
        )
        return iterate_until(iterates, _TOLERANCE, _MAX_PASSES)

    def score(self, step: int, weight: float) -> float:
        """Return the loss of the candidate of a step, solved from its neighbour's solution."""
        near = self.solutions.get(step + 1) or self.solutions.get(step - 1)
        plane, dual = (None, self._problem.dual()) if near is None else (near.plane, near.dual.copy())
        solution = self.solutions[step] = self.solve(weight, plane, dual)
        self.passes += solution.passes * self._share + (1 - self._share)
        problem = self._problem
        return problem.operator.negative_log_likelihood(solution.plane, problem.images, self.validation)


def _losses(
    folds: list[Fold], guess: float, apply: Callable[[Callable[[Fold], float], Sequence[Fold]], Iterable[float]]
) -> dict[int, float]:
    """Return the loss of each candidate `guess · ratioⁿ` by n; `apply` scores all folds."""
    losses: dict[int, float] = {}

    def best() -> int:
        return min(losses, key=losses.__getitem__)

    def score(step: int) -> None:
        losses[step] = sum(apply(lambda fold: fold.score(step, guess * _CANDIDATE_RATIO**step), folds))
        # The next candidate starts from this one, or from the best if there is none beyond it
        for fold in folds:
            fold.solutions = {kept: fold.solutions[kept] for kept in {step, best()}}

    step = 1
    score(step)
    while step > -_MAX_STEPS and best() <= step:
        step -= 1
        score(step)
    step = max(losses)
    while step < _MAX_STEPS and best() == step:
        step += 1
        score(step)
    return losses


def _lowest_offset(losses: Sequence[float | None]) -> float:
    """Return where the parabola through losses at −1, 0 and 1 is lowest; 0 if one of them is missing."""
    before, here, after = losses
    if before is None or here is None or after is None or not before + after > 2 * here:
        return 0.0
    return float(np.clip(0.5 * (before - after) / (before - 2 * here + after), -0.5, 0.5))


class Window(NamedTuple):
    """A part of a plane: its problem, and its place in the plane."""

    problem: SceneProblem
    rows: slice
    columns: slice

    def of(self, plane: Image) -> Image:
        """Return the part of a plane (row, column)."""
        return plane[self.rows, self.columns]


def windows_of(problem: SceneProblem, min_views: int, samples: int, workers: int | None = None) -> list[Window]:
    """Return windows in rows and columns over a large plane, with so many samples together.

    There are none of planes less than twice that large, and of several planes. The windows share the images. Those that
    fewer than `min_views` see are left out. `workers` is the number of threads that solve one.
    """
    operator = problem.operator
    if not isinstance(operator, PlaneOperator):
        return []
    rows, columns = operator.grid.shape
    if rows * columns < 2 * samples or min(rows, columns) < 2 * SIDE:
        return []
    across = max(round((samples * columns / rows) ** 0.5 / SIDE), 1)
    down = max(round(samples / SIDE**2 / across), 1)
    windows, maps = [], dict[float, Image]()
    for row, column in np.ndindex(down, across):
        place = _middle(row, rows, down), _middle(column, columns, across)
        try:
            window = operator.window(*place, workers, maps)
        except GeometryMismatch:  # no view sees it
            continue
        if len(window.seeing_views) >= min_views:
            windows.append(Window(SceneProblem(window, problem.images), *place))
    return windows


def _middle(part: int, size: int, parts: int) -> slice:
    first = ((2 * part + 1) * size // parts - SIDE) // 2
    return slice(first, first + SIDE)
