"""Brightness and object region of a set, on sets small enough to be computed by hand."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.formats.image_files import mask_picture, write_png
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.overview import OBJECT_REGION, brightness, object_region, segmented
from tests.pipelines.conftest import SetMaker

_SENSOR = {"offset_dn": 100.0, "gain_dn_per_e": 2.0, "read_noise_e": 3.0}
NOISE: dict[str, Any] = _SENSOR | {"dark_current_e_per_s": 0.4, "quantum_efficiency": 0.5}
DARK_E = 0.2  # in 0.5 s

# 4, 6, −1 and 3 electrons
VIEW = np.array([[108, 112], [98, 106]], np.uint16)

SIZE = (48, 64)


def _write_region(folder: Path, region: NDArray[np.bool_]) -> None:
    write_png(folder / OBJECT_REGION, mask_picture(region))


def test_brightness_by_noise_model_and_noise_reference(make_set: SetMaker) -> None:
    folder = make_set([VIEW], noise=NOISE)
    found = brightness(load_set(folder))
    assert (found.region, found.noise_from) == ("whole view", "noise model")
    noise_power = 9 + 1 / 48 + DARK_E + DARK_E**2
    assert found.snr is not None
    assert found.snr == pytest.approx(((16 + 36 + 1 + 9) / 4 - noise_power) / noise_power, rel=1e-6)
    assert found.mean_signal_e == pytest.approx(3.0 - DARK_E, rel=1e-6)
    assert found.photons_linear == pytest.approx(found.snr * 9 / 0.5, rel=1e-9)
    # Counted photons are those of a uniform object of the same SNR
    assert found.photons_from_moments is not None
    mean_e = 0.5 * found.photons_from_moments
    excess = (mean_e + DARK_E) ** 2 + mean_e - DARK_E**2
    assert excess / (9 + DARK_E + DARK_E**2) == pytest.approx(found.snr, rel=1e-9)
    _write_region(folder, np.array([[True, True], [False, False]]))
    tifffile.imwrite(folder / "noise_reference.tiff", np.array([[104, 96], [104, 98]], np.uint16))
    found = brightness(load_set(folder))
    assert (found.region, found.noise_from) == ("object region", "noise reference")
    assert found.snr == pytest.approx(((16 + 36) / 2 - (4 + 4 + 4 + 1) / 4) / ((4 + 4 + 4 + 1) / 4), rel=1e-6)
    assert found.mean_signal_e == pytest.approx(5.0 - DARK_E, rel=1e-6)


@pytest.mark.parametrize("frames", [1, 2])
def test_short_noise_reference_counts_as_whole_view(make_set: SetMaker, tmp_path: Path, frames: int) -> None:
    """Eight frames in a view, in which dark current varies from pixel to pixel and there is stray light."""
    generator, shape = np.random.default_rng(8), (96, 128)
    dark_e = generator.uniform(0.0, 4.0, shape)
    paths = [tmp_path / f"no_light_{number}.tiff" for number in range(8)]
    for path in paths:
        frame_e = generator.poisson(dark_e + 0.5) + generator.normal(0.0, 3.0, shape)
        tifffile.imwrite(path, np.round(100.0 + 2.0 * frame_e).astype(np.uint16))
    view = np.round(100.0 + 2.0 * generator.poisson(dark_e + 5.0)).astype(np.uint16)
    loaded = load_set(make_set([view], noise=NOISE, exposure_s=4.0))
    [seen] = loaded.settings.view
    settings = msgspec.structs.replace(loaded.settings, view=[msgspec.structs.replace(seen, repeats=(seen.image,) * 7)])
    noise = replace(loaded.noise, dark_current_e_per_s=2.0 * dark_e)
    whole = replace(loaded, settings=settings, noise=noise, noise_reference=tuple(paths))
    expected, found = (
        brightness(elemental_set) for elemental_set in (whole, replace(whole, noise_reference=tuple(paths[:frames])))
    )
    assert found.noise_from == expected.noise_from == "noise reference"
    assert found.snr is not None
    assert expected.snr is not None
    assert 1 + found.snr == pytest.approx(1 + expected.snr, rel=0.03)


def test_no_snr_or_negative_counts_no_photons(make_set: SetMaker) -> None:
    found = brightness(load_set(make_set([np.full((2, 2), 101, np.uint16)], noise=NOISE)))
    assert found.snr is not None
    assert found.snr < 0
    assert found.photons_linear is found.photons_from_moments is None
    noiseless = make_set([VIEW], name="noiseless", noise=NOISE | {"read_noise_e": 0.0})
    found = brightness(load_set(noiseless))
    assert found.snr is found.photons_linear is found.photons_from_moments is None
    assert found.mean_signal_e == pytest.approx(3.0 - DARK_E, rel=1e-6)


def test_colours_of_mosaic_count_together(make_set: SetMaker) -> None:
    views = [np.tile(VIEW, (2, 2))]
    grey = make_set(views, name="grey", noise=NOISE)
    mosaic = make_set(views, name="mosaic", noise=NOISE, camera={"mosaic": ["RG", "GB"]})
    for folder in (grey, mosaic):
        _write_region(folder, np.tile([[True, False], [True, True]], (2, 2)))
    first, second = brightness(load_set(grey)), brightness(load_set(mosaic))
    assert first.snr == pytest.approx(second.snr, rel=1e-9)
    assert first.mean_signal_e == pytest.approx(second.mean_signal_e, rel=1e-6)


def _object() -> NDArray[np.bool_]:
    row, column = np.indices(SIZE)
    return np.asarray((row - 20) ** 2 + (column - 30) ** 2 < 15**2)


def _light_e(darkest: float) -> NDArray[np.float32]:
    """Return an object whose brightness runs from `darkest` to 1000 e⁻, with its shot noise, on a dark ground."""
    brightness_e = np.where(_object(), np.linspace(darkest, 1000, SIZE[1]), 1.0)
    generator = np.random.default_rng(5)
    return np.asarray(generator.poisson(brightness_e) + generator.normal(0, 3, SIZE), np.float32)


def test_dark_parts_of_object_belong_to_it() -> None:
    light_e, usable = _light_e(250.0), np.ones(SIZE, bool)
    light_e[2, 3], usable[2, 3] = 1e6, False  # moves no threshold
    region = segmented(light_e, usable)
    assert region is not None
    assert not region[2, 3]
    assert np.mean(region == _object()) > 0.995
    assert segmented(np.full(SIZE, 7.0, np.float32), np.ones(SIZE, bool)) is None


def test_object_region_of_set_precedes_bright_view(make_set: SetMaker, tmp_path: Path) -> None:
    dark_dn = np.where(_object(), 108, 100).astype(np.uint16)
    elemental_set = load_set(make_set([dark_dn], noise=NOISE | {"dark_current_e_per_s": 0.0}))
    assert object_region(elemental_set) == (None, "whole view")
    bright = tmp_path / "bright.tiff"
    tifffile.imwrite(bright, np.asarray(np.clip(100 + 2 * _light_e(600.0), 0, 65535), np.uint16))
    elemental_set = replace(elemental_set, bright_view=(bright, 0.1))
    by_bright_view = brightness(elemental_set)
    assert by_bright_view.region == "object region of the bright view"
    assert by_bright_view.mean_signal_e == pytest.approx(4.0, rel=0.01)
    _write_region(elemental_set.folder, ~_object())
    assert brightness(elemental_set).region == "object region"
    assert brightness(elemental_set).mean_signal_e == pytest.approx(0.0, abs=1e-6)
