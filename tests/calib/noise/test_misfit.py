"""Departures of series from the model: scatter that widens intervals, odd light, and temperatures."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.estimate import Estimate
from faintfield.calib.noise import Conditions, Series, calibrate, measure_series
from faintfield.calib.noise.likelihood.gaussian_fit import NoiseFit
from faintfield.calib.noise.likelihood.moments import gather_moments
from faintfield.calib.noise.likelihood.response import Light
from faintfield.calib.noise.scatter import trend, without_odd
from faintfield.calib.noise.sensor_fit import fit_series
from faintfield.calib.noise.temperature import Warmth, settle_temperature, with_doubling_error
from tests.calib.noise.darkroom import Chip, dark_series, expose, flat_series, specimen, with_flats

CHIP = {"gain_dn_per_e": 0.5, "read_noise_e": 8.0, "dsnu_e": 3.0, "shape": (40, 40)}
PHOTONS = tuple(np.linspace(600.0, 12000.0, 9))


def measured(chip: Chip, rng: np.random.Generator) -> list[Series]:
    return with_flats(chip, rng, PHOTONS, (0.1, 5.0, 10.0, 20.0), frames=4, dark_frames=6)


@cache
def plain() -> tuple[Series, ...]:
    return tuple(measured(*specimen(3, **CHIP)))


def noisier(series: Series, factor: float) -> Series:
    return replace(series, within_dn2=(series.within_dn2 * factor).astype(np.float32))


def stated(series: Series, photons: float | None) -> Series:
    return replace(series, conditions=replace(series.conditions, photons=photons))


def interval(series: list[Series] | tuple[Series, ...], name: str = "gain_dn_per_e") -> tuple[float, float]:
    estimate = calibrate(series, 8000.0).estimates[name]
    assert estimate.ci95 is not None, estimate.why
    return estimate.ci95


def width(series: list[Series] | tuple[Series, ...], name: str = "gain_dn_per_e") -> float:
    return float(np.ptp(interval(series, name)))


def test_scatter_of_series_widens_the_interval() -> None:
    rng = np.random.default_rng(1)
    scattered = [noisier(series, float(np.exp(0.06 * rng.standard_normal()))) for series in plain()]
    result = calibrate(scattered, 8000.0)
    assert np.ptp(result.estimates["gain_dn_per_e"].ci95 or 0.0) > 2 * width(plain())
    assert result.estimates["noise_error"].value == pytest.approx(0.06, rel=0.6)
    assert any("scatters by" in warning for warning in result.warnings)


def test_series_far_off_takes_the_gain_away() -> None:
    off = [noisier(series, 1.5) if series.conditions.level == 4 else series for series in plain()]
    assert "at level 4 is +" in str(calibrate(off, 8000.0).estimates["gain_dn_per_e"].why)


def test_unknown_light_leaves_room_for_a_bend() -> None:
    unknown = [stated(series, None) for series in plain()]
    result = calibrate(unknown, 8000.0)
    assert result.estimates["linearity_error"].value is None
    assert any("not known well enough to tell a bend" in warning for warning in result.warnings)
    # One bright series of 3 (P − R − C + 1) degrees of freedom, at 3000 of 8000 DN
    of_chance = 3.92 * 0.5 * np.sqrt(2 / (3 * (1600 - 79)))
    assert width([*unknown[:4], unknown[12]]) > 1.15 * of_chance
    assert result.response is None


def test_bend_seen_by_noise_alone_leaves_the_gain_true() -> None:
    """The noise of the flats is the expected one, to the digit, of a signal K Q (1 − 2 % Q/Q_end)."""
    chip, rng = specimen(7, **CHIP | {"read_noise_e": 3.0})
    darks, flats = dark_series(chip, (0.1, 5.0, 10.0, 20.0), 8, rng), []
    for level, x in enumerate(np.linspace(0.03, 0.95, 16)):
        flat, charge_e = flat_series(chip, 1000.0, 2, rng, level=level, stated=False), 16_000 * x
        shape = flat.within_dn2.shape
        noise = (0.5 * (1 - 0.04 * x)) ** 2 * (charge_e + chip.sensor.read_noise_e**2) + 1 / 12
        kept = (shape[0] * shape[1] - sum(shape) + 1) / (shape[0] * shape[1])
        exact = replace(
            flat,
            names=("frame",) * 1000,
            levels_dn=np.full(1000, chip.offset_dn.mean() + 0.5 * charge_e * (1 - 0.02 * x)),
            row_dn=np.zeros(shape[0]),
            column_dn=np.zeros(shape[1]),
            pattern_dn=np.zeros(shape, np.float32),
            within_dn2=np.full(shape, 999 * noise * kept, np.float32),
        )
        flats.append(exact)
    fitted = fit_series(darks, flats, np.ones(shape, bool), 8000.0)
    assert fitted.moments.light.groups.size == 0
    error, se = np.exp(fitted.fit.values["log_gain"]) / 0.5 - 1, fitted.fit.standard_error("log_gain")
    assert abs(error) < min(3e-4, 0.3 * se)


def test_flickering_lamp_leaves_the_noise_alone() -> None:
    chip, rng = specimen(5, **CHIP)
    series = measured(chip, rng)
    for j, light in enumerate(PHOTONS):
        frames = [(f"f{j}_{k}", expose(chip, 0.1, rng, light * (1 + 0.02 * rng.standard_normal()))) for k in range(4)]
        series[4 + j] = measure_series(frames, series[4 + j].conditions)
    estimates = calibrate(series, 8000.0).estimates
    for name, truth in (("lamp_flicker", 0.02), ("gain_dn_per_e", 0.5)):
        low, high = estimates[name].ci95 or (np.nan, np.nan)
        assert low < truth < high, name
    assert estimates["light_error"].value == pytest.approx(0.01, rel=0.8)


def test_drifting_levels_widen_the_dark_current() -> None:
    drift_dn = (0.1, -0.15, 0.12, -0.05)
    moved = [replace(dark, levels_dn=dark.levels_dn + by_dn) for dark, by_dn in zip(plain(), drift_dn, strict=False)]
    moved += plain()[4:]
    assert width(moved, "dark_signal_dn_per_s") > 2 * width(plain(), "dark_signal_dn_per_s")
    assert calibrate(moved, 8000.0).estimates["drift_dn"].value == pytest.approx(0.13, rel=0.6)


@pytest.mark.parametrize("rise_dn", [0.0, 0.02])
def test_rise_within_series_is_drift_between_them(rise_dn: float) -> None:
    rng, levels = np.random.default_rng(5), np.arange(6)
    dark = dark_series(specimen(5)[0], (1.0,), 6, rng)[0]
    series = [
        replace(
            dark,
            conditions=Conditions("dark", exposure_s),
            levels_dn=100 + rise_dn * (6 * j + levels) + 0.001 * rng.standard_normal(6),
        )
        for j, exposure_s in enumerate((0.1, 1.0, 5.0, 10.0))
    ]
    assert trend(series)[0] == pytest.approx((6 * rise_dn) ** 2, rel=0.1)


SIGNAL = np.linspace(100.0, 3000.0, 24)


def light_and_signal(
    wrong: dict[int, float], rng: np.random.Generator, scatter: float
) -> tuple[Light, NDArray[np.float64]]:
    """Return light with some levels off by a factor, and the signal of a response bent by 3 % at the end."""
    light = SIGNAL * (1 + 1e-5 * SIGNAL)
    for index, factor in wrong.items():
        light[index] *= factor
    signal = SIGNAL * (1 + scatter * rng.standard_normal(24)) + 0.05 * rng.standard_normal(24)
    return Light(light, np.zeros(24, int)), signal


@pytest.mark.parametrize("scatter", [0.0, 0.005])
@pytest.mark.parametrize("wrong", [{}, {4: 0.9}, {20: 1.3, 17: 1.28}])
def test_levels_of_other_light_are_odd(wrong: dict[int, float], scatter: float) -> None:
    for seed in range(5):
        light, signal = light_and_signal(wrong, np.random.default_rng(seed), scatter)
        regular = without_odd(light, signal, np.full(24, 0.05**2), 2)
        assert {index for index, _ in regular.odd} == set(wrong)
        assert np.flatnonzero(regular.group < 0).tolist() == sorted(wrong)


def test_scattering_or_few_levels_are_not_odd() -> None:
    for seed in range(30):
        light, signal = light_and_signal({}, np.random.default_rng(seed), 0.03)
        assert without_odd(light, signal, np.full(24, 0.05**2), 2).odd == ()
    few = Light(np.array([1.0, 2.0, 3.9, 4.0, 5.0]), np.zeros(5, int))
    assert without_odd(few, 100 * np.arange(1.0, 6.0), np.full(5, 0.01), 1).odd == ()


def test_level_of_other_light_spoils_nothing() -> None:
    series = [stated(flat, 1.3 * PHOTONS[4]) if flat.conditions.level == 4 else flat for flat in plain()]
    result = calibrate(series, 8000.0)
    (warning,) = (warning for warning in result.warnings if "at level 4" in warning)
    assert f"{1.3 * PHOTONS[4]:.5g} photons are stated" in warning
    fitted = float(warning.split("that of ")[1].split(" photons")[0])
    assert fitted == pytest.approx(PHOTONS[4], rel=0.01)
    before, after = calibrate(plain(), 8000.0).estimates, result.estimates
    for name in ("gain_dn_per_e", "dark_current_e_per_s", "quantum_efficiency", "read_noise_e"):
        assert after[name].value == pytest.approx(before[name].value, rel=0.01), name
        assert after[name].se == pytest.approx(before[name].se, rel=0.3), name
    assert after["frame_jitter_dn"].value == pytest.approx(before["frame_jitter_dn"].value or 0.0, abs=0.05)


def test_flickering_lamp_makes_no_jitter() -> None:
    """Forty levels of two frames each, off by 3 %, beside few darks; the black level is still."""
    chip, rng = specimen(5, **CHIP)
    series = dark_series(chip, (0.1, 10.0, 60.0), 2, rng)
    for level, light in enumerate(np.linspace(300.0, 12000.0, 40)):
        frames = [(f"{level}_{k}", expose(chip, 0.1, rng, light * (1 + 0.03 * rng.standard_normal()))) for k in (0, 1)]
        series.append(measure_series(frames, Conditions("flat", 0.1, level)))
    estimates = calibrate(series, 8000.0).estimates
    assert (estimates["frame_jitter_dn"].value or 0.0) < 0.2
    for name, truth, widest in (("lamp_flicker", 0.03, 0.02), ("dark_current_e_per_s", 0.2, 0.1)):
        low, high = estimates[name].ci95 or (np.nan, np.nan)
        assert low < truth < high, name
        assert high - low < widest, name


CURRENT, DOUBLING_K = 10.0, 6.0


@cache
def at_temperatures(stated_k: float | None, *warmth: float) -> list[Series]:
    """Measure darks of 3 exposures at each temperature; they are longer by as much as the current is larger."""
    chip, rng = specimen(5, dark_current_e_per_s=CURRENT, gain_dn_per_e=0.5, read_noise_e=8.0, shape=(48, 48))
    series = []
    for kelvin in warmth or (10.0, 20.0, 30.0):
        growth = 2 ** ((kelvin - 20) / DOUBLING_K)
        factor = 1.0 if stated_k is None else 2 ** ((kelvin - 20) / stated_k)
        for t in (0.01, 1.0, 10.0):
            frames = [(f"{kelvin} {t} {k}", expose(chip, t * growth, rng)) for k in range(4)]
            series.append(measure_series(frames, Conditions("dark", t, dark_factor=factor, temperature_c=kelvin)))
    return [*series, flat_series(chip, 8000.0, 6, rng, exposure_s=0.01, stated=False)]


@pytest.mark.parametrize("stated_k", [DOUBLING_K, None])
def test_dark_current_is_that_at_the_mean_temperature(stated_k: float | None) -> None:
    result = calibrate(at_temperatures(stated_k))
    low, high = result.estimates["dark_current_e_per_s"].ci95 or (np.nan, np.nan)
    assert low < CURRENT < high
    assert high - low < 0.08 * CURRENT
    assert (result.estimates["frame_jitter_dn"].value or 0.0) < 0.1, "no jitter is invented"
    doublings = [warning for warning in result.warnings if "doubling" in warning]
    assert len(doublings) == (stated_k is None)
    assert all("doubles every 6" in warning for warning in doublings)


def test_wrong_stated_doubling_is_named() -> None:
    result = calibrate(at_temperatures(9.0))
    (warning,) = (warning for warning in result.warnings if "dark_current_doubling_k = 9 " in warning)
    assert any(f"doubles every {doubling}" in warning for doubling in ("6 ±", "5.9", "6.0"))
    assert result.estimates["dark_current_e_per_s"].value is None


def test_unknown_doubling_widens_the_dark_current() -> None:
    """Two kelvins leave 10 % of the dark current open: half a range either way, at 10 % per kelvin."""
    series = at_temperatures(None, 20.0, 22.0)
    result = calibrate(series)
    assert settle_temperature(series)[0] is series
    assert any("nothing tells how their dark current grows" in warning for warning in result.warnings)
    signal = result.estimates["dark_signal_dn_per_s"]
    assert signal.value is not None
    assert signal.se is not None
    assert signal.se >= 0.1 * signal.value


def test_error_of_the_doubling_follows_the_slope() -> None:
    """Levels that follow the line: the slope at other factors, by finite differences of a fit by numpy."""
    series = at_temperatures(None)
    darks, warmth = settle_temperature(series)
    assert warmth.doubling is not None
    moments = gather_moments(list(darks[:9]), [], np.ones((48, 48), bool))
    fit = NoiseFit({"offset_dn": 100.0, "dark_signal_dn_per_s": 5.0}, np.diag([1.0, 1e-6]), 0.0)
    far = replace(warmth, doubling=Estimate(DOUBLING_K, 0.1))
    grown = with_doubling_error(fit, moments, list(darks[:9]), far)
    level = np.array([dark.levels_dn.mean() for dark in series[:9]])
    kelvin = np.repeat([10.0, 20.0, 30.0], 3) - 20
    slopes = [np.polyfit(np.tile([0.01, 1.0, 10.0], 3) * 2 ** (kelvin / k), level, 1)[0] for k in (5.9, 6.1)]
    assert grown.covariance[1, 1] - 1e-6 == pytest.approx((0.5 * (slopes[1] - slopes[0])) ** 2, rel=0.05)
    assert with_doubling_error(fit, moments, list(darks[:9]), Warmth()) is fit
