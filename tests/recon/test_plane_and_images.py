"""Plane grids and elemental images: their values and their errors."""

from typing import Any

import numpy as np
import pytest

from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.operator.grid import PlaneGrid


def test_sample_indices_count_pitches_from_the_first_samples_centre() -> None:
    grid = PlaneGrid((3, 5), 0.5, (-1.0, 2.0))
    column, row, one = grid.index_from_plane() @ [0.0, 3.0, 1.0]
    assert (column, row, one) == (2.0, 2.0, 1.0)


@pytest.mark.parametrize(
    ("shape", "pitch_mm", "words"),
    [
        ((1, 5), 1.0, "at least 2 x 2"),
        ((5, 5), 0.0, "pitch_mm"),
        ((5, 5), float("nan"), "pitch_mm"),
    ],
)
def test_grids_without_area_are_refused(shape: tuple[int, int], pitch_mm: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        PlaneGrid(shape, pitch_mm, (0.0, 0.0))


def test_origins_that_are_not_finite_are_refused() -> None:
    origin_mm = (0.0, float("inf"))
    with pytest.raises(ValueError, match="origin_mm"):
        PlaneGrid((5, 5), 1.0, origin_mm)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"electrons": np.zeros((3, 4))}, "view, row, column"),
        ({"valid": np.ones((2, 4, 3), bool)}, "valid has shape"),
        ({"electrons": np.where(np.arange(24) == 17, np.nan, 0.0).reshape(2, 3, 4)}, "view 1 has 1 pixels"),
    ],
)
def test_images_that_do_not_fit_or_are_not_numbers_are_refused(parts: dict[str, Any], words: str) -> None:
    ElementalImages(np.zeros((2, 3, 4)))
    with pytest.raises(ValueError, match=words):
        ElementalImages(**{"electrons": np.zeros((2, 3, 4)), **parts})


def test_invalid_pixels_may_hold_anything() -> None:
    electrons, valid = np.zeros((2, 3, 4)), np.ones((2, 3, 4), bool)
    electrons[1, 2, 0], valid[1, 2, 0] = np.nan, False
    assert np.isnan(ElementalImages(electrons, valid=valid).electrons[1, 2, 0])
