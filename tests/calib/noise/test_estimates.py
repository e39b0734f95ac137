"""Quantities with their intervals, and the choice of the likelihood, on fits with known numbers."""

import numpy as np
import pytest
from scipy import stats

from faintfield.calib.noise import Conditions, measure_series
from faintfield.calib.noise.estimates import (
    _in_electrons,
    _levels_quantile,
    _light_e,
    _why_no_current,
    _why_no_gain,
)
from faintfield.calib.noise.fitting import NoiseLikelihood, choose_likelihood
from faintfield.calib.noise.intervals import interval, root
from faintfield.calib.noise.likelihood.marginal import Counts
from faintfield.calib.noise.likelihood.maximum import NoiseFit
from faintfield.calib.noise.likelihood.moments import DarkMoments, FlatMoments, Moments
from tests.calib.noise.darkroom import darks, specimen

NAMES = ("offset_dn", "log_read_dn2", "dsnu_dn2", "jitter_dn2", "dark_signal_dn_per_s", "log_gain")


def fit(errors: dict[str, float] | None = None, **changes: float) -> NoiseFit:
    """Return a fit of 2 DN/e, read noise 3 e, dark current 0.2 e/s."""
    values = dict(zip(NAMES, (100.0, np.log(36.0), 9.0, 0.0, 0.4, np.log(2.0)), strict=True)) | changes
    sigma = [(errors or {}).get(name, 0.01) for name in values]
    return NoiseFit(values, np.diag(np.square(sigma)), 0.0)


def moments(*frames: float, exposure_s: tuple[float, ...] = (0.1, 10.0, 60.0)) -> Moments:
    several = np.array(frames or (10.0, 10.0, 10.0))
    zeros = np.zeros(len(several))
    darks = DarkMoments(np.array(exposure_s), several, zeros, zeros, zeros, np.zeros((len(several), len(several))))
    return Moments(3600.0, 3500.0, darks, FlatMoments(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0)))


def test_intervals_are_symmetric_and_those_of_positive_quantities_on_a_logarithmic_scale() -> None:
    plain = interval(-2.0, 0.1, 1.96)
    assert (plain.value, plain.se) == (-2.0, 0.1)
    assert plain.ci95 == pytest.approx((-2.196, -1.804))
    positive = interval(2.0, 0.1, 1.96, positive=True)
    assert positive.ci95 == pytest.approx((2 * np.exp(-0.098), 2 * np.exp(0.098)))


def test_the_root_of_a_variance_has_the_roots_of_the_ends_as_itsinterval() -> None:
    found = root(4.0, 1.0, 1.96, 0.5)
    low, high = 0.5 * np.sqrt(4 - 1.96), 0.5 * np.sqrt(4 + 1.96)
    assert found.value == 1.0
    assert found.ci95 == pytest.approx((low, high))
    assert found.se == pytest.approx((high - low) / 3.92)


def test_a_variance_below_zero_is_none_unless_chance_explains_it() -> None:
    chance = root(-0.9, 1.0, 1.96)
    assert chance.value == 0.0
    assert chance.ci95 == pytest.approx((0.0, np.sqrt(1.06)))
    assert root(-3.0, 1.0, 1.96).ci95 == (0.0, 1.0), "never shorter than one standard error"
    hidden = root(-4.0, 1.0, 1.96)
    assert hidden.value is None
    assert "by 4 standard errors" in str(hidden.why)
    assert root(0.5, 0.0, 1.96).value is None


def test_levels_with_jitter_have_students_intervals_of_their_few_frames() -> None:
    normal, pixel_part = stats.norm.ppf(0.975), 36.0 / 3600.0
    assert _levels_quantile(fit(jitter_dn2=0.4 * pixel_part), moments(3.0, 4.0, 2.0)) == pytest.approx(normal)
    assert _levels_quantile(fit(jitter_dn2=0.6 * pixel_part), moments(3.0, 4.0, 2.0)) == pytest.approx(
        stats.t.ppf(0.975, 6)
    )
    assert _levels_quantile(fit(jitter_dn2=1.0), moments(1.0, 1.0, 1.0)) == pytest.approx(normal)
    assert _levels_quantile(fit(jitter_dn2=1.0), moments(2.0, 1.0, 1.0)) == pytest.approx(stats.t.ppf(0.975, 1))


@pytest.mark.parametrize(("error", "known"), [(0.1, True), (0.11, False), (np.nan, False)])
def test_the_gain_is_known_when_its_error_is_a_tenth_at_most(error: float, known: bool) -> None:
    why = _why_no_gain(fit({"log_gain": error}), moments(), from_darks=True, holds=True)
    assert (why is None) == known


def test_darks_that_contradict_the_model_give_no_gain_but_flats_do() -> None:
    assert "contradict the model" in str(_why_no_gain(fit(), moments(), from_darks=True, holds=False))
    assert _why_no_gain(fit(), moments(), from_darks=False, holds=False) is None


@pytest.mark.parametrize(
    ("signal", "error", "words"),
    [
        (0.4, 0.03, None),
        (0.4, 0.05, "standard error would be 0.025 e-/s, which over 60 s"),  # 1.5 e against a tenth of 9 e²
        (0.01, 0.02, None),  # 0.6 e over 60 s do not matter
        (-0.03, 0.01, "falls with exposure time"),
        (-0.02, 0.04, "does not rise with exposure time"),
    ],
)
def test_the_dark_current_is_known_when_its_error_does_not_matter(
    signal: float, error: float, words: str | None
) -> None:
    found = _why_no_current(
        fit({"dark_signal_dn_per_s": error}, dark_signal_dn_per_s=signal), moments(), None, 1.96, levels_hold=True
    )
    assert (found is None) == (words is None)
    assert (words or "") in str(found)


def test_quantities_in_electrons_carry_their_covariance() -> None:
    whys = dict.fromkeys(("offset_dn", "gain_dn_per_e", "read_noise_e", "dark_current_e_per_s"))
    errors = {"offset_dn": 0.5, "log_read_dn2": 0.04, "dark_signal_dn_per_s": 0.02, "log_gain": 0.03}
    found, (names, covariance) = _in_electrons(fit(errors), whys, 2.0, 3.0)
    assert names == tuple(whys)
    # read noise √r/g, dark current d/g; errors of ln r, ln g and d are independent
    assert found["read_noise_e"].value == pytest.approx(3.0)
    assert found["read_noise_e"].se == pytest.approx(3.0 * np.hypot(0.5 * 0.04, 0.03))
    assert found["dark_current_e_per_s"].se == pytest.approx(np.hypot(0.02 / 2, 0.2 * 0.03))
    assert covariance[1, 2] == pytest.approx(-(2.0 * 0.03) * (3.0 * 0.03))
    assert found["offset_dn"].ci95 == pytest.approx((98.5, 101.5))
    assert found["gain_dn_per_e"].ci95 == pytest.approx((2 * np.exp(-0.06), 2 * np.exp(0.06)))
    without, (names, covariance) = _in_electrons(fit(errors), whys | {"read_noise_e": "for a reason"}, 2.0, 3.0)
    assert names == ("offset_dn", "gain_dn_per_e", "dark_current_e_per_s")
    assert covariance.shape == (3, 3)
    assert without["read_noise_e"].why == "for a reason"


def counts(floor_dn: int | None = None, highest_dn: int = 150) -> Counts:
    return Counts((1.0, 60.0), (np.array([[90, 110]], np.int32), np.array([[90, highest_dn]], np.int32)), floor_dn)


def test_the_simplest_likelihood_that_holds_is_chosen() -> None:
    assert choose_likelihood(counts(), fit(), 0.0) is NoiseLikelihood.GAUSSIAN
    assert choose_likelihood(counts(floor_dn=90), fit(), 0.0) is NoiseLikelihood.CENSORED
    # A tenth of an electron of read noise leaves the electrons apart; ln r = 2 ln(0.2 DN)
    sharp = {"log_read_dn2": 2 * np.log(0.2)}
    assert choose_likelihood(counts(), fit(**sharp), 0.0) is NoiseLikelihood.EXACT
    assert choose_likelihood(counts(), fit(**sharp), 0.2**2) is NoiseLikelihood.GAUSSIAN, "shared noise blurs them"
    assert choose_likelihood(counts(highest_dn=1_000_000), fit(**sharp), 0.0) is NoiseLikelihood.GAUSSIAN
    # Half an electron of many DN: only where the gain is known, and there is dark current
    many_dn = {"log_gain": np.log(20.0), "log_read_dn2": 2 * np.log(8.0)}
    assert choose_likelihood(counts(), fit(**many_dn), 0.0) is NoiseLikelihood.EXACT
    assert choose_likelihood(counts(), fit({"log_gain": 0.6}, **many_dn), 0.0) is NoiseLikelihood.GAUSSIAN
    assert choose_likelihood(counts(), fit(**many_dn, dark_signal_dn_per_s=-0.1), 0.0) is NoiseLikelihood.GAUSSIAN


def test_the_electrons_of_a_flat_are_its_bent_signal_less_the_dark_current() -> None:
    chip, rng = specimen(1, shape=(16, 16))
    flat = measure_series(darks(chip, [2.0], 3, rng)[2.0], Conditions("flat", 2.0))
    bent = fit(nonlinearity_per_dn=1e-4)
    # The charge behind a signal s is s (1 + κ s), of which d t is dark
    assert _light_e(bent, flat, 2100.0) == pytest.approx((2000.0 * 1.2 - 0.4 * 2.0) / 2.0)
    assert _light_e(fit(), flat, 2100.0) == pytest.approx((2000.0 - 0.8) / 2.0)
