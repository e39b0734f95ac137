"""The pure functions of `benchmarks.priors`: the search for the best σ, specks, spectra and tables."""

import numpy as np
import pytest

from benchmarks.bm3d_peer import least
from benchmarks.prior_faults import BANDS, Residual, power_by_band, specks
from benchmarks.priors import Outcome, Specks, error_table, residual_table, speck_table


@pytest.mark.parametrize(("best", "start", "found"), [(5, 0, 5), (-7, 3, -7), (0, 0, 0), (40, 0, 24), (-40, 2, -24)])
def test_the_search_ends_at_the_least_error_or_its_limit(best: int, start: int, found: int) -> None:
    tried: list[int] = []

    def error(step: int) -> float:
        tried.append(step)
        return float((step - best) ** 2)

    assert least(error, start, 24) == found
    assert len(tried) == len(set(tried))


def test_white_noise_has_its_variance_in_every_band() -> None:
    noise = np.random.default_rng(1).normal(0, 3, (256, 320))
    assert power_by_band(noise) == pytest.approx([9] * (len(BANDS) - 1), rel=0.15)


@pytest.mark.parametrize(("cycles", "band"), [(0.04, 0), (0.2, 2), (0.45, 5)])
def test_a_wave_has_its_power_in_the_band_of_its_frequency(cycles: float, band: int) -> None:
    wave = np.sin(2 * np.pi * cycles * np.arange(320)) * np.ones((200, 1))
    powers = power_by_band(wave)
    assert powers[band] > 0.99 * sum(powers)


def test_a_diagonal_wave_lies_at_the_length_of_its_frequency() -> None:
    rows, columns = np.mgrid[:200, :200]
    powers = power_by_band(np.sin(2 * np.pi * 0.2 * (rows + columns)))
    assert int(np.argmax(powers)) == 3  # 0.28 cycles per sample


def test_specks_are_dark_samples_that_shine_by_themselves() -> None:
    plane = np.full((40, 40), 0.1, np.float32)
    dark = np.ones(plane.shape, bool)
    plane[5, 5] = 1.0
    plane[10, 10] = 0.29  # less than three medians
    plane[:, 20:26] = 1.0  # a bar of light is no speck
    plane[30, 30] = 1.0
    dark[30, 30] = False  # the object itself
    assert np.argwhere(specks(plane, dark, 0.1)).tolist() == [[5, 5]]
    assert not specks(plane, dark, 0.34).any()


def outcome(name: str, seed: int, mse: float, found: Specks) -> Outcome:
    """Of SNR 0.16, by `auto`."""
    return Outcome(name, 0.16, seed, "auto", mse, 2 * mse, found)


def test_tables_hold_means_of_errors_and_sums_of_specks() -> None:
    few, none = Specks(5, 2, 1, 3, 4), Specks(0, 0, 0, 0, 0)
    given = [outcome("truck", 1, 0.004, few), outcome("truck", 2, 0.006, few), outcome("ball", 1, 0.001, none)]
    assert error_table(given)[-1] == "| SNR 0.16: auto | 5.00 / 10.00 | 1.00 / 2.00 | 3.00 / 6.00 |"
    assert speck_table(given)[-1] == "| SNR 0.16: auto | 10 | 4 | 2 | 6 | 8 |"
    without = [outcome("truck", 1, 0.004, Specks(5, 2, 1, 3, None))]
    assert speck_table(without)[-1].endswith("| – |")


def test_residuals_are_listed_with_their_bands() -> None:
    made = residual_table([Residual("even", "tv", 0.25, 0.5, 4.0, (1.0,) * 6)])
    assert made[0].count("–") == 6
    assert made[-1] == "| even: tv | 0.25 | 0.5 | 4 | 1 | 1 | 1 | 1 | 1 | 1 |"
