"""Levels whose light is stated wrongly are found and named; a lamp that flickers makes no jitter."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.noise import Conditions, Series, calibrate, measure_series
from faintfield.calib.noise.likelihood.response import Light
from faintfield.calib.noise.misfit.odd_light import without_odd
from tests.calib.noise.darkroom import darks, expose, specimen
from tests.calib.noise.test_scatter import CHIP, PHOTONS, take

SIGNAL = np.linspace(100.0, 3000.0, 24)
ONE_GROUP = np.zeros(24, int)


def stated(wrong: dict[int, float], rng: np.random.Generator, scatter: float) -> tuple[Light, NDArray[np.float64]]:
    """Light with some levels off by a factor, and the signal of a response bent by 3 % at the end."""
    light = SIGNAL * (1 + 1e-5 * SIGNAL)
    for index, factor in wrong.items():
        light[index] *= factor
    return Light(light, ONE_GROUP), SIGNAL * (1 + scatter * rng.standard_normal(24)) + 0.05 * rng.standard_normal(24)


@pytest.mark.parametrize("scatter", [0.0, 0.005])
@pytest.mark.parametrize("wrong", [{}, {4: 0.9}, {20: 1.3, 17: 1.28}])
def test_levels_that_are_stated_wrongly_are_found_and_no_others(wrong: dict[int, float], scatter: float) -> None:
    for seed in range(5):
        light, signal = stated(wrong, np.random.default_rng(seed), scatter)
        found = without_odd(light, signal, np.full(24, 0.05**2), 2)
        assert {index for index, _ in found.odd} == set(wrong)
        assert np.flatnonzero(found.group < 0).tolist() == sorted(wrong)


def test_levels_that_all_scatter_are_not_odd() -> None:
    for seed in range(30):
        light, signal = stated({}, np.random.default_rng(seed), 0.03)
        assert without_odd(light, signal, np.full(24, 0.05**2), 2).odd == ()


def test_few_levels_do_not_tell_which_is_odd() -> None:
    light = Light(np.array([1.0, 2.0, 3.9, 4.0, 5.0]), np.zeros(5, int))
    assert without_odd(light, 100 * np.arange(1.0, 6.0), np.full(5, 0.01), 1).odd == ()


def with_photons(series: list[Series], level: int, factor: float) -> list[Series]:
    return [
        replace(one, conditions=replace(one.conditions, photons=one.conditions.photons * factor))
        if one.conditions.photons and one.conditions.level == level
        else one
        for one in series
    ]


def test_a_level_of_other_light_than_stated_is_named_and_spoils_nothing() -> None:
    right = take(*specimen(3, **CHIP))
    wrong = calibrate(with_photons(right, 4, 1.3), 8000.0)
    (told,) = (warning for warning in wrong.warnings if "at level 4" in warning)
    assert f"{1.3 * PHOTONS[4]:.5g} photons are stated" in told
    fitted = float(told.split("that of ")[1].split(" photons")[0])
    assert fitted == pytest.approx(PHOTONS[4], rel=0.01)
    before, after = calibrate(right, 8000.0).estimates, wrong.estimates
    for name in ("gain_dn_per_e", "dark_current_e_per_s", "quantum_efficiency", "read_noise_e"):
        assert after[name].value == pytest.approx(before[name].value, rel=0.01), name
        assert after[name].se == pytest.approx(before[name].se, rel=0.3), name
    assert after["frame_jitter_dn"].value == pytest.approx(before["frame_jitter_dn"].value or 0.0, abs=0.05)


def test_a_lamp_that_flickers_makes_no_jitter() -> None:
    """Forty levels of two frames each, off by 3 %, beside few darks; the black level is still."""
    chip, rng = specimen(5, **CHIP)
    taken = darks(chip, (0.1, 10.0, 60.0), 2, rng)
    series = [measure_series(frames, Conditions("dark", t)) for t, frames in taken.items()]
    for level, light in enumerate(np.linspace(300.0, 12000.0, 40)):
        frames = [(f"{level}_{k}", expose(chip, 0.1, rng, light * (1 + 0.03 * rng.standard_normal()))) for k in (0, 1)]
        series.append(measure_series(frames, Conditions("flat", 0.1, level)))
    found = calibrate(series, 8000.0).estimates
    jitter, flicker, current = (found[it] for it in ("frame_jitter_dn", "lamp_flicker", "dark_current_e_per_s"))
    assert jitter.value is not None
    assert jitter.value < 0.2
    assert flicker.ci95 is not None
    assert 0.01 < flicker.ci95[0] < 0.03 < flicker.ci95[1]
    assert current.ci95 is not None
    assert current.ci95[0] < 0.2 < current.ci95[1]
    assert current.ci95[1] - current.ci95[0] < 0.1
