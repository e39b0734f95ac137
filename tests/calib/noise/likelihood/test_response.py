"""The bend of a response against closed forms, dense regressions and simulated sensors."""

import numpy as np
import pytest
from scipy import stats

from faintfield.calib.noise.likelihood.response import (
    Light,
    charge_dn,
    charge_slope,
    choose_bends,
    fitted_linearity,
    known_light,
    level_log_likelihood,
    linearity_error,
    scatter_of_levels,
    signal_of_charge,
)
from faintfield.calib.noise.series import Conditions, Series
from faintfield.calib.noise.sums import measure_series

BENT = {"nonlinearity_per_dn": 2e-5, "nonlinearity_per_dn2": -3e-9}


def in_one_group(amount: np.ndarray) -> Light:
    return Light(amount, np.zeros(amount.size, int))


def flat(exposure_s: float, level: int = 0, photons: float | None = None) -> Series:
    return measure_series([("one", np.zeros((8, 8), int))], Conditions("flat", exposure_s, level, photons))


def test_charge_is_a_polynomial_of_the_signal() -> None:
    s = np.linspace(0.0, 4000.0, 9)
    polynomial = np.polynomial.Polynomial([0.0, 1.0, 2e-5, -3e-9])
    np.testing.assert_allclose(charge_dn(BENT, s), polynomial(s))
    np.testing.assert_allclose(charge_slope(BENT, s), polynomial.deriv()(s))
    np.testing.assert_allclose(signal_of_charge(BENT, polynomial(s), 4000.0), s, atol=1e-6)


def test_light_is_known_from_photons_or_exposures() -> None:
    stated = known_light([flat(0.1, level, 100.0 * (1 + level)) for level in range(3)])
    assert stated.amount.tolist() == [100, 200, 300]
    assert stated.group.tolist() == [0, 0, 0]
    by_time = known_light([flat(0.1), flat(0.2), flat(0.4), flat(0.1, 1), flat(0.3, 1)])
    assert by_time.group.tolist() == [0, 0, 0, -1, -1], "two exposures tell no bend"
    assert by_time.freedom == 2
    assert known_light([flat(0.1, level) for level in range(5)]).groups.size == 0
    assert known_light([flat(0.1), flat(0.12), flat(0.15)]).groups.size == 0, "light must differ by a factor of 2"


@pytest.mark.parametrize("changed", ["nonlinearity_per_dn", "offset_dn", "dark_signal_dn_per_s"])
def test_likelihood_of_levels_has_an_unknown_factor(changed: str) -> None:
    rng = np.random.default_rng(2)
    light = in_one_group(np.array([1.0, 2.0, 4.0, 7.0]))
    time_s, variance = np.array([0.1, 0.2, 0.1, 0.4]), np.array([0.2, 0.3, 0.5, 0.4])
    here = {"offset_dn": 20.0, "dark_signal_dn_per_s": 3.0, **BENT}
    there = here | {changed: here[changed] * 1.02}
    mean = 20.0 + 300.0 * light.amount * (1 - 0.004 * light.amount) + rng.normal(0, 0.5, 4)

    def dense(values: dict[str, float]) -> float:
        signal = mean - values["offset_dn"]
        charge = charge_dn(values, signal) - values["dark_signal_dn_per_s"] * time_s
        slope = charge_slope(values, signal)
        # A factor of unlimited size beside the noise; the density is one of the signal.
        covariance = np.diag(variance * slope**2) + 1e6 * np.outer(light.amount, light.amount)
        return float(stats.multivariate_normal(np.zeros(4), covariance).logpdf(charge) + np.log(slope).sum())

    ours = [float(level_log_likelihood(at, light, mean, time_s, variance.tolist())) for at in (here, there)]
    assert ours[1] - ours[0] == pytest.approx(dense(there) - dense(here), rel=0.01, abs=0.01)


def test_scatter_is_measured_about_a_bent_response() -> None:
    rng, light, scatter = np.random.default_rng(8), in_one_group(np.linspace(1.0, 20.0, 60)), []
    for _ in range(60):
        charge = 100.0 * light.amount * (1 + 0.004 * rng.standard_normal(60))
        scatter.append(scatter_of_levels(light, signal_of_charge(BENT, charge, 2000.0), np.full(60, 1e-4), 2)[0])
    assert np.mean(scatter) == pytest.approx(0.004**2, rel=0.1)


@pytest.mark.parametrize(("wave", "bends"), [(0.0, 4), (0.02, 5)])
def test_levels_demand_their_number_of_coefficients(wave: float, bends: int) -> None:
    rng, light = np.random.default_rng(1), in_one_group(np.linspace(1.0, 20.0, 40))
    signal = 100.0 * light.amount * (1 + wave * np.sin(light.amount / 2)) + rng.normal(0, 0.1, 40)
    assert choose_bends(light, signal, np.full(40, 0.01)) == bends
    three = in_one_group(light.amount[:3] * np.array([1, 2, 4]))
    assert choose_bends(three, 100 * three.amount, np.full(3, 0.01)) == 1
    assert choose_bends(Light(light.amount, np.full(40, -1)), signal, np.full(40, 0.01)) == 0


def test_linearity_error_is_that_of_a_weighted_line() -> None:
    light = np.linspace(1.0, 19.0, 10)
    signal = 50.0 * light * (1 - 0.001 * light)
    line = np.polyfit(light, signal, 1, w=1 / signal)
    expected = np.mean(np.abs(signal / np.polyval(line, light) - 1))
    assert linearity_error(signal, light) == pytest.approx(expected)
    assert linearity_error(3.0 + 7.0 * light, light) == pytest.approx(0.0, abs=1e-12), "an offset is no bend"
    values, amount = {"nonlinearity_per_dn": 2e-5}, np.linspace(1.0, 20.0, 20)
    bent = signal_of_charge(values, 50.0 * amount, 1000.0)
    levels = in_one_group(amount), bent, np.ones(20), float(bent.max())
    inside = (bent >= 0.05 * bent.max()) & (bent <= 0.95 * bent.max())
    assert fitted_linearity(values, *levels) == pytest.approx(linearity_error(bent[inside], amount[inside]), rel=1e-6)
    assert fitted_linearity({}, *levels) == pytest.approx(0.0, abs=1e-9)
    # Bends of twice their standard errors may be drawn that turn the charge of every level negative
    falling = in_one_group(np.linspace(0.1, 1.5, 16)), np.linspace(100, 1500, 16), np.ones(16), 1500.0
    assert fitted_linearity({"nonlinearity_per_dn": -8e-4, "nonlinearity_per_dn2": 1e-8}, *falling) is None
