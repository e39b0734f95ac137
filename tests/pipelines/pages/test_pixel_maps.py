"""Maps of a sensor's pixels show no more than their errors allow."""

import re

import numpy as np
import pytest

from faintfield.calib.estimate import Estimate
from faintfield.calib.noise import NoiseCalibration, SeriesSums, calibrate
from faintfield.calib.noise.series import Conditions
from faintfield.pipelines.calibration.noise import Lattice
from faintfield.pipelines.pages.page import blank_drawing, colour_bar
from faintfield.pipelines.pages.pixel_maps import colour_scale, hidden_variance, map_drawings


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


def test_errors_hold_where_spread_is_larger_than_estimated() -> None:
    rng = np.random.default_rng(4)
    estimated, true, noise, count = 0.3, 0.8, 0.5, 200_000
    offset = rng.normal(0, true, count)
    kept = estimated**2 / (estimated**2 + noise**2)
    posterior_variance = kept * noise**2
    error = kept * (offset + rng.normal(0, noise, count)) - offset
    hidden = hidden_variance(posterior_variance, Estimate(estimated, 0.3, (0.0, true)))
    assert np.mean(error**2) == pytest.approx(posterior_variance + hidden, rel=0.02)
    assert hidden_variance(posterior_variance, Estimate(None, why="the frames are too few")) == float("inf")


def _darks() -> NoiseCalibration:
    rng = np.random.default_rng(2)
    series = []
    for exposure_s in (0.1, 10.0):
        sums = SeriesSums(Conditions("dark", exposure_s), 65535.0)
        for index in range(4):
            sums.add(f"{exposure_s}_{index}", np.rint(rng.normal(100, 5, (40, 48))).astype(np.uint16))
        series.append(sums.series())
    return calibrate(series, 65535.0)


def test_maps_are_drawn_at_places_on_sensor(undrawn: pytest.MonkeyPatch) -> None:
    undrawn.undo()
    offset = next(map_drawings(_darks(), Lattice((300, 501), (2, 2)), 400))
    numbers = {float(text) for text in re.findall(r">([0-9.]+)</text>", offset.picture)}
    assert {310.0, 370.0} & numbers
    assert {520.0, 580.0} & numbers
    assert not {10.0, 20.0, 30.0} & numbers
