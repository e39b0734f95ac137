"""Pictures of light: the tone curve of sRGB where the source had it, and hatching where nothing is known."""

import numpy as np
import pytest

from faintfield.pipelines.formats.exchange.imported_light import without_curve
from faintfield.pipelines.formats.image_files import light_picture


def test_tone_curve_gives_back_values_of_photograph() -> None:
    values = np.arange(256, dtype=np.uint8).reshape(16, 16)
    light = without_curve(values).astype(np.float32)
    shown = light_picture(light, 65535.0, tone_curve=True).astype(int)
    assert np.abs(shown - values).max() <= 1
    assert light_picture(light, 65535.0)[8, 0] < 60  # linear: middle grey is dark


@pytest.mark.parametrize("colours", [1, 3])
def test_unknown_samples_are_hatched_in_colour(colours: int) -> None:
    light = np.full((40, 40, colours), 0.5, np.float32)
    light[10:30, 10:30, 0] = np.nan
    levels = light_picture(light if colours == 3 else light[:, :, 0], 1.0).reshape(40, 40, -1)
    assert {tuple(rgb) for rgb in levels[10:30, 10:30].reshape(-1, 3).tolist()} == {(125, 0, 95), (240, 60, 205)}
    assert set(levels[:10].ravel().tolist()) == {128}
