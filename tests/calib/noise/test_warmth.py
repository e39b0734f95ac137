"""The growth of the dark current with temperature is found, or the reason is told."""

import re

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.noise.emva.warmth import dark_current_doubling

T = np.tile([0.1, 10.0, 60.0], 12)
WARMTH = np.repeat([10.0, 15.0, 20.0, 25.0], 9)


def levels(rng: np.random.Generator, doubling_k: float = 7.0, noise_dn: float = 0.05) -> NDArray[np.float64]:
    """The offset drifts by 0.3 DN per kelvin beside the dark current; long exposures are noisier."""
    level = 100 + 0.3 * WARMTH + 2.0 * T * 2 ** ((WARMTH - 17.5) / doubling_k)
    return np.asarray(level + noise_dn * np.sqrt(1 + T) * rng.standard_normal(T.size))


def test_the_doubling_temperature_is_found_within_its_interval() -> None:
    rng, held, found = np.random.default_rng(1), 0, []
    for _ in range(100):
        estimate = dark_current_doubling(levels(rng), T, WARMTH)
        assert estimate.value is not None
        assert estimate.ci95 is not None
        held += estimate.ci95[0] <= 7.0 <= estimate.ci95[1]
        found.append(estimate.value)
    assert 88 <= held <= 100
    assert np.mean(found) == pytest.approx(7.0, rel=1e-3)
    assert estimate.se == pytest.approx(np.std(found), rel=0.4)


@pytest.mark.parametrize(
    ("warmth", "words"),
    [
        (np.full(T.size, np.nan), "states its temperature"),
        (20 + 0.01 * WARMTH, r"differ by 0\.15 K \(limit 5 K\)"),
    ],
)
def test_temperatures_that_show_no_growth_are_told(warmth: NDArray[np.float64], words: str) -> None:
    estimate = dark_current_doubling(levels(np.random.default_rng(1)), T, warmth)
    assert estimate.value is None
    assert estimate.why is not None
    assert re.search(words, estimate.why)


def test_dark_current_that_drowns_in_noise_has_no_doubling() -> None:
    estimate = dark_current_doubling(levels(np.random.default_rng(1), noise_dn=500.0), T, WARMTH)
    assert estimate.value is None
    assert "too little dark current" in (estimate.why or "")


def test_frames_without_a_temperature_do_not_count() -> None:
    level = levels(np.random.default_rng(1))
    warmth = WARMTH.copy()
    level[3], warmth[3] = 1e6, np.nan
    assert dark_current_doubling(level, T, warmth).value == pytest.approx(7.0, rel=0.02)
