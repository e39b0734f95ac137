"""Drawings of a sensor's noise are read without guessing: ticks, legends, names of lines."""

import re

import pytest

from faintfield.pipelines.pages.noise_plots import Plot, drawn


@pytest.fixture(autouse=True)
def drawings(undrawn: pytest.MonkeyPatch) -> None:
    undrawn.undo()


def _texts(picture: str) -> list[str]:
    return re.findall(r">([^<>\n]+)</text>", picture)


@pytest.mark.parametrize("ends", [(1.7, 30.0), (0.8, 9.0), (3.0, 900.0)])
def test_logarithmic_axes_have_several_ticks(ends: tuple[float, float]) -> None:
    picture = drawn("", Plot("", lambda axes: axes.semilogy([0, 1], ends))).picture
    beyond = [float(text) for text in _texts(picture) if re.fullmatch(r"[0-9.]+", text)]
    assert len({number for number in beyond if 0.5 * ends[0] <= number <= 2 * ends[1]}) >= 4
