"""Maps of a sensor's pixels show no more than their errors allow."""

import numpy as np
import pytest

from faintfield.pipelines.pages.page import blank_drawing, colour_bar
from faintfield.pipelines.pages.pixel_maps import colour_scale


@pytest.mark.parametrize("error", [0.0, 1e-4, 0.01, 0.13, 0.5, 2.0])
def test_steps_of_colours_exceed_errors(error: float) -> None:
    first, last, steps = colour_scale(3.0, 4.0, error)
    assert first <= 3.0
    assert last >= 4.0
    assert steps % 2 == 1
    assert (last - first) / steps >= error
    # No more of the range is given away than two steps: finer ones would still exceed the error
    assert (last - first) / (steps + 2) <= max(error, 1 / 255)


def test_pixels_that_hardly_differ_have_one_colour() -> None:
    """Posterior means scatter by a fraction of their error where the frames resolve no difference."""
    values = 0.2 + 0.001 * np.random.default_rng(1).uniform(-0.3, 0.3, 1000)
    first, last, steps = colour_scale(float(values.min()), float(values.max()), 0.001)
    assert np.unique(np.floor((values - first) / (last - first) * steps)).size == 1


def test_numbers_beside_colours_have_no_offset() -> None:
    figure, axes = blank_drawing(4, 3)
    colour_bar(figure, axes.imshow([[100.0, 100.001], [100.002, 100.003]]), axes, "DN")
    figure.draw_without_rendering()
    numbers = figure.axes[-1].yaxis
    assert numbers.get_offset_text().get_text() == ""
    assert "100.0010" in [label.get_text() for label in numbers.get_ticklabels()]
