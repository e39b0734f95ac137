"""Detect boards in images: the markers, the corners between them, then each corner to a fraction of a pixel."""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.board import Board, predefined_dictionary
from faintfield.calib.corner_fit import refine_corners

# Quantiles of the light that become black and white, and the number of pixels from which they are taken.
_STRETCH_QUANTILES = (0.002, 0.998)
_STRETCH_SAMPLES = 60_000

# Contrast over noise that the marker detector needs; images with less are smoothed until they have it.
_MIN_CONTRAST_OVER_NOISE = 14.0

# Range of the smoothing, σ in pixels.
_MIN_SMOOTHING_PX, _MAX_SMOOTHING_PX = 0.6, 2.5

# Largest distance in pixels of a marker from its place by the homography of the others; the lens moves it by less.
_MAX_MARKER_ERROR_PX = 10.0


@dataclass(frozen=True)
class BoardCorners:
    """Corners of one board found in one image.

    Attributes
    ----------
    board : str
        Name of the board.
    corners : int array (corner,)
        Numbers of the corners.
    pixels : float array (corner, 2)
        Column and row of each.
    sigma_px : float array (corner,)
        Standard deviation of each per axis, from the image's noise.
    markers : int
        Number of the board's markers that were found.
    legacy : bool
        The print begins with a white square, as boards with an even number of rows did in older OpenCV.
    """

    board: str
    corners: NDArray[np.intp]
    pixels: NDArray[np.float64]
    sigma_px: NDArray[np.float64]
    markers: int
    legacy: bool


def detect_boards(image: NDArray[Any], boards: Sequence[Board]) -> list[BoardCorners]:
    """Return the corners of every board whose markers are seen.

    Parameters
    ----------
    image : array (row, column)
        Grey image of any depth and brightness, or the mean of repeated frames if one is too dark.
    boards : sequence of Board
        Boards to detect, which share no marker.
    """
    light = np.asarray(image, np.float32)
    stretched = stretch(light)
    markers = {}
    for dictionary in {board.dictionary for board in boards}:
        ids = tuple(sorted({i for board in boards if board.dictionary == dictionary for i in board.marker_ids}))
        markers[dictionary] = _markers(stretched, dictionary, ids)
    found = (_detect_board(light, stretched, markers[board.dictionary], board) for board in boards)
    return [corners for corners in found if corners is not None]


def detect_all(
    images: Iterable[NDArray[Any]], boards: Sequence[Board], workers: int = 2
) -> Iterator[list[BoardCorners]]:
    """Yield the result of `detect_boards` for each image, in order; `workers` images are processed at a time."""
    with ThreadPoolExecutor(workers) as pool:
        waiting = []
        for image in images:
            waiting.append(pool.submit(detect_boards, image, boards))
            if len(waiting) > workers:  # keeps few images in memory
                yield waiting.pop(0).result()
        for task in waiting:
            yield task.result()


def stretch(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return an image of any depth in the 8 bits that the marker detector needs, smoothed if it is noisy."""
    step = max(int(np.sqrt(light.size / _STRETCH_SAMPLES)), 1)
    black, white = np.quantile(light[::step, ::step], _STRETCH_QUANTILES)
    kernel = np.array([[1.0, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    noise = 1.4826 * float(np.median(np.abs(cv2.filter2D(light, cv2.CV_32F, kernel)[::step, ::step]))) / 6
    sigma_px = _MIN_SMOOTHING_PX
    ratio = (white - black - 4 * noise) / max(noise, 1e-12)
    if ratio < _MIN_CONTRAST_OVER_NOISE:
        # A Gaussian of width σ divides the noise by 2√π σ.
        sigma_px = _MIN_CONTRAST_OVER_NOISE / (max(ratio, 1e-3) * 2 * np.sqrt(np.pi))
    light = cv2.GaussianBlur(light, (0, 0), float(np.clip(sigma_px, _MIN_SMOOTHING_PX, _MAX_SMOOTHING_PX)))
    black, white = np.quantile(light[::step, ::step], _STRETCH_QUANTILES)
    return np.asarray(cv2.convertScaleAbs(np.clip(light - black, 0, None) * (255.0 / max(white - black, 1e-12))))


def _detect_board(
    light: NDArray[np.float32], stretched: NDArray[np.uint8], markers: "_Markers", board: Board
) -> BoardCorners | None:
    """Return the corners of one board; None if none of its markers is seen."""
    marker_corners, marker_ids = markers.of(board)
    if not marker_ids.size:
        return None
    for legacy in (False, True) if board.rows % 2 == 0 else (False,):
        detector = _detector(board, legacy)
        found, ids, _, _ = detector.detectBoard(stretched, markerCorners=marker_corners, markerIds=marker_ids)
        if found is not None and len(found):  # the wrong layout gives no corners
            break
    else:
        return BoardCorners(board.name, np.empty(0, int), np.empty((0, 2)), np.empty(0), len(marker_ids), legacy=False)
    guesses, ids = np.reshape(found, (-1, 2)).astype(float), np.ravel(ids).astype(int)
    squares_px = _squares_px(board.opencv_board(legacy=legacy), marker_corners, marker_ids, ids)
    pixels, sigma_px = refine_corners(light, guesses, squares_px, (1 - board.marker_mm / board.square_mm) / 2)
    kept = np.isfinite(sigma_px)
    return BoardCorners(board.name, ids[kept], pixels[kept], sigma_px[kept], len(marker_ids), legacy)


@dataclass(frozen=True)
class _Markers:
    """The markers of one dictionary in an image: their outlines, and their numbers (marker, 1)."""

    corners: Sequence[NDArray[np.float32]]
    ids: NDArray[np.int32]

    def of(self, board: Board) -> tuple[list[NDArray[np.float32]], NDArray[np.int32]]:
        """Return the markers of one board."""
        own = [index for index, marker in enumerate(np.ravel(self.ids)) if int(marker) in board.marker_ids]
        return [self.corners[index] for index in own], self.ids[own]


def _markers(stretched: NDArray[np.uint8], dictionary: str, wanted: tuple[int, ...]) -> _Markers:
    """Return the wanted markers of a dictionary that are in the image."""
    corners, found, _ = _marker_detector(dictionary, wanted).detectMarkers(stretched)
    indices = np.empty(0, int) if found is None else np.ravel(found)
    return _Markers(corners, np.array(wanted, np.int32)[indices].reshape(-1, 1))


def _squares_px(
    printed: Any,
    marker_corners: Sequence[NDArray[np.float32]],
    marker_ids: NDArray[np.int32],
    corners: NDArray[np.intp],
) -> NDArray[np.float64]:
    """Return the images (corner, 2, 2) of one square's step along rows and along columns at each corner."""
    known = list(np.ravel(printed.getIds()))
    flat = np.concatenate([printed.getObjPoints()[known.index(marker)][:, :2] for marker in np.ravel(marker_ids)])
    seen = np.concatenate([np.reshape(outline, (4, 2)) for outline in marker_corners])
    homography, _ = cv2.findHomography(flat / printed.getSquareLength(), seen, cv2.RANSAC, _MAX_MARKER_ERROR_PX)
    row, column = np.divmod(corners, printed.getChessboardSize()[0] - 1)
    x, y, depth = homography @ np.stack([column + 1, row + 1, np.ones(len(row))])
    by_column, by_row = homography[:, 0], homography[:, 1]
    steps = [[(by[0] - x / depth * by[2]) / depth, (by[1] - y / depth * by[2]) / depth] for by in (by_column, by_row)]
    return np.moveaxis(np.array(steps), -1, 0)


@cache
def _marker_detector(dictionary: str, wanted: tuple[int, ...]) -> Any:
    """Return a detector of the wanted markers only, since each candidate is compared with all markers that it knows."""
    whole = predefined_dictionary(dictionary)
    few = cv2.aruco.Dictionary(whole.bytesList[list(wanted)], whole.markerSize, whole.maxCorrectionBits)
    return cv2.aruco.ArucoDetector(few, cv2.aruco.DetectorParameters())


@cache
def _detector(board: Board, legacy: bool) -> Any:
    return cv2.aruco.CharucoDetector(board.opencv_board(legacy=legacy))
