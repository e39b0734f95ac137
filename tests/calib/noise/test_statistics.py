"""The streamed statistics against whole stacks of frames, and the frames that do not belong."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from faintfield.calib.errors import BadFrame, LightLeak
from faintfield.calib.noise import Conditions, measure_series
from faintfield.calib.noise.series.outliers import MAX_CHANCE, outlier
from tests.calib.noise.darkroom import darks, expose, specimen

DARK = Conditions("dark", 1.0)
FLAT = Conditions("flat", 1.0)


@given(
    hnp.arrays(
        np.uint16, st.tuples(st.integers(2, 6), st.integers(3, 9), st.integers(3, 9)), elements=st.integers(90, 110)
    )
)
def test_one_pass_gives_what_the_whole_stack_gives(stack: np.ndarray) -> None:
    values = stack + 25.0 * np.arange(stack[0].size).reshape(stack[0].shape)
    series = measure_series(((str(k), frame.astype(np.uint16)) for k, frame in enumerate(values)), FLAT)
    assume(not series.suspect.any())
    level = values.mean((1, 2), keepdims=True)
    rows, columns = values.mean(2, keepdims=True) - level, values.mean(1, keepdims=True) - level
    stripped = values - level - rows - columns
    np.testing.assert_allclose(series.levels_dn, level.ravel())
    np.testing.assert_allclose(series.pattern_dn, stripped.mean(0), atol=1e-4)
    np.testing.assert_allclose(series.within_dn2, ((stripped - stripped.mean(0)) ** 2).sum(0), atol=1e-3, rtol=1e-5)
    np.testing.assert_allclose(series.mean_dn, values.mean(0), atol=1e-3)
    np.testing.assert_allclose(series.row_noise_dn2, rows.var(0, ddof=1).mean(), atol=1e-9)


def test_the_noise_of_a_hot_pixel_stays_out_of_its_row() -> None:
    rng = np.random.default_rng(1)
    stack = np.rint(rng.normal(100, 5, (400, 16, 16)))
    stack[:, 8, 8] += np.rint(rng.normal(3000, 400, 400))
    series = measure_series(((str(k), f.astype(np.uint16)) for k, f in enumerate(stack)), FLAT)
    variance = series.within_dn2 / 399
    assert variance[8, :8].mean() == pytest.approx(variance[3, :8].mean(), rel=0.1)


def test_frames_may_jitter_but_a_leak_is_named() -> None:
    for seed in range(8):
        chip, rng = specimen(seed, jitter_dn=1.0)
        frames = darks(chip, [1.0], 10, rng)[1.0]
        measure_series(frames, DARK)
        leaky = expose(chip, 1.0, rng, photons=40.0)
        with pytest.raises(LightLeak, match="the_leak: mean"):
            measure_series([*frames[:6], ("the_leak", leaky), *frames[6:]], DARK)


def test_a_leak_that_is_a_pattern_is_named() -> None:
    chip, rng = specimen(3)
    frames = darks(chip, [1.0], 6, rng)[1.0]
    spotted = frames[0][1].astype(int)
    spotted[10:30, 10:30] += 40
    spotted[34:54, 34:54] -= 40
    with pytest.raises(BadFrame, match="spotted: its pixels spread"):
        measure_series([*frames[1:], ("spotted", spotted.astype(np.uint16))], DARK)


def test_with_two_frames_only_a_large_leak_is_named() -> None:
    chip, rng = specimen(4, jitter_dn=1.0)
    frames = darks(chip, [1.0], 2, rng)[1.0]
    measure_series(frames, DARK)
    with pytest.raises(LightLeak, match="bright"):
        measure_series([frames[0], ("bright", expose(chip, 1.0, rng, photons=100.0))], DARK)


@pytest.mark.parametrize("stated", [4000.0, np.inf])
def test_values_at_the_top_are_counted_over_all_frames(stated: float) -> None:
    rng = np.random.default_rng(5)
    stack = np.minimum(np.rint(rng.normal(4060, 30, (5, 32, 32))), 4095).astype(np.uint16)
    series = measure_series(((str(k), frame) for k, frame in enumerate(stack)), FLAT, stated)
    top = min(4095.0, stated)
    assert series.top_dn == top
    assert series.at_top == (stack >= top).sum()
    assert series.below_top == (stack == top - 1).sum()
    assert series.clipped_share(top) == pytest.approx((stack >= top).mean())
    assert series.clipped_share(top + 1) == 0.0


def test_frames_of_another_size_are_refused() -> None:
    with pytest.raises(ValueError, match="odd: "):
        measure_series([("first", np.zeros((8, 8), int)), ("odd", np.zeros((8, 9), int))], DARK)


def test_a_series_without_frames_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one frame"):
        measure_series([], DARK)


def test_a_value_is_odd_whose_distance_from_the_others_is_no_chance_by_students_t() -> None:
    others = np.array([-1.2, 0.3, 1.4, -0.5, 0.2, -0.9, 0.7])
    others -= others.mean()
    # A new value differs from the mean of n others by σ √(1 + 1/n)
    just = stats.t.isf(MAX_CHANCE, 6) * others.std(ddof=1) * np.sqrt(1 + 1 / 7)
    for factor, odd in ((0.98, False), (1.02, True)):
        values = np.insert(others, 3, factor * just)
        index, excess = outlier(values, 0.1, 1e9)
        assert index == 3
        assert excess == pytest.approx(factor * just if odd else 0.0)
    assert outlier(np.insert(others, 0, 1.02 * just), 1.03 * just, 1e9) == (0, 0.0), "too little to matter"
    assert outlier(np.insert(others, 0, 0.9 * just), 0.1, 0.8 * just)[1] == pytest.approx(0.9 * just), "certain"
    assert outlier(np.array([0.0, 5.0]), 0.1, 10.0) == (1, 0.0), "one other value has no scatter"


@pytest.mark.parametrize("conditions", [DARK, FLAT])
def test_strips_give_what_whole_frames_give(conditions: Conditions, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(8)
    stack = np.rint(rng.normal(100, 5, (12, 41, 30))).astype(np.uint16)
    stack[:, 7, 3], stack[:, 20, 3] = 4000, 3000
    monkeypatch.setattr("faintfield.calib.noise.strips._STRIP_PX", 100)
    series = measure_series(((str(k), frame) for k, frame in enumerate(stack)), conditions)
    assert series.suspect[[7, 20], 3].all()
    regular, values = ~series.suspect, stack.astype(float)
    level = values.mean((1, 2), where=regular, keepdims=True)
    rest = values - level
    rows = np.nan_to_num(rest.mean(2, where=regular, keepdims=True))
    rest -= rows
    columns = np.nan_to_num(rest.mean(1, where=regular, keepdims=True))
    rest -= columns
    deviations = rest - rest.mean(0)
    np.testing.assert_allclose(series.levels_dn, level.ravel())
    np.testing.assert_allclose(series.row_dn, rows.mean(0).ravel(), atol=1e-9)
    np.testing.assert_allclose(series.column_dn, columns.mean(0).ravel(), atol=1e-9)
    np.testing.assert_allclose(series.mean_dn, rest.mean(0) + (rows + columns).mean(0) + level.mean(), rtol=1e-5)
    np.testing.assert_allclose(series.within_dn2, (deviations**2).sum(0), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(series.spreads_dn2, [(it[regular] ** 2).mean() for it in rest])
    if conditions is DARK:
        np.testing.assert_allclose(series.cubes_dn3[regular], (deviations**3).sum(0)[regular], rtol=1e-4, atol=0.1)
        np.testing.assert_allclose(series.fourths_dn4[regular], (deviations**4).sum(0)[regular], rtol=1e-4)
