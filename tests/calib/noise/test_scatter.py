"""Intervals grow by the scatter that the series show, and quantities that the series deny have no value."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from scipy import stats

from faintfield.calib.noise import Conditions, Series, calibrate, measure_series
from faintfield.calib.noise.likelihood.groups import group_noise
from faintfield.calib.noise.likelihood.maximum import NoiseFit
from tests.calib.noise.darkroom import Chip, darks, expose, specimen

CHIP = {"gain_dn_per_e": 0.5, "read_noise_e": 8.0, "dsnu_e": 3.0, "shape": (40, 40)}
PHOTONS = tuple(np.linspace(600.0, 12000.0, 9))


def take(chip: Chip, rng: np.random.Generator, *, photons: bool = True) -> list[Series]:
    taken = darks(chip, (0.1, 5.0, 10.0, 20.0), 6, rng)
    series = [measure_series(frames, Conditions("dark", t)) for t, frames in taken.items()]
    for level, light in enumerate(PHOTONS):
        frames = [(f"flat_{level}_{k}", expose(chip, 0.1, rng, light)) for k in range(4)]
        series.append(measure_series(frames, Conditions("flat", 0.1, level, light if photons else None)))
    return series


def noisier(one: Series, factor: float) -> Series:
    return replace(one, within_dn2=(one.within_dn2 * factor).astype(np.float32))


def width(series: list[Series], name: str = "gain_dn_per_e") -> float:
    interval = calibrate(series, 8000.0).estimates[name].ci95
    assert interval is not None
    return interval[1] - interval[0]


def test_series_that_scatter_widen_the_interval_and_one_that_is_far_off_takes_the_gain_away() -> None:
    series = take(*specimen(3, **CHIP))
    rng = np.random.default_rng(1)
    scattered = [noisier(one, float(np.exp(0.06 * rng.standard_normal()))) for one in series]
    assert width(scattered) > 2 * width(series)
    found = calibrate(scattered, 8000.0)
    assert found.estimates["noise_error"].value == pytest.approx(0.06, rel=0.6)
    assert any("scatters by" in warning for warning in found.warnings)
    off = [noisier(one, 1.5) if one.conditions.level == 4 else one for one in series]
    why = calibrate(off, 8000.0).estimates["gain_dn_per_e"].why
    assert "at level 4 is +" in str(why)


def test_light_that_nobody_states_leaves_room_for_a_bend() -> None:
    chip, rng = specimen(4, **CHIP)
    stated = take(chip, rng)
    unknown = [replace(one, conditions=replace(one.conditions, photons=None)) for one in stated]
    found = calibrate(unknown, 8000.0)
    assert found.estimates["linearity_error"].value is None
    assert any("not known well enough to tell a bend" in warning for warning in found.warnings)
    # One bright series of 3 (P − R − C + 1) degrees of freedom, at 3000 of 8000 DN
    of_chance = 3.92 * 0.5 * np.sqrt(2 / (3 * (1600 - 79)))
    assert width([*unknown[:4], unknown[12]]) > 1.15 * of_chance
    assert found.response is None


def test_a_lamp_that_flickers_is_measured_and_leaves_the_noise_alone() -> None:
    chip, rng = specimen(5, **CHIP)
    series = take(chip, rng)
    for j, light in enumerate(PHOTONS):
        frames = [(f"f{j}_{k}", expose(chip, 0.1, rng, light * (1 + 0.02 * rng.standard_normal()))) for k in range(4)]
        series[4 + j] = measure_series(frames, series[4 + j].conditions)
    found = calibrate(series, 8000.0)
    flicker, gain = found.estimates["lamp_flicker"], found.estimates["gain_dn_per_e"]
    assert flicker.ci95 is not None
    assert flicker.ci95[0] < 0.02 < flicker.ci95[1]
    assert gain.ci95 is not None
    assert gain.ci95[0] < 0.5 < gain.ci95[1]
    assert found.estimates["light_error"].value == pytest.approx(0.01, rel=0.8)


def test_levels_that_drift_a_little_widen_the_dark_current() -> None:
    series = take(*specimen(6, **CHIP))
    drift = dict(zip((0.1, 5.0, 10.0, 20.0), (0.1, -0.15, 0.12, -0.05), strict=True))
    moved = [
        replace(one, levels_dn=one.levels_dn + drift.get(one.conditions.exposure_s, 0.0))
        if one.conditions.kind == "dark"
        else one
        for one in series
    ]
    assert width(moved, "dark_signal_dn_per_s") > 2 * width(series, "dark_signal_dn_per_s")
    assert calibrate(moved, 8000.0).estimates["drift_dn"].value == pytest.approx(0.13, rel=0.6)


def test_dark_current_of_warm_series_is_taken_to_the_temperature_of_reference() -> None:
    """The series of 20 s is warmer by one doubling: it has the dark charge of 40 s."""
    chip, rng = specimen(7, **CHIP)
    series = take(chip, rng)
    warm = [(f"warm_{k}", expose(chip, 40.0, rng)) for k in range(6)]
    series[3] = measure_series(warm, Conditions("dark", 20.0, dark_factor=2.0))
    current = calibrate(series, 8000.0).estimates["dark_current_e_per_s"]
    assert current.ci95 is not None
    assert current.ci95[0] < 0.2 < current.ci95[1]


def test_the_quantile_is_students_where_the_scatter_rules_and_normal_where_it_does_not() -> None:
    fit = NoiseFit({"a": 1.0, "b": 2.0}, np.diag([4.0, 1.0]), 0.0, sources=((np.diag([4.0, 0.0]), 3),))
    assert fit.quantile(np.array([1.0, 0.0])) == pytest.approx(stats.t.ppf(0.975, 3))
    assert fit.quantile(np.array([0.0, 1.0])) == pytest.approx(stats.norm.ppf(0.975))
    # Half of the variance rests on 3 degrees of freedom: Satterthwaite's are 2² 3 = 12
    assert fit.quantile(np.array([0.5, 1.0])) == pytest.approx(stats.t.ppf(0.975, 12))
    # A share that rounding makes negative is none
    shrunk = replace(fit, sources=((np.diag([-1e9, 0.0]), 3),))
    assert shrunk.quantile(np.array([1.0, 0.0])) == pytest.approx(stats.norm.ppf(0.975))


def test_blocks_of_pixels_have_the_noise_of_their_own() -> None:
    rng = np.random.default_rng(2)
    sigma = np.ones((32, 32))
    sigma[:16] = 3.0
    frames = [(str(k), np.rint(1000 + 20 * sigma * rng.standard_normal((32, 32))).astype(int)) for k in range(30)]
    series = measure_series(frames, Conditions("dark", 1.0))
    noise = group_noise(series, np.ones((32, 32), bool), 0.0, (2, 1))
    ratio, freedom = noise.scatter(noise.blocks, 400.0)
    # Means of columns are subtracted, which carries a little noise from one half to the other.
    assert ratio == pytest.approx([9.0, 1.0], rel=0.15)
    assert freedom == pytest.approx([29 * 512 * (1024 - 63) / 1024] * 2)


@pytest.mark.parametrize("kind", ["dark", "flat"])
@pytest.mark.parametrize("blocks", [(3, 7), (3, 40)])
def test_groups_are_those_of_single_pixels(kind: Literal["dark", "flat"], blocks: tuple[int, int]) -> None:
    rng = np.random.default_rng(4)
    level = np.add.outer(np.linspace(100, 900, 41), np.linspace(0, 100, 30))
    frames = [(str(k), np.rint(rng.normal(level, 5)).astype(np.uint16)) for k in range(4)]
    series, used = measure_series(frames, Conditions(kind, 1.0)), rng.random((41, 30)) < 0.8
    noise = group_noise(series, used, 150.0, blocks)
    # Darks share one noise; that of a flat is straight between the nodes, and no pixel counts as darker than the floor
    variances = 25.0 if kind == "dark" else 3.0 + 0.1 * noise.nodes_dn
    expected = np.full((41, 30), 25.0) if kind == "dark" else 3.0 + 0.1 * np.maximum(series.mean_dn, 150.0)
    share = (used.sum() - sum(used.shape) + 1) / used.sum()
    for groups, shape in ((noise.blocks, blocks), (noise.rows, (41, 1)), (noise.columns, (1, 30))):
        ratio, freedom = noise.scatter(groups, variances)
        of_row, of_column = (np.arange(size) * count // size for size, count in zip(used.shape, shape, strict=True))
        found = []
        for row, column in np.ndindex(shape):
            inside = used & np.outer(of_row == row, of_column == column)
            if inside.sum() > 1:
                squares = series.within_dn2[inside].sum() / expected[inside].sum() / 3 / share
                found.append((squares, 3 * inside.sum() * share))
        np.testing.assert_allclose(np.stack([ratio, freedom], axis=1), found, rtol=1e-5)
