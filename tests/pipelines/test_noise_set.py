"""How the frames of a noise set are grouped into series."""

from pathlib import Path

import pytest

from faintfield.pipelines.formats.results.noise import NoiseFrame
from faintfield.pipelines.formats.sets.noise_set import NoiseSet, group_frames


def grouped(warmth: list[float | None], doubling_k: float | None = None) -> list[tuple[list[int], float | None, float]]:
    """Return the indices of the frames of each series of darks, its temperature and its factor."""
    frames = [NoiseFrame(f"{k}.tiff", "dark", 1.0, temperature_c=it) for k, it in enumerate(warmth)]
    flat = NoiseFrame("flat.tiff", "flat", 0.1, temperature_c=20.0)
    groups = group_frames(Path(), NoiseSet(1, [*frames, flat], dark_current_doubling_k=doubling_k))
    return [
        ([int(path.stem) for path in paths], one.temperature_c, one.dark_factor)
        for one, paths in groups.items()
        if one.kind == "dark"
    ]


@pytest.mark.parametrize(
    ("warmth", "series"),
    [
        ([20.0, 20.5, 20.2], [[0, 1, 2]]),
        ([30.0, 10.0, 10.2, 30.1], [[1, 2], [0, 3]]),
        ([20.0, 20.4, 20.8, 21.2], [[0, 1, 2, 3]]),
        ([20.0 + 0.4 * k for k in range(9)], [[0, 1, 2, 3, 4, 5], [6, 7, 8]]),
        ([10.0, None, 12.0, None], [[1, 3], [0], [2]]),
        ([None, None], [[0, 1]]),
    ],
)
def test_darks_of_one_exposure_are_apart_where_their_temperatures_are(
    warmth: list[float | None], series: list[list[int]]
) -> None:
    assert [indices for indices, _, _ in grouped(warmth)] == series


def test_each_series_has_the_dark_current_of_its_temperature() -> None:
    """The mean of 5 frames is 18 °C: 8 K are two doublings."""
    found = grouped([10.0, 10.0, 26.0, 24.0], 4.0)
    assert [factor for _, _, factor in found] == pytest.approx([0.25, 2**1.5, 4.0])
    assert [warmth for _, warmth, _ in found] == [10.0, 24.0, 26.0]
    assert [warmth for _, warmth, _ in grouped([20.0, 20.2], 4.0)] == [None], "steady: no name of its own"
