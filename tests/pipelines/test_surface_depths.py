"""Maps of bins on the samples of a picture, against a search of each sample; samples between pixels."""

import numpy as np
import pytest

from faintfield.pipelines.reconstruction.comparison import BETWEEN_PIXELS
from faintfield.pipelines.reconstruction.surface_depths import between_pixels, enlarged
from tests.recon.surface_scene import expected_light, views_of


@pytest.mark.parametrize("bins", [2, 3])
@pytest.mark.parametrize("moved", [0.0, BETWEEN_PIXELS])
def test_each_sample_has_value_of_nearest_bin(bins: int, moved: float) -> None:
    generator = np.random.default_rng(1)
    part, shape = generator.normal(size=(6, 8)), (6 * bins + bins // 2, 8 * bins + bins - 1)
    # The middle of bin k lies at pixel bins (k + ½) − ½; its sample lies further right and below
    middles = [bins * (np.arange(count) + 0.5 + moved) - 0.5 for count in part.shape]
    expected = np.empty(shape)
    for row, column in np.ndindex(shape):
        i, j = (int(np.abs(middle - at).argmin()) for middle, at in zip(middles, (row, column), strict=True))
        expected[row, column] = part[i, j]
    np.testing.assert_array_equal(enlarged(part, shape, bins, moved=moved), expected)


def test_samples_between_pixels_blur_as_much_as_samples_anywhere() -> None:
    def kept(place: float) -> float:
        return (1 - place) ** 2 + place**2

    anywhere = np.mean([kept(place) for place in (np.arange(1000) + 0.5) / 1000])
    assert kept(BETWEEN_PIXELS) == pytest.approx(anywhere, rel=1e-5)
    views = views_of(expected_light(1.0))
    before, after = views.grid, between_pixels(views).grid
    moved_mm = np.subtract(after.origin_mm, before.origin_mm)
    np.testing.assert_allclose(moved_mm, BETWEEN_PIXELS * before.pitch_mm, rtol=1e-9)
    assert (after.shape, after.pitch_mm) == (before.shape, before.pitch_mm)
