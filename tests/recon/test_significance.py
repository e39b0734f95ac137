"""The test of shuffled views, against sums by hand and on views that mean nothing."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.recon.depth.significance import disagreement, significance

VIEWS = 6


def _by_hand(
    light_e: NDArray[np.floating], seen: NDArray[np.bool_], places: NDArray[np.intp], known_variance_e2: float
) -> float:
    """The definition, one sample and depth after the other, in float64."""
    least = []
    for sample in range(light_e.shape[3]):
        reduced = []
        for depth in range(light_e.shape[2]):
            values = [
                float(light_e[place, view, depth, sample])
                for view, place in enumerate(places)
                if seen[place, depth, sample]
            ]
            if len(values) < max(0.3 * len(places), 2):
                continue
            mean = sum(values) / len(values)
            level = max(mean, 0.0)
            variance = level + known_variance_e2 + (0.04 * level) ** 2
            reduced.append(sum(min((value - mean) ** 2 / variance, 16.0) for value in values) / (len(values) - 1))
        if reduced:
            least.append(min(reduced))
    return sum(least) / len(least) if least else float("inf")


def _everywhere(depths: int, samples: int) -> NDArray[np.bool_]:
    return np.ones((VIEWS, depths, samples), bool)


@pytest.mark.parametrize("seed", range(2))
def test_disagreement_is_the_sum_by_hand(seed: int) -> None:
    random = np.random.default_rng(seed)
    light_e = random.poisson(random.uniform(0, 40, (VIEWS, 1, 4, 7)), (VIEWS, VIEWS, 4, 7)).astype(np.float32) - 3
    seen = random.random((VIEWS, 4, 7)) < 0.5
    seen[:, :, 6] = False
    places = random.permutation(VIEWS)
    assert disagreement(light_e, seen, places, 2.5) == pytest.approx(_by_hand(light_e, seen, places, 2.5), rel=1e-4)


def test_each_view_is_taken_from_its_own_place() -> None:
    # View v shows v from place p, plus 10 if the place is not the one with the same number
    light_e = np.full((VIEWS, VIEWS, 1, 1), 100.0, np.float32)
    for view in range(VIEWS):
        light_e[view, (view + 1) % VIEWS] = 130.0
    own = np.arange(VIEWS)
    turned = np.roll(own, 1)  # view v from place v - 1
    assert disagreement(light_e, _everywhere(1, 1), own, 0.0) == 0
    assert disagreement(light_e, _everywhere(1, 1), turned, 0.0) == 0  # all 130: they agree, too
    turned[[0, 1]] = own[[0, 1]]
    assert disagreement(light_e, _everywhere(1, 1), turned, 0.0) > 1


def test_views_that_see_nothing_together_disagree_without_limit() -> None:
    light_e = np.ones((VIEWS, VIEWS, 2, 3), np.float32)
    assert disagreement(light_e, np.zeros((VIEWS, 2, 3), bool), np.arange(VIEWS), 1.0) == float("inf")


@pytest.mark.parametrize(
    ("stated", "shuffled", "p_value"),
    [
        (1.0, [1.0] * 99, 1.0),  # one picture copied
        (1.0, [1.0 + 1e-7, 2.0, 3.0], 0.5),  # the same sum in another order
        (2.0, [1.0, 3.0, 4.0, 5.0], 0.4),
        (float("inf"), [1.0, 2.0, float("inf")], 1.0),  # views that see nothing together
    ],
)
def test_p_is_the_share_that_agrees_as_well(stated: float, shuffled: list[float], p_value: float) -> None:
    found = significance(stated, shuffled)
    assert found.p_value == pytest.approx(p_value)
    assert found.shuffles == len(shuffled)


def test_z_counts_standard_deviations_below_the_mean() -> None:
    assert significance(1.0, [2.0, 4.0]).z == pytest.approx(2.0)
    assert significance(5.0, [2.0, 4.0]).z == pytest.approx(-2.0)
    assert significance(1.0, [2.0, 4.0, float("inf")]).z == pytest.approx(2.0)
    assert significance(float("inf"), [2.0, 4.0]).z == 0


def _p_value(light_e: NDArray[np.float32], seed: int, shuffles: int) -> float:
    random, seen = np.random.default_rng(seed), _everywhere(*light_e.shape[2:])
    stated = disagreement(light_e, seen, np.arange(VIEWS), 4.0)
    return significance(
        stated, [disagreement(light_e, seen, random.permutation(VIEWS), 4.0) for _ in range(shuffles)]
    ).p_value


def test_of_views_that_mean_nothing_no_more_pass_than_is_stated() -> None:
    # 300 sets of noise; p of 19 shuffles is 0.05 or less in 15 of them on average, 4 sigma of this are 15
    passed = 0
    for seed in range(300):
        light_e = np.random.default_rng([seed, 1]).poisson(20, (VIEWS, VIEWS, 5, 12)).astype(np.float32)
        passed += _p_value(light_e, seed, 19) <= 0.05
    assert 3 <= passed <= 30


def test_views_that_agree_where_they_are_pass() -> None:
    for seed in range(10):
        random = np.random.default_rng([seed, 2])
        light_e = random.poisson(20, (VIEWS, VIEWS, 5, 12)).astype(np.float32)
        light_e[np.arange(VIEWS), np.arange(VIEWS), 2] = 20.0
        assert _p_value(light_e, seed, 99) <= 0.02
