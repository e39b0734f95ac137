"""The weight chosen by cross-validation, against the best weight for the truth; windows of large planes."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image, PixelLikelihood
from faintfield.recon.solver import penalty_weight
from faintfield.recon.solver.data_fit import DataFit, SceneProblem
from faintfield.recon.solver.initialization import smooth_start
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.penalty_weight import cross_validated_weight, universal_penalty_weight, validation_views
from faintfield.recon.solver.pmlem import pmlem
from tests.recon.displaced import dark_views, pieces, run_until, views_displaced_by


@pytest.mark.parametrize("views", [4, 13, 50])
def test_folds_are_disjoint_and_cover_all_views(views: int) -> None:
    count = max(2, min(7, views // 2))
    folds = [validation_views(views, fold) for fold in range(count)]
    assert sorted(np.concatenate(folds).tolist()) == list(range(views))
    assert all(0.5 <= len(fold) * count / views <= 2 for fold in folds)


def test_fold_of_square_grid_covers_rows_and_columns() -> None:
    for fold in range(7):
        rows, columns = np.divmod(validation_views(49, fold), 7)
        assert sorted(rows.tolist()) == sorted(columns.tolist()) == list(range(7))


def test_weight_is_nearly_the_best_for_the_truth() -> None:
    truth = pieces(72)
    operator, images = dark_views(truth, 1)
    start = smooth_start(operator, images)
    guess = universal_penalty_weight(operator, images, start)
    fit = DataFit(operator, images, float(start.mean()))

    def error(weight: float) -> float:
        plane = run_until(pmlem(fit, start, penalty_weight=weight), 0.01, 10).plane
        return float(np.mean((plane - truth)[8:-8, 8:-8] ** 2))

    chosen = cross_validated_weight(SceneProblem(operator, images), guess / 3, Penalty())  # a poor guess
    best = min(error(guess * 2 ** (step / 2)) for step in range(-3, 4))
    assert error(chosen.weight) <= 1.1 * best
    scores = chosen.candidates
    assert min(scores) < chosen.weight < max(scores)
    assert min(scores.values()) < min(scores[min(scores)], scores[max(scores)])
    assert chosen.passes < 60 * 7  # seven folds, because these views have few pixels
    # The weight is the lowest point of the parabola through the best candidate and its neighbours, in steps of √2. The
    # search went a step down from its first, where predictions became worse, and then up to one beyond the best.
    weights = list(scores)
    middle = int(np.argmin(list(scores.values())))
    a, b, _ = np.polyfit([-1, 0, 1], [scores[weight] for weight in weights[middle - 1 : middle + 2]], 2)
    assert chosen.weight == pytest.approx(weights[middle] * 2 ** (-b / (4 * a)), rel=1e-6)
    assert weights[0] == pytest.approx(guess / 3)
    assert middle == len(weights) - 2


def test_windows_choose_nearly_the_weight_of_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = np.tile(pieces(64), (2, 2))
    operator, images = dark_views(truth, 3)
    problem = SceneProblem(operator, images)
    guess = universal_penalty_weight(operator, images, smooth_start(operator, images))
    whole = cross_validated_weight(problem, guess, Penalty())
    monkeypatch.setattr(penalty_weight, "SIDE", 32)
    monkeypatch.setattr(penalty_weight, "WINDOW_SAMPLES", 4_096)
    parts = cross_validated_weight(problem, guess, Penalty(), level_e=float(truth.mean()))
    assert whole.solution is not None
    assert parts.solution is None
    assert parts.passes < 0.4 * whole.passes
    assert parts.weight == pytest.approx(whole.weight, rel=0.25)
    # The loss is that of the windows' pixels: a quarter of the whole
    assert max(parts.candidates.values()) < 0.5 * max(whole.candidates.values())


def test_candidates_scale_penalty_by_share_of_training_views() -> None:
    """Two halves without noise: under a penalty each level moves by (length of the edge)/(weight of the half).

    Two of four views are held out at a time, so a weight β for four views is β/√2 for two.
    """
    rows, left, right, variance_e2, views = 16, 5, 15, 4.0, 4
    truth = np.repeat([2.0, 8.0], [left, right]) * np.ones((rows, 1))
    operator = views_displaced_by(np.zeros((views, 2)), (rows, left + right), margin=0)
    images = ElementalImages(
        np.stack([truth.astype(np.float32)] * views), 0.0, 1.0, likelihood=PixelLikelihood("least-squares", level_e=3.0)
    )
    guess = 4.0
    chosen = cross_validated_weight(SceneProblem(operator, images), guess, Penalty())
    large = {weight: loss for weight, loss in chosen.candidates.items() if weight >= guess}
    assert len(large) >= 2
    for weight, loss in large.items():
        trained = weight / np.sqrt(2)
        moved = np.repeat([trained / left, trained / right], [left, right]) * variance_e2 / 2
        assert loss == pytest.approx(views * rows * np.sum(moved**2) / (2 * variance_e2), rel=0.2)


def test_views_that_see_nothing_are_left_out() -> None:
    aside = np.zeros((49, 2))
    aside[:, 1] = np.where(np.arange(49) % 7 == 3, 0.5, 1000.0)
    posed = SceneProblem(views_displaced_by(aside, (24, 24), margin=0), dark_views(pieces(24), 1)[1])
    assert posed.operator.seeing_views.tolist() == list(range(3, 49, 7))
    assert np.isfinite(list(cross_validated_weight(posed, 1.0, Penalty()).candidates.values())).all()


def test_candidate_ends_when_solver_cannot_descend(monkeypatch: pytest.MonkeyPatch) -> None:
    operator, images = dark_views(pieces(24), 1)
    true = DataFit.value_and_gradient

    def misled(fit: DataFit, plane: Image) -> tuple[float, Image]:
        value, gradient = true(fit, plane)
        return value, -gradient

    monkeypatch.setattr(DataFit, "value_and_gradient", misled)
    assert cross_validated_weight(SceneProblem(operator, images), 1.0, Penalty()).candidates


FEW_SAMPLES = np.linspace(-3, 3, 9)


def problem_of(shape: tuple[int, int], right: NDArray[np.float64] = FEW_SAMPLES) -> SceneProblem:
    """Return nine views, displaced along the rows, that each see all of a plane but a few samples."""
    operator = views_displaced_by(np.stack([0 * right, right], axis=1), shape, margin=0)
    return SceneProblem(operator, ElementalImages(np.ones((9, *shape), np.float32)))


@pytest.fixture
def small_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(penalty_weight, "SIDE", 8)
    monkeypatch.setattr(penalty_weight, "WINDOW_SAMPLES", 8 * 8 * 6)


@pytest.mark.usefixtures("small_windows")
def test_windows_are_spread_and_do_not_meet() -> None:
    problem = problem_of((64, 96))
    used = np.zeros((64, 96), int)
    places = np.arange(64.0 * 96).reshape(64, 96)
    for window in penalty_weight.windows_of(problem, 4, 8 * 8 * 6):
        column, row = np.array(window.problem.operator.grids[0].origin_mm).astype(int)
        assert window.problem.operator.grids[0].shape == (8, 8)
        np.testing.assert_array_equal(window.of(places), places[row : row + 8, column : column + 8])
        assert window.problem.images is problem.images
        used[row : row + 8, column : column + 8] += 1
    assert used.max() == 1
    assert 1 / 16 <= used.mean() <= 1.3 / 16
    assert used.reshape(2, 32, 3, 32).any(axis=(1, 3)).all()
    # All four edges are equally far
    rows, columns = np.flatnonzero(used.any(axis=1)), np.flatnonzero(used.any(axis=0))
    assert abs(rows[0] - (63 - rows[-1])) <= 1
    assert abs(columns[0] - (95 - columns[-1])) <= 1


@pytest.mark.usefixtures("small_windows")
@pytest.mark.parametrize(("shape", "least"), [((64, 11), 0), ((19, 20), 0), ((2000, 16), 11), ((16, 2000), 11)])
def test_only_large_planes_have_windows(shape: tuple[int, int], least: int) -> None:
    count = len(penalty_weight.windows_of(problem_of(shape), 4, max(8 * 8 * 6, shape[0] * shape[1] // 16)))
    assert count >= least
    assert (count == 0) == (least == 0)


@pytest.mark.usefixtures("small_windows")
def test_windows_with_few_views_are_left_out() -> None:
    shifts = np.where(np.arange(9) < 6, 60.0, FEW_SAMPLES)  # six of nine views see only the right
    windows = penalty_weight.windows_of(problem_of((64, 96), shifts), 4, 8 * 8 * 6)
    columns = [window.problem.operator.grids[0].origin_mm[0] for window in windows]
    assert columns
    assert min(columns) >= 60
