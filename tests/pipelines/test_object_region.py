"""The object region: as a set states it, or segmented on a view in plenty of light."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.formats.image_files import mask_picture, write_png
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.overview import OBJECT_REGION, brightness, object_region, segmented
from tests.pipelines.conftest import SetMaker

SIZE = (48, 64)
NOISE = {"offset_dn": 100.0, "gain_dn_per_e": 2.0, "read_noise_e": 3.0, "dark_current_e_per_s": 0.0}


def _object() -> NDArray[np.bool_]:
    row, column = np.indices(SIZE)
    return np.asarray((row - 20) ** 2 + (column - 30) ** 2 < 15**2)


def _light_e(darkest: float) -> NDArray[np.float32]:
    """Return an object whose brightness runs from `darkest` to 1000 e⁻, with its shot noise, on a dark ground."""
    brightness_e = np.where(_object(), np.linspace(darkest, 1000, SIZE[1]), 1.0)
    generator = np.random.default_rng(5)
    return np.asarray(generator.poisson(brightness_e) + generator.normal(0, 3, SIZE), np.float32)


@pytest.mark.parametrize("darkest", [250.0, 600.0])
def test_dark_parts_of_object_belong_to_it(darkest: float) -> None:
    found = segmented(_light_e(darkest), np.ones(SIZE, bool))
    assert found is not None
    assert np.mean(found == _object()) > 0.995


def test_unusable_pixels_are_no_object_and_move_no_threshold() -> None:
    light_e, usable = _light_e(250.0), np.ones(SIZE, bool)
    light_e[2, 3], usable[2, 3] = 1e6, False
    found = segmented(light_e, usable)
    assert found is not None
    assert not found[2, 3]
    assert np.mean(found == _object()) > 0.995


def test_view_of_one_brightness_has_no_region() -> None:
    assert segmented(np.full(SIZE, 7.0, np.float32), np.ones(SIZE, bool)) is None


def test_object_region_of_set_precedes_bright_view(make_set: SetMaker, tmp_path: Path) -> None:
    dark_dn = np.where(_object(), 108, 100).astype(np.uint16)
    loaded = load_set(make_set([dark_dn], noise=NOISE))
    assert object_region(loaded) == (None, "whole view")
    bright = tmp_path / "bright.tiff"
    tifffile.imwrite(bright, np.asarray(np.clip(100 + 2 * _light_e(600.0), 0, 65535), np.uint16))
    loaded = replace(loaded, bright_view=(bright, 0.1))
    found = brightness(loaded)
    assert found.region == "object region of the bright view"
    assert found.mean_signal_e == pytest.approx(4.0, rel=0.01)
    write_png(loaded.folder / OBJECT_REGION, mask_picture(~_object()))
    assert brightness(loaded).region == "object region"
    assert brightness(loaded).mean_signal_e == pytest.approx(0.0, abs=1e-6)
