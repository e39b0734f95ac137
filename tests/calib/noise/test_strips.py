"""Maps of large sensors lie in files, and memory does not grow with the number of frames."""

import tempfile
import tracemalloc
from typing import Any

import numpy as np
import pytest
from numpy.typing import DTypeLike, NDArray

from faintfield.calib.noise import Conditions, SeriesSums, calibrate
from faintfield.calib.noise.strips import maps_by, release
from tests.calib.noise.darkroom import specimen, with_flats

SHAPE = (300, 400)


def in_files(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return an array in a file without a name."""
    with tempfile.TemporaryFile() as file:
        return np.memmap(file, dtype, "w+", shape=shape)


def peak_bytes(frames: int) -> int:
    """Return the most memory that the sums of so many frames take, those frames not counted."""
    rng = np.random.default_rng(frames)
    stack = [rng.normal(500, 5, SHAPE).astype(np.uint16) for _ in range(frames)]
    tracemalloc.start()
    try:
        sums = SeriesSums(Conditions("dark", 1.0))
        for index, frame in enumerate(stack):
            sums.add(str(index), frame)
        sums.series()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_does_not_grow_with_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of each frame only a sample of its pixels and the means of its rows and columns are kept."""
    monkeypatch.setattr("faintfield.calib.noise.series.SAMPLE_PX", 100)
    peak_bytes(2)  # what is compiled and imported at first is not counted
    few, many = peak_bytes(4), peak_bytes(24)
    of_frame = 2 * int(np.prod(SHAPE))
    assert many - few < 20 * 0.1 * of_frame


def test_maps_in_files_are_those_in_memory() -> None:
    results = []
    for allocate in (np.empty, in_files):
        chip, rng = specimen(11, prnu=0.01, hot_fraction=0.003)
        with maps_by(allocate):
            series = with_flats(chip, rng, (2000.0, 8000.0, 20000.0), (0.1, 20.0), frames=6, dark_frames=6)
            release()
            results.append(calibrate(series, 65535.0))
            release()
    in_memory, in_file = results
    assert in_memory.estimates == in_file.estimates
    for name in ("offset_dn", "read_noise_e", "dark_current_e_per_s", "relative_response", "unusable"):
        np.testing.assert_array_equal(getattr(in_memory.maps, name), getattr(in_file.maps, name))
