"""Figures of merit of EMVA 1288 against closed forms, and their errors against drawn measurements."""

import numpy as np
import pytest

from faintfield.calib.noise import Estimate
from faintfield.calib.noise.emva.quantities import (
    Inputs,
    dark_noise_e,
    derived_quantities,
    gather_inputs,
    propagate,
    snr,
    threshold_e,
)

GAIN, READ_E, CURRENT, EFFICIENCY, FULL_E = 0.5, 8.0, 0.2, 0.6, 10_000.0


def estimate(value: float, se: float) -> Estimate:
    return Estimate(value, se, (value - 1.959964 * se, value + 1.959964 * se))


def inputs(*, full_well: bool = False, **whys: str) -> Inputs:
    known = {
        "gain_dn_per_e": estimate(GAIN, 0.005),
        "read_noise_e": estimate(READ_E, 0.1),
        "dark_current_e_per_s": estimate(CURRENT, 0.01),
        "quantum_efficiency": estimate(EFFICIENCY, 0.008),
        "saturation_e": estimate(FULL_E, 150.0),
    }
    known |= {name: Estimate(None, why=why) for name, why in whys.items()}
    names = ("offset_dn", "gain_dn_per_e", "read_noise_e", "dark_current_e_per_s")
    covariance = np.diag([0.1, 0.005, 0.1, 0.01]) ** 2
    covariance[1, 2] = covariance[2, 1] = -0.8 * 0.005 * 0.1
    kept = [index for index, name in enumerate(names) if name not in whys]
    return gather_inputs(known, ([names[i] for i in kept], covariance[np.ix_(kept, kept)]), full_well=full_well)


def test_the_threshold_is_the_charge_at_which_snr_is_one() -> None:
    at = threshold_e(GAIN, READ_E)
    assert at == pytest.approx(np.sqrt(64 + (1 / 12) / 0.25 + 0.25) + 0.5)
    assert snr(np.array([at]), GAIN, READ_E) == pytest.approx(1, rel=1e-12)


def test_snr_without_noise_is_the_root_of_the_charge_and_prnu_limits_it() -> None:
    charge = np.array([100.0, 1e12])
    assert snr(charge, 1e9, 0.0) == pytest.approx(np.sqrt(charge))
    assert snr(charge[1:], GAIN, READ_E, dsnu_e=3.0, prnu=0.01) == pytest.approx(100, rel=1e-4)
    assert snr(np.array([1.0]), 1e9, 0.0, dsnu_e=3.0) == pytest.approx(1 / np.sqrt(10))


def test_each_quantity_is_its_formula() -> None:
    found = derived_quantities(inputs(), 10.0)
    noise = np.sqrt(READ_E**2 + CURRENT * 10)
    least = np.sqrt(noise**2 + 1 / 12 / GAIN**2 + 0.25) + 0.5
    assert {name: it.value for name, it in found.items()} == pytest.approx(
        {
            "dark_noise_e": noise,
            "responsivity_dn_per_photon": GAIN * EFFICIENCY,
            "threshold_e": least,
            "threshold_photons": least / EFFICIENCY,
            "saturation_photons": FULL_E / EFFICIENCY,
            "snr_max": np.sqrt(FULL_E),
            "dynamic_range": FULL_E / least,
        }
    )


def test_a_dark_current_below_zero_takes_no_noise_away() -> None:
    assert dark_noise_e(READ_E, -1.0, 100.0) == READ_E


def test_errors_that_follow_from_the_gain_cancel() -> None:
    """R = K η is known as well as the levels; so is μ_p.sat = μ_e.sat/η at the end of the converter."""
    found = derived_quantities(inputs(), 0.0)
    own_efficiency = np.sqrt(0.008**2 - (EFFICIENCY / GAIN * 0.005) ** 2) / EFFICIENCY
    own_full = np.sqrt(150**2 - (FULL_E / GAIN * 0.005) ** 2) / FULL_E
    responsivity, photons = found["responsivity_dn_per_photon"], found["saturation_photons"]
    assert responsivity.se == pytest.approx(GAIN * EFFICIENCY * own_efficiency, rel=1e-3)
    assert photons.se == pytest.approx(FULL_E / EFFICIENCY * np.hypot(own_efficiency, own_full), rel=1e-3)


def test_a_full_well_is_known_in_photons() -> None:
    photons = derived_quantities(inputs(full_well=True), 0.0)["saturation_photons"]
    own = FULL_E * np.sqrt(0.015**2 - (0.008 / EFFICIENCY) ** 2)
    assert photons.se == pytest.approx(own / EFFICIENCY, rel=1e-3)


def test_propagated_errors_are_those_of_drawn_measurements() -> None:
    given = inputs()
    draws = np.random.default_rng(1).multivariate_normal(list(given.values.values()), given.covariance, 20_000)
    gain, read, _, efficiency, full = draws.T
    least = np.sqrt(read**2 + 1 / 12 / gain**2 + 0.25) + 0.5
    found = derived_quantities(given, 0.0)
    for name, drawn in (("threshold_photons", least / efficiency), ("dynamic_range", full / least)):
        assert found[name].se == pytest.approx(drawn.std(), rel=0.02)
        ends = found[name].ci95
        assert ends is not None
        assert np.mean((drawn > ends[0]) & (drawn < ends[1])) == pytest.approx(0.95, abs=0.006)


def test_errors_of_the_bend_do_not_cancel() -> None:
    """An efficiency that has no error but that of the gain still rests on the bend of the response."""
    relative = 0.01
    known = {"gain_dn_per_e": estimate(GAIN, relative * GAIN), "read_noise_e": estimate(READ_E, 0.1)}
    known |= {
        "quantum_efficiency": estimate(EFFICIENCY, relative * EFFICIENCY),
        "saturation_e": Estimate(None, why="x"),
    }
    known |= {"dark_current_e_per_s": Estimate(None, why="x")}
    doubled = (GAIN * (1 - 4 * relative), GAIN * (1 + 4 * relative))
    wider = {**known, "gain_dn_per_e": Estimate(GAIN, relative * GAIN, doubled)}
    covariance = (["gain_dn_per_e", "read_noise_e"], np.diag([(relative * GAIN) ** 2, 0.1**2]))
    for given in (known, wider):
        inputs = gather_inputs(given, covariance, full_well=False, charge_error=1e-3)
        found = derived_quantities(inputs, 0.0)["responsivity_dn_per_photon"]
        assert found.se == pytest.approx(1e-3 * GAIN * EFFICIENCY, rel=1e-3)


def test_intervals_wider_than_normal_ones_stay_so() -> None:
    wide = Estimate(READ_E, 0.1, (READ_E - 0.3, READ_E + 0.3))
    known = {name: Estimate(None, why="x") for name in ("dark_current_e_per_s", "quantum_efficiency", "saturation_e")}
    given = gather_inputs(
        {**known, "gain_dn_per_e": estimate(GAIN, 0.005), "read_noise_e": wide},
        (["gain_dn_per_e", "read_noise_e"], np.diag([0.005**2, 0.1**2])),
        full_well=False,
    )
    ends = derived_quantities(given, 0.0)["dark_noise_e"].ci95
    assert ends is not None
    assert ends[1] - ends[0] == pytest.approx(0.6, rel=1e-3)


def test_what_is_missing_is_the_reason() -> None:
    found = derived_quantities(inputs(quantum_efficiency="no photons", saturation_e="not reached"), 0.0)
    assert found["threshold_photons"].why == found["responsivity_dn_per_photon"].why == "no photons"
    assert found["snr_max"].why == found["dynamic_range"].why == "not reached"
    assert found["threshold_e"].value is not None


def test_a_product_of_powers_has_the_error_of_its_logarithm() -> None:
    value, se = propagate(lambda a, b: a**3 / b, np.array([2.0, 5.0]), np.diag([0.02**2, 0.1**2]))
    assert value == pytest.approx(1.6)
    assert se == pytest.approx(1.6 * np.hypot(3 * 0.01, 0.02), rel=1e-4)
