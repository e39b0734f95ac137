"""Quantities with their intervals on fits with known numbers, the choice of a likelihood, and noise of all pixels."""

import numpy as np
import pytest
from scipy import stats

from faintfield.calib.estimate import NORMAL_QUANTILE, interval, root
from faintfield.calib.noise import Conditions, calibrate, measure_series
from faintfield.calib.noise.emva.conversion import _in_electrons, _levels_quantile, _why_no_current, _why_no_gain
from faintfield.calib.noise.likelihood.gaussian_fit import NoiseFit
from faintfield.calib.noise.likelihood.marginal import Counts
from faintfield.calib.noise.likelihood.moments import Moments, SeriesMoments
from faintfield.calib.noise.sensor_fit import NoiseLikelihood, _shared_noise_dn2, choose_likelihood
from tests.calib.noise.darkroom import dark_series, darks, flat_series, specimen

NAMES = ("offset_dn", "log_read_dn2", "dsnu_dn2", "jitter_dn2", "dark_signal_dn_per_s", "log_gain")


def fit(errors: dict[str, float] | None = None, **changes: float) -> NoiseFit:
    """Return a fit of 2 DN/e, read noise 3 e, dark current 0.2 e/s."""
    values = dict(zip(NAMES, (100.0, np.log(36.0), 9.0, 0.0, 0.4, np.log(2.0)), strict=True)) | changes
    sigma = [(errors or {}).get(name, 0.01) for name in values]
    return NoiseFit(values, np.diag(np.square(sigma)), 0.0)


def moments(*frames: float, exposure_s: tuple[float, ...] = (0.1, 10.0, 60.0)) -> Moments:
    several = np.array(frames or (10.0, 10.0, 10.0), float)
    zeros = np.zeros(len(several))
    darks = SeriesMoments(np.array(exposure_s), several, zeros, zeros, zeros, zeros, np.ones(len(several)))
    return Moments(3600.0, 3500.0, darks, np.zeros((len(several), len(several))))


def test_positive_quantities_have_logarithmic_intervals() -> None:
    plain = interval(-2.0, 0.1, 1.96)
    assert (plain.value, plain.se) == (-2.0, 0.1)
    assert plain.ci95 == pytest.approx((-2.196, -1.804))
    positive = interval(2.0, 0.1, 1.96, positive=True)
    assert positive.ci95 == pytest.approx((2 * np.exp(-0.098), 2 * np.exp(0.098)))


def test_interval_of_a_root_has_root_ends() -> None:
    estimate = root(4.0, 1.0, 0.5)
    low, high = 0.5 * np.sqrt(4 - NORMAL_QUANTILE), 0.5 * np.sqrt(4 + NORMAL_QUANTILE)
    assert estimate.value == 1.0
    assert estimate.ci95 == pytest.approx((low, high))
    assert estimate.se == pytest.approx((high - low) / (2 * NORMAL_QUANTILE))


def test_variance_far_below_zero_is_hidden() -> None:
    chance = root(-0.9, 1.0)
    assert chance.value == 0.0
    assert chance.ci95 == pytest.approx((0.0, np.sqrt(NORMAL_QUANTILE - 0.9)))
    assert root(-3.0, 1.0).ci95 == (0.0, 1.0), "never shorter than one standard error"
    hidden = root(-4.0, 1.0)
    assert hidden.value is None
    assert "by 4 standard errors" in str(hidden.why)
    assert root(0.5, 0.0).value is None


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


GAUSSIAN, EXACT = NoiseLikelihood.GAUSSIAN, NoiseLikelihood.EXACT

# A tenth of an electron of read noise leaves the electrons apart; ln r = 2 ln(0.2 DN)
SHARP = {"log_read_dn2": 2 * np.log(0.2)}

# Half an electron of many DN: only where the gain is known, and there is dark current
MANY_DN = {"log_gain": np.log(20.0), "log_read_dn2": 2 * np.log(8.0)}


@pytest.mark.parametrize(
    ("fitted", "shared_dn2", "floor_dn", "highest_dn", "likelihood"),
    [
        (fit(), 0.0, None, 150, GAUSSIAN),
        (fit(), 0.0, 90, 150, NoiseLikelihood.CENSORED),
        (fit(**SHARP), 0.0, None, 150, EXACT),
        (fit(**SHARP), 0.2**2, None, 150, GAUSSIAN),  # shared noise blurs electrons
        (fit(**SHARP), 0.0, None, 1_000_000, GAUSSIAN),
        (fit(**MANY_DN), 0.0, None, 150, EXACT),
        (fit({"log_gain": 0.6}, **MANY_DN), 0.0, None, 150, GAUSSIAN),
        (fit(**MANY_DN, dark_signal_dn_per_s=-0.1), 0.0, None, 150, GAUSSIAN),
    ],
)
def test_simplest_likelihood_that_holds_is_chosen(
    fitted: NoiseFit, shared_dn2: float, floor_dn: int | None, highest_dn: int, likelihood: NoiseLikelihood
) -> None:
    values = (np.array([[90, 110]], np.int32), np.array([[90, highest_dn]], np.int32))
    assert choose_likelihood(Counts((1.0, 60.0), values, floor_dn), fitted, shared_dn2) is likelihood


@pytest.mark.parametrize("banding_dn", [0.0, 0.6])
def test_shared_noise_is_jitter_and_banding(banding_dn: float) -> None:
    chip, rng = specimen(3, banding_dn=banding_dn)
    values = {"offset_dn": 100.0, "log_read_dn2": np.log(48.0), "dsnu_dn2": 9.0, "jitter_dn2": 0.3}
    dark = measure_series(darks(chip, [0.1], 60, rng)[0.1], Conditions("dark", 0.1))
    assert _shared_noise_dn2([dark], NoiseFit(values, np.eye(4), 0.0)) == pytest.approx(0.3 + banding_dn**2, abs=0.12)


def test_flats_sharpen_the_gain_of_single_electrons() -> None:
    chip, rng = specimen(5, read_noise_e=0.3, shape=(32, 32))
    series = dark_series(chip, (0.1, 10.0, 60.0), 6, rng)
    flats = [flat_series(chip, photons, 6, rng, level=k, exposure_s=1.0) for k, photons in enumerate((2000.0, 6000.0))]
    alone, both = calibrate(series), calibrate([*series, *flats])
    assert alone.likelihood is both.likelihood is NoiseLikelihood.EXACT
    before, after = (result.estimates["gain_dn_per_e"] for result in (alone, both))
    assert after.value == pytest.approx(2.0, rel=0.02)
    assert before.se is not None
    assert after.se is not None
    assert after.se < before.se
    assert abs((after.value or 0.0) - 2.0) < 4 * after.se
