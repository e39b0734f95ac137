"""The test of shuffled views, against sums by hand and on views that mean nothing."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.recon.depth.agreement import disagreement, significance

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


@pytest.mark.parametrize("seed", range(2))
def test_disagreement_is_the_sum_by_hand(seed: int) -> None:
    random = np.random.default_rng(seed)
    light_e = random.poisson(random.uniform(0, 40, (VIEWS, 1, 4, 7)), (VIEWS, VIEWS, 4, 7)).astype(np.float32) - 3
    seen = random.random((VIEWS, 4, 7)) < 0.5
    seen[:, :, 6] = False
    places = random.permutation(VIEWS)
    assert disagreement(light_e, seen, places, 2.5) == pytest.approx(_by_hand(light_e, seen, places, 2.5), rel=1e-4)


def test_views_without_common_samples_disagree_without_limit() -> None:
    light_e = np.ones((VIEWS, VIEWS, 2, 3), np.float32)
    assert disagreement(light_e, np.zeros((VIEWS, 2, 3), bool), np.arange(VIEWS), 1.0) == float("inf")


@pytest.mark.parametrize(
    ("stated", "shuffled", "p_value", "z"),
    [
        (1.0, [1.0] * 99, 1.0, None),  # one picture copied
        (1.0, [1.0 + 1e-7, 2.0, 3.0], 0.5, None),  # the same sum in another order
        (2.0, [1.0, 3.0, 4.0, 5.0], 0.4, None),
        (1.0, [2.0, 4.0, np.inf], 0.25, 2.0),
        (5.0, [2.0, 4.0], 1.0, -2.0),
        (np.inf, [1.0, 2.0, np.inf], 1.0, 0.0),  # views that see nothing together
    ],
)
def test_significance_of_sums(stated: float, shuffled: list[float], p_value: float, z: float | None) -> None:
    result = significance(stated, shuffled)
    assert result.p_value == pytest.approx(p_value)
    assert z is None or result.z == pytest.approx(z)


def _p_value(light_e: NDArray[np.float32], seed: int, shuffles: int) -> float:
    random, seen = np.random.default_rng(seed), np.ones((VIEWS, *light_e.shape[2:]), bool)
    stated = disagreement(light_e, seen, np.arange(VIEWS), 4.0)
    return significance(
        stated, [disagreement(light_e, seen, random.permutation(VIEWS), 4.0) for _ in range(shuffles)]
    ).p_value


def test_views_that_mean_nothing_rarely_pass() -> None:
    # 160 sets of noise; p of 19 shuffles is 0.05 or less in 8 of them on average, 4 sigma of this are 11
    passed = 0
    for seed in range(160):
        light_e = np.random.default_rng([seed, 1]).poisson(20, (VIEWS, VIEWS, 5, 12)).astype(np.float32)
        passed += _p_value(light_e, seed, 19) <= 0.05
    assert 1 <= passed <= 19


def test_views_that_agree_where_they_are_pass() -> None:
    for seed in range(10):
        random = np.random.default_rng([seed, 2])
        light_e = random.poisson(20, (VIEWS, VIEWS, 5, 12)).astype(np.float32)
        light_e[np.arange(VIEWS), np.arange(VIEWS), 2] = 20.0
        assert _p_value(light_e, seed, 99) <= 0.02
