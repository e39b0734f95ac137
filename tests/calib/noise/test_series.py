"""Streamed statistics of series against whole stacks, frames that do not belong, and where flats saturate."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.errors import BadFrame, LightLeak, SaturatedFlat
from faintfield.calib.noise import Conditions, Series, calibrate, measure_series
from faintfield.calib.noise.flats import check_flat_levels, find_saturation
from faintfield.calib.noise.series import MAX_CHANCE, outlier
from tests.calib.noise.darkroom import Chip, dark_series, darks, expose, flat_series, specimen

DARK, FLAT = Conditions("dark", 1.0), Conditions("flat", 1.0)


def measured(stack: Iterable[NDArray[np.number]], conditions: Conditions, saturation_dn: float = np.inf) -> Series:
    named = ((str(k), np.rint(frame).astype(np.uint16)) for k, frame in enumerate(stack))
    return measure_series(named, conditions, saturation_dn)


@pytest.mark.parametrize("conditions", [DARK, FLAT])
@pytest.mark.parametrize("shape", [(12, 41, 30), (2, 9, 4)])
def test_strips_give_statistics_of_stacks(
    conditions: Conditions, shape: tuple[int, int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    stack = np.rint(np.random.default_rng(8).normal(100, 5, shape) + 20.0 * np.arange(shape[2]))
    stack[:, 7, 3] = 4000
    monkeypatch.setattr("faintfield.calib.noise.strips._STRIP_PX", 100)
    series = measured(stack, conditions)
    assert series.suspect[7, 3]
    regular = ~series.suspect
    level = stack.mean((1, 2), where=regular, keepdims=True)
    rest = stack - level
    rows = np.nan_to_num(rest.mean(2, where=regular, keepdims=True))
    rest -= rows
    columns = np.nan_to_num(rest.mean(1, where=regular, keepdims=True))
    rest -= columns
    deviations = rest - rest.mean(0)
    np.testing.assert_allclose(series.levels_dn, level.ravel())
    np.testing.assert_allclose(series.row_dn, rows.mean(0).ravel(), atol=1e-9)
    np.testing.assert_allclose(series.column_dn, columns.mean(0).ravel(), atol=1e-9)
    np.testing.assert_allclose(series.pattern_dn[regular], rest.mean(0)[regular], atol=1e-3)
    np.testing.assert_allclose(series.row_noise_dn2, rows[:, regular.any(1)].var(0, ddof=1).mean(), rtol=1e-6)
    np.testing.assert_allclose(series.mean_dn, rest.mean(0) + (rows + columns).mean(0) + level.mean(), rtol=1e-5)
    np.testing.assert_allclose(series.within_dn2, (deviations**2).sum(0), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(series.spreads_dn2, [(frame[regular] ** 2).mean() for frame in rest])
    if conditions is DARK:
        np.testing.assert_allclose(series.cubes_dn3[regular], (deviations**3).sum(0)[regular], rtol=1e-4, atol=0.1)
        np.testing.assert_allclose(series.fourths_dn4[regular], (deviations**4).sum(0)[regular], rtol=1e-4)


@pytest.mark.parametrize(("frames", "leak_photons"), [(10, 40.0), (2, 100.0)])
def test_leak_is_named_among_jittering_frames(frames: int, leak_photons: float) -> None:
    for seed in range(8):
        chip, rng = specimen(seed, jitter_dn=1.0)
        named = darks(chip, [1.0], frames, rng)[1.0]
        measure_series(named, DARK)
        named.insert(frames // 2, ("the_leak", expose(chip, 1.0, rng, photons=leak_photons)))
        with pytest.raises(LightLeak, match="the_leak"):
            measure_series(named if frames > 2 else named[:2], DARK)


def test_leak_with_a_pattern_is_named() -> None:
    chip, rng = specimen(3)
    frames = darks(chip, [1.0], 6, rng)[1.0]
    spotted = frames[0][1].astype(int)
    spotted[10:30, 10:30] += 40
    spotted[34:54, 34:54] -= 40
    with pytest.raises(BadFrame, match="spotted: its pixels spread"):
        measure_series([*frames[1:], ("spotted", spotted.astype(np.uint16))], DARK)


@pytest.mark.parametrize("stated", [4000.0, np.inf])
def test_values_at_the_top_are_counted(stated: float) -> None:
    stack = np.minimum(np.rint(np.random.default_rng(5).normal(4060, 30, (5, 32, 32))), 4095)
    series = measured(stack, FLAT, stated)
    top = min(4095.0, stated)
    assert series.top_dn == top
    assert series.at_top == (stack >= top).sum()
    assert series.below_top == (stack == top - 1).sum()
    assert series.clipped_share(top) == pytest.approx((stack >= top).mean())
    assert series.clipped_share(top + 1) == 0.0


@pytest.mark.parametrize(("shapes", "words"), [(((8, 8), (8, 9)), "1: "), ((), "at least one frame")])
def test_series_of_unlike_or_no_frames_is_refused(shapes: tuple[tuple[int, int], ...], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        measured([np.zeros(shape) for shape in shapes], DARK)


def test_outliers_are_no_chance_by_students_t() -> None:
    values = np.array([-1.2, 0.3, 1.4, -0.5, 0.2, -0.9, 0.7])
    values -= values.mean()
    # A new value differs from the mean of n others by σ √(1 + 1/n)
    just = stats.t.isf(MAX_CHANCE, 6) * values.std(ddof=1) * np.sqrt(1 + 1 / 7)
    for factor, odd in ((0.98, False), (1.02, True)):
        index, excess = outlier(np.insert(values, 3, factor * just), 0.1, 1e9)
        assert index == 3
        assert excess == pytest.approx(factor * just if odd else 0.0)
    assert outlier(np.insert(values, 0, 1.02 * just), 1.03 * just, 1e9) == (0, 0.0), "too little to matter"
    assert outlier(np.insert(values, 0, 0.9 * just), 0.1, 0.8 * just)[1] == pytest.approx(0.9 * just), "certain"
    assert outlier(np.array([0.0, 5.0]), 0.1, 10.0) == (1, 0.0), "one other value has no scatter"


OFFSET_DN, GAIN, READ_E = 50.0, 0.5, 6.0


def camera(seed: int, well_e: float = np.inf) -> tuple[Chip, np.random.Generator]:
    """Make a sensor of 12 bits without dark current."""
    converter = {"offset_dn": OFFSET_DN, "gain_dn_per_e": GAIN, "ceiling_dn": 4095.0}
    charge = {"read_noise_e": READ_E, "dark_current_e_per_s": 0.0, "dsnu_e": 0.0, "well_e": well_e}
    return specimen(seed, shape=(48, 48), **converter, **charge)


def flats_of(charges_e: list[float], well_e: float = np.inf) -> list[Series]:
    """Measure flats of these mean charges."""
    chip, rng = camera(1, well_e)
    return [flat_series(chip, 2 * charge_e, 2, rng, level=level) for level, charge_e in enumerate(charges_e)]


def flat_of(charges_e: list[float], exposure_s: float, seed: int) -> Series:
    """Measure one series whose frames have these mean charges."""
    chip, rng = camera(seed)
    named = [(f"{exposure_s:g} s {k}", expose(chip, exposure_s, rng, 2 * e)) for k, e in enumerate(charges_e)]
    return measure_series(named, Conditions("flat", exposure_s))


def levels(series: Iterable[Series]) -> list[int]:
    return [entry.conditions.level for entry in series]


CHIP, RNG = camera(2)
DARKS = dark_series(CHIP, (0.1, 0.2), 4, RNG)
WELL_E = [500.0, 1000.0, 2000.0, 3000.0, 4000.0, 4500.0, 5000.0, 5500.0, 6000.0]


def test_levels_at_the_converters_end_are_dropped() -> None:
    """A charge of 7600 e lies 5 standard deviations below the end, which nobody states, and 8020 e one."""
    flats = flats_of([1000.0, 4000.0, 7600.0, 8020.0, 8300.0, 9000.0])
    saturation = find_saturation(DARKS, flats, np.inf)
    assert (saturation.limit, saturation.level_dn) == ("ADC", 4095.0)
    assert levels(saturation.kept) == [0, 1, 2]
    assert levels(series for series, _ in saturation.left_out) == [3, 4, 5]
    assert "stand at 4095 DN, the end of the range" in saturation.left_out[0][1]
    brightest_first = find_saturation(DARKS, [*flats[4:], *flats[:3]], np.inf)
    assert (brightest_first.limit, levels(brightest_first.kept)) == ("ADC", [0, 1, 2])


def test_full_well_shows_in_falling_noise() -> None:
    saturation = find_saturation(DARKS, flats_of(WELL_E, well_e=5000.0), 4095.0)
    assert saturation.limit == "full well"
    assert saturation.level_dn == pytest.approx(OFFSET_DN + GAIN * 4500, rel=0.02)
    assert saturation.interval_dn is not None
    assert saturation.interval_dn[0] < OFFSET_DN + GAIN * 4700 < saturation.interval_dn[1]
    assert levels(saturation.kept) == [0, 1, 2, 3], "the range ends at seven tenths"


def test_unsaturated_flats_are_all_kept() -> None:
    flats = flats_of([500.0, 2000.0, 5000.0])
    saturation = find_saturation(DARKS, flats, 4095.0)
    assert (saturation.limit, saturation.level_dn, saturation.interval_dn) == ("not reached", None, None)
    assert list(saturation.kept) == flats
    assert find_saturation(DARKS, [], np.inf).kept == ()


def test_only_saturated_flats_are_refused() -> None:
    with pytest.raises(SaturatedFlat, match=r"^flat_0_0: .* of the flat's pixels stand at 4095 DN"):
        find_saturation(DARKS, flats_of([8300.0, 9000.0]), np.inf)


@pytest.mark.parametrize(
    ("charges_e", "well_e", "end_e", "error", "dropped"),
    [
        ([500.0, 2000.0, 3500.0, 5000.0, 6500.0, 7500.0, 9000.0], np.inf, (4095 - OFFSET_DN) / GAIN, 0.03, 6),
        (WELL_E[:-1], 5000.0, 4700.0, 0.06, 4),
    ],
    ids=["converter", "well"],
)
def test_capacity_is_the_charge_at_the_end(
    charges_e: list[float], well_e: float, end_e: float, error: float, dropped: int
) -> None:
    result = calibrate([*DARKS, *flats_of(charges_e, well_e=well_e)], 4095.0)
    capacity = result.estimates["saturation_e"]
    assert capacity.ci95 is not None
    assert capacity.ci95[0] < end_e < capacity.ci95[1]
    assert capacity.value == pytest.approx(end_e, rel=error)
    assert result.estimates["gain_dn_per_e"].value == pytest.approx(GAIN, rel=0.03)
    words = f"series of flats are left out, beginning with the flats of 0.1 s at level {dropped}"
    assert any(words in warning for warning in result.warnings)


@pytest.mark.parametrize(
    ("level", "factor", "kept", "words"),
    [(2, 3.0, [0, 1, 3, 4, 5], "the only one"), (5, 0.3, [0, 1, 2], "record two more levels")],
    ids=["too much noise", "too little noise"],
)
def test_single_odd_series_is_no_full_well(level: int, factor: float, kept: list[int], words: str) -> None:
    flats = flats_of([1000.0, 2000.0, 3000.0, 4000.0, 5000.0, 6000.0])
    flats[level] = replace(flats[level], within_dn2=np.float32(factor) * flats[level].within_dn2)
    saturation = find_saturation(DARKS, flats, 4095.0)
    assert (saturation.limit, saturation.level_dn) == ("not reached", None)
    assert levels(saturation.kept) == kept
    assert words in saturation.left_out[0][1]


def test_frames_of_two_lights_are_named() -> None:
    """Twelve exposures of one lamp; of 6 ms one frame too many is stated as 12 ms."""
    flats = [flat_of([500.0 * k] * 2, 1e-3 * k, k) for k in (1, 2, 3, 4, 5, 7, 8, 9, 10, 11)]
    mixed = flat_of([6000.0, 6000.0, 3000.0, 3000.0], 12e-3, 20)
    with pytest.raises(BadFrame, match=r"^0.012 s [01]: mean 30\d\d.* DN, where 0.012 s [23] .* 15\d\d.*limit 5%"):
        calibrate([*DARKS, *flats, mixed], 4095.0)
    with pytest.raises(BadFrame, match="limit 50%"):
        calibrate([*DARKS, mixed], 4095.0)


@pytest.mark.parametrize("flicker", [0.0, 0.03])
def test_flicker_of_all_series_is_no_fault(flicker: float) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        check_flat_levels(
            DARKS,
            [flat_of((500.0 * k * (1 + flicker * rng.standard_normal(2))).tolist(), 1e-3 * k, k) for k in range(1, 8)],
        )
