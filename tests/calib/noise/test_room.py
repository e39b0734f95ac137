"""Maps of large sensors lie in files, and memory does not grow with the number of frames."""

import tempfile
import tracemalloc
from typing import Any

import numpy as np
import pytest
from numpy.typing import DTypeLike, NDArray

from faintfield.calib.noise import Conditions, Series, SeriesSums, calibrate
from faintfield.calib.noise.room import maps_by, release
from tests.calib.noise.darkroom import Chip, darks, expose, specimen

SHAPE = (300, 400)


def in_files(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return an array in a file without a name."""
    with tempfile.TemporaryFile() as file:
        return np.memmap(file, dtype, "w+", shape=shape)


def peak_bytes(frames: int) -> int:
    """Return the most memory that the sums of so many frames take, those frames not counted."""
    rng = np.random.default_rng(frames)
    taken = [rng.normal(500, 5, SHAPE).astype(np.uint16) for _ in range(frames)]
    tracemalloc.start()
    try:
        sums = SeriesSums(Conditions("dark", 1.0))
        for index, frame in enumerate(taken):
            sums.add(str(index), frame)
        sums.series()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_does_not_grow_by_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of each frame only a sample of its pixels and the means of its rows and columns are kept."""
    monkeypatch.setattr("faintfield.calib.noise.series.statistics.SAMPLE_PX", 100)
    peak_bytes(2)  # what is compiled and imported at first is not counted
    few, many = peak_bytes(4), peak_bytes(24)
    of_frame = 2 * int(np.prod(SHAPE))
    assert many - few < 20 * 0.1 * of_frame


def taken(chip: Chip, rng: np.random.Generator) -> list[Series]:
    """Return darks of two exposures and flats of three levels."""

    def reduced(frames: list[tuple[str, NDArray[Any]]], conditions: Conditions) -> Series:
        sums = SeriesSums(conditions)
        for name, frame in frames:
            sums.add(name, frame)
        return sums.series()

    series = [reduced(frames, Conditions("dark", t)) for t, frames in darks(chip, (0.1, 20.0), 6, rng).items()]
    for level, light in enumerate((2000.0, 8000.0, 20000.0)):
        frames = [(f"flat_{level}_{k}", expose(chip, 0.1, rng, light)) for k in range(6)]
        series.append(reduced(frames, Conditions("flat", 0.1, level, light)))
    return series


def test_maps_in_files_are_those_in_memory() -> None:
    in_memory: list[Any] = []
    in_file: list[Any] = []
    for found, allocate in ((in_memory, np.empty), (in_file, in_files)):
        chip, rng = specimen(11, prnu=0.01, hot_fraction=0.003)
        with maps_by(allocate):
            series = taken(chip, rng)
            release()
            result = calibrate(series, 65535.0)
            release()
        found += [result.estimates, result.maps, series]
    assert in_memory[0] == in_file[0]
    for name in ("offset_dn", "read_noise_e", "dark_current_e_per_s", "relative_response", "unusable"):
        np.testing.assert_array_equal(getattr(in_memory[1], name), getattr(in_file[1], name))
