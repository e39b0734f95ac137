"""Quantities with their intervals on fits with known numbers."""

import numpy as np
import pytest
from scipy import stats

from faintfield.calib.noise.emva.estimates import _in_electrons, _levels_quantile, _why_no_current, _why_no_gain
from faintfield.calib.noise.estimate import interval, root
from faintfield.calib.noise.likelihood.maximum import NoiseFit
from faintfield.calib.noise.likelihood.moments import DarkMoments, FlatMoments, Moments

NAMES = ("offset_dn", "log_read_dn2", "dsnu_dn2", "jitter_dn2", "dark_signal_dn_per_s", "log_gain")


def fit(errors: dict[str, float] | None = None, **changes: float) -> NoiseFit:
    """Return a fit of 2 DN/e, read noise 3 e, dark current 0.2 e/s."""
    values = dict(zip(NAMES, (100.0, np.log(36.0), 9.0, 0.0, 0.4, np.log(2.0)), strict=True)) | changes
    sigma = [(errors or {}).get(name, 0.01) for name in values]
    return NoiseFit(values, np.diag(np.square(sigma)), 0.0)


def moments(*frames: float, exposure_s: tuple[float, ...] = (0.1, 10.0, 60.0)) -> Moments:
    several = np.array(frames or (10.0, 10.0, 10.0), float)
    zeros = np.zeros(len(several))
    darks = DarkMoments(
        np.array(exposure_s), several, zeros, zeros, zeros, np.zeros((len(several), len(several))), zeros
    )
    return Moments(3600.0, 3500.0, darks, FlatMoments(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0)))


def test_positive_quantities_have_logarithmic_intervals() -> None:
    plain = interval(-2.0, 0.1, 1.96)
    assert (plain.value, plain.se) == (-2.0, 0.1)
    assert plain.ci95 == pytest.approx((-2.196, -1.804))
    positive = interval(2.0, 0.1, 1.96, positive=True)
    assert positive.ci95 == pytest.approx((2 * np.exp(-0.098), 2 * np.exp(0.098)))


def test_interval_of_a_root_has_root_ends() -> None:
    estimate = root(4.0, 1.0, 1.96, 0.5)
    low, high = 0.5 * np.sqrt(4 - 1.96), 0.5 * np.sqrt(4 + 1.96)
    assert estimate.value == 1.0
    assert estimate.ci95 == pytest.approx((low, high))
    assert estimate.se == pytest.approx((high - low) / 3.92)


def test_variance_far_below_zero_is_hidden() -> None:
    chance = root(-0.9, 1.0, 1.96)
    assert chance.value == 0.0
    assert chance.ci95 == pytest.approx((0.0, np.sqrt(1.06)))
    assert root(-3.0, 1.0, 1.96).ci95 == (0.0, 1.0), "never shorter than one standard error"
    hidden = root(-4.0, 1.0, 1.96)
    assert hidden.value is None
    assert "by 4 standard errors" in str(hidden.why)
    assert root(0.5, 0.0, 1.96).value is None


@pytest.mark.parametrize(
    ("jitter_share", "frames", "freedom"),
    [
        (0.4, (3.0, 4.0, 2.0), np.inf),
        (0.6, (3.0, 4.0, 2.0), 6),
        (9.0, (1.0, 1.0, 1.0), np.inf),
        (9.0, (2.0, 1.0, 1.0), 1),
    ],
)
def test_levels_with_jitter_have_students_intervals(
    jitter_share: float, frames: tuple[float, ...], freedom: float
) -> None:
    jitter_dn2 = jitter_share * 36.0 / 3600.0  # the part of the pixels' noise in a level
    quantile = _levels_quantile(fit(jitter_dn2=jitter_dn2), moments(*frames))
    assert quantile == pytest.approx(stats.t.ppf(0.975, freedom))


@pytest.mark.parametrize(("error", "known"), [(0.1, True), (0.11, False), (np.nan, False)])
def test_gain_is_known_within_a_tenth(error: float, known: bool) -> None:
    why = _why_no_gain(fit({"log_gain": error}), moments(), from_darks=True, holds=True)
    assert (why is None) == known
    contradicted = _why_no_gain(fit({"log_gain": error}), moments(), from_darks=True, holds=False)
    assert "contradict the model" in str(contradicted) or not known
    assert (_why_no_gain(fit({"log_gain": error}), moments(), from_darks=False, holds=False) is None) == known


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
def test_dark_current_is_known_unless_its_error_matters(signal: float, error: float, words: str | None) -> None:
    why = _why_no_current(
        fit({"dark_signal_dn_per_s": error}, dark_signal_dn_per_s=signal), moments(), None, 1.96, levels_hold=True
    )
    assert (why is None) == (words is None)
    assert (words or "") in str(why)


def test_quantities_in_electrons_carry_their_covariance() -> None:
    whys = dict.fromkeys(("offset_dn", "gain_dn_per_e", "read_noise_e", "dark_current_e_per_s"))
    errors = {"offset_dn": 0.5, "log_read_dn2": 0.04, "dark_signal_dn_per_s": 0.02, "log_gain": 0.03}
    estimates, (names, covariance) = _in_electrons(fit(errors), whys, 2.0, 3.0)
    assert names == tuple(whys)
    # read noise √r/g, dark current d/g; errors of ln r, ln g and d are independent
    assert estimates["read_noise_e"].value == pytest.approx(3.0)
    assert estimates["read_noise_e"].se == pytest.approx(3.0 * np.hypot(0.5 * 0.04, 0.03))
    assert estimates["dark_current_e_per_s"].se == pytest.approx(np.hypot(0.02 / 2, 0.2 * 0.03))
    assert covariance[1, 2] == pytest.approx(-(2.0 * 0.03) * (3.0 * 0.03))
    assert estimates["offset_dn"].ci95 == pytest.approx((98.5, 101.5))
    assert estimates["gain_dn_per_e"].ci95 == pytest.approx((2 * np.exp(-0.06), 2 * np.exp(0.06)))
    without, (names, covariance) = _in_electrons(fit(errors), whys | {"read_noise_e": "for a reason"}, 2.0, 3.0)
    assert names == ("offset_dn", "gain_dn_per_e", "dark_current_e_per_s")
    assert covariance.shape == (3, 3)
    assert without["read_noise_e"].why == "for a reason"
