"""Cost of calibrating a large sensor: `python -m benchmarks.calibration.calibration_size MEGAPIXELS FRAMES`."""

import argparse
import resource
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from faintfield.calib.board import Board
from faintfield.calib.detection import detect_boards
from faintfield.calib.noise import Conditions, Series, calibrate, measure_series
from faintfield.calib.noise.strips import maps_by
from faintfield.pipelines.formats.large_arrays import maps_in_files

_SEED, _LIGHT_E = 1288, (1000.0, 4000.0, 16000.0)


def main() -> None:
    """Print seconds, CPU seconds and peak memory of boards, of statistics and of the fit."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibration.calibration_size", description=__doc__)
    parser.add_argument("megapixels", type=float)
    parser.add_argument("frames", type=int)
    arguments = parser.parse_args()
    pixels, frames = arguments.megapixels * 1e6, arguments.frames
    shape = int((pixels / 1.5) ** 0.5), int((pixels * 1.5) ** 0.5)
    boards = [Board(f"b{k}", 8, 6, 40.0, 29.0, "DICT_5X5_1000", 100 * k) for k in range(6)]
    scene = _scene(boards, shape)
    observations = _timed("six boards", lambda: detect_boards(scene, boards))
    print(f"{sum(len(board.corners) for board in observations)} of 210 corners")
    with TemporaryDirectory() as folder, maps_by(maps_in_files(Path(folder))):
        series = _timed(f"statistics of {5 * frames} frames, which are simulated", lambda: _series(shape, frames))
        _timed("fit and maps", lambda: calibrate(series, 65535.0))


def _timed[T](what: str, work: Callable[[], T]) -> T:
    """Return what `work` returns, and print what it costs."""
    begun_s, cpu_s = time.perf_counter(), time.process_time()
    result = work()
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    print(
        f"{what}: {time.perf_counter() - begun_s:.2f} s, {time.process_time() - cpu_s:.2f} CPU s, peak {peak_gb:.2f} GB"
    )
    return result


def _scene(boards: list[Board], shape: tuple[int, int]) -> np.ndarray:
    """Return a picture (row, column) of the boards in two rows."""
    square = min(shape[0] // 14, shape[1] // 27)
    scene = np.full(shape, 230, np.uint8)
    for index, board in enumerate(boards):
        picture = board.opencv_board().generateImage((8 * square, 6 * square))
        top, left = (
            square // 2 + place * size for place, size in zip(divmod(index, 3), (7 * square, 9 * square), strict=True)
        )
        scene[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return scene


def _series(shape: tuple[int, int], frames: int) -> list[Series]:
    """Return darks of two exposures and flats of three levels."""
    rng = np.random.default_rng(_SEED)
    offset = 200 + rng.standard_normal(shape, np.float32)

    def taken(mean_e: float) -> Iterator[tuple[str, np.ndarray]]:
        sigma = np.float32((9 + mean_e) ** 0.5)
        for k in range(frames):
            values = sigma * rng.standard_normal(shape, np.float32)
            values += offset
            values += np.float32(mean_e)
            yield f"{mean_e}_{k}", np.rint(values, out=values).astype(np.uint16)

    darks = [measure_series(taken(2 * t), Conditions("dark", t)) for t in (0.1, 20.0)]
    flats = [measure_series(taken(e), Conditions("flat", 0.1, k, 2 * e)) for k, e in enumerate(_LIGHT_E)]
    return darks + flats


if __name__ == "__main__":
    main()
