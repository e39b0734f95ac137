"""How dark a set is, on sets small enough to be reckoned by hand."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.overview import brightness

type SetMaker = Callable[..., Path]

NOISE = {
    "offset_dn": 100.0,
    "gain_dn_per_e": 2.0,
    "read_noise_e": 3.0,
    "dark_current_e_per_s": 0.4,
    "quantum_efficiency": 0.5,
}
DARK_E = 0.2  # in 0.5 s

# 4, 6, −1 and 3 electrons
VIEW = np.array([[108, 112], [98, 106]], np.uint16)


@pytest.fixture
def folder(make_set: SetMaker) -> Path:
    return make_set([VIEW], noise=NOISE, exposure_s=0.5)


def _write_region(folder: Path, region: NDArray[np.bool_]) -> None:
    cv2.imwrite(str(folder / "object_region.png"), np.where(region, 255, 0).astype(np.uint8))


def test_without_region_and_reference_the_whole_view_is_held_against_the_model(folder: Path) -> None:
    found = brightness(load_set(folder))
    assert (found.region, found.noise_from) == ("whole view", "noise model")
    noise_power = 9 + 1 / 48 + DARK_E + DARK_E**2
    assert found.snr is not None
    assert found.snr == pytest.approx(((16 + 36 + 1 + 9) / 4 - noise_power) / noise_power, rel=1e-6)
    assert found.mean_signal_e == pytest.approx(3.0 - DARK_E, rel=1e-6)
    assert found.photons_linear == pytest.approx(found.snr * 9 / 0.5, rel=1e-9)


def test_with_both_the_objects_are_held_against_an_exposure_of_nothing(folder: Path) -> None:
    _write_region(folder, np.array([[True, True], [False, False]]))
    tifffile.imwrite(folder / "noise_reference.tiff", np.array([[104, 96], [104, 98]], np.uint16))
    found = brightness(load_set(folder))
    assert (found.region, found.noise_from) == ("object region", "noise reference")
    assert found.snr == pytest.approx(((16 + 36) / 2 - (4 + 4 + 4 + 1) / 4) / ((4 + 4 + 4 + 1) / 4), rel=1e-6)
    assert found.mean_signal_e == pytest.approx(5.0 - DARK_E, rel=1e-6)


def test_counted_photons_are_those_of_a_uniform_object_of_that_snr(folder: Path) -> None:
    found = brightness(load_set(folder))
    assert found.snr is not None
    assert found.photons_from_moments is not None
    mean_e = 0.5 * found.photons_from_moments
    excess = (mean_e + DARK_E) ** 2 + mean_e - DARK_E**2
    assert excess / (9 + DARK_E + DARK_E**2) == pytest.approx(found.snr, rel=1e-9)


@pytest.mark.parametrize("level_dn", [100, 101])
def test_a_snr_that_is_not_positive_counts_no_photons(level_dn: int, make_set: SetMaker) -> None:
    found = brightness(load_set(make_set([np.full((2, 2), level_dn, np.uint16)], noise=NOISE)))
    assert found.snr is not None
    assert found.snr < 0
    assert found.photons_linear is found.photons_from_moments is None


def test_without_read_noise_there_is_no_snr(make_set: SetMaker) -> None:
    silent: dict[str, Any] = NOISE | {"read_noise_e": 0.0}
    found = brightness(load_set(make_set([VIEW], noise=silent, exposure_s=0.5)))
    assert found.snr is found.photons_linear is found.photons_from_moments is None
    assert found.mean_signal_e == pytest.approx(3.0 - DARK_E, rel=1e-6)


def test_the_colours_of_a_mosaic_count_together(make_set: SetMaker) -> None:
    grey = make_set([np.tile(VIEW, (2, 2))], name="grey", noise=NOISE, exposure_s=0.5)
    mosaic = make_set(
        [np.tile(VIEW, (2, 2))], name="mosaic", noise=NOISE, exposure_s=0.5, camera={"mosaic": ["RG", "GB"]}
    )
    for folder in (grey, mosaic):
        _write_region(folder, np.tile([[True, False], [True, True]], (2, 2)))
    first, second = brightness(load_set(grey)), brightness(load_set(mosaic))
    assert first.snr == pytest.approx(second.snr, rel=1e-9)
    assert first.mean_signal_e == pytest.approx(second.mean_signal_e, rel=1e-6)
