"""Detect boards in images: the markers, the corners between them, then each corner to a fraction of a pixel."""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.board import Board, predefined_dictionary
from faintfield.calib.corner_fit import refine_corners

# Quantiles of the light that become black and white, and the number of pixels from which they are taken.
_STRETCH_QUANTILES = (0.002, 0.998)
_STRETCH_SAMPLES = 60_000

# Rows that are stretched at once, so that they stay in the cache.
_STRIP_ROWS = 64

# Contrast over noise that the marker detector needs; images with less are smoothed until they have it.
_MIN_CONTRAST_OVER_NOISE = 14.0

# Range of the smoothing, σ in pixels.
_MIN_SMOOTHING_PX, _MAX_SMOOTHING_PX = 0.6, 2.5

# Smallest perimeter of a marker over the longer side of the image, as OpenCV has it.
_MIN_PERIMETER = 0.03

# Side in pixels down to which a large image may reduce the smallest marker: images wider than 4266 px are reduced.
_MIN_MARKER_PX = 16.0

# Fewest markers that tell where the rest of a board is.
_MIN_TELLING = 4

# Width of a bit of the smallest marker that a second look may find, in pixels.
_MIN_BIT_PX = 3.0

# Distance from the edges of the image within which OpenCV takes no marker.
_BORDER_PX = 3

# Largest distance in pixels of a marker from its place by the homography of the others; the lens moves it by less.
_MAX_MARKER_ERROR_PX = 10.0


@dataclass(frozen=True)
class BoardCorners:
    """Corners of one board found in one image.

    Attributes
    ----------
    board, corners : str, int array (corner,)
        Name of the board, and numbers of the corners.
    pixels, sigma_px : float array (corner, 2), (corner,)
        Column and row of each, and its standard deviation per axis, from the image's noise.
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

    In large images, markers are first looked for at a reduced size, then at full size where some are missing.

    Parameters
    ----------
    image : array (row, column)
        Grey image of any depth and brightness, or the mean of repeated frames if one is too dark.
    boards : sequence of Board
        Boards to detect, which share no marker.
    """
    light = np.asarray(image, np.float32)
    step = max(int(_MIN_PERIMETER * max(light.shape) / 4 / _MIN_MARKER_PX), 1)
    parts = [_search(light, boards, step)]
    if step > 1:
        parts += _search_again(light, boards, parts[0])
    found = (_detect_board(light, max(parts, key=lambda part: part.markers(board).ids.size), board) for board in boards)
    return [corners for corners in found if corners is not None]


def detect_all(
    images: Iterable[NDArray[Any]], boards: Sequence[Board], workers: int = 2
) -> Iterator[list[BoardCorners]]:
    """Detect boards in a series of images, several at a time.

    Parameters
    ----------
    images : iterable of array (row, column)
        Grey images of any depth and brightness.
    boards : sequence of Board
        Boards to detect, which share no marker.
    workers : int
        Number of images that are processed at a time.

    Yields
    ------
    list of BoardCorners
        For each image in order, the boards that it shows: `board` is the name, `corners` are the numbers of the
        corners, `pixels` (corner, 2) their columns and rows, and `sigma_px` the standard deviations of these.

    Examples
    --------
    >>> from faintfield import Board, detect_all
    >>> board = Board("wall", columns=9, rows=7, square_mm=30.0, marker_mm=22.0)
    >>> image = board.opencv_board().generateImage((450, 350))
    >>> ((corners,),) = detect_all([image], [board])  # one board in one image
    >>> corners.board, corners.markers, len(corners.corners)
    ('wall', 31, 48)
    >>> corners.pixels[:2].round(1)
    array([[49.5, 49.5],
           [99.5, 49.5]])
    """
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
    noise = _noise(light, step)
    sigma_px = _MIN_SMOOTHING_PX
    ratio = (white - black - 4 * noise) / max(noise, 1e-12)
    if ratio < _MIN_CONTRAST_OVER_NOISE:
        # A Gaussian of width σ divides the noise by 2√π σ.
        sigma_px = _MIN_CONTRAST_OVER_NOISE / (max(ratio, 1e-3) * 2 * np.sqrt(np.pi))
    light = cv2.GaussianBlur(light, (0, 0), float(np.clip(sigma_px, _MIN_SMOOTHING_PX, _MAX_SMOOTHING_PX)))
    black, white = np.quantile(light[::step, ::step], _STRETCH_QUANTILES)
    stretched = np.empty(light.shape, np.uint8)
    for first in range(0, len(light), _STRIP_ROWS):
        rows = slice(first, first + _STRIP_ROWS)
        stretched[rows] = cv2.convertScaleAbs(
            np.clip(light[rows] - black, 0, None) * (255.0 / max(white - black, 1e-12))
        )
    return stretched


def _noise(light: NDArray[np.float32], step: int) -> float:
    """Return the standard deviation of the noise, from second differences at every `step`-th row and column."""
    kernel = np.array([[1.0, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    rough = [
        cv2.filter2D(light[max(row - 1, 0) : row + 2], cv2.CV_32F, kernel)[min(row, 1), ::step]
        for row in range(0, len(light), step)
    ]
    return 1.4826 * float(np.median(np.abs(rough))) / 6


@dataclass(frozen=True)
class _Markers:
    """Markers in an image: their outlines, and their numbers (marker, 1)."""

    corners: Sequence[NDArray[np.float32]]
    ids: NDArray[np.int32]


@dataclass(frozen=True)
class _Part:
    """A part of the image in 8 bits, reduced by `step`, its first column and row, and the markers by dictionary.

    `unknown` are outlines (4, 2) that look like markers but are none.
    """

    stretched: NDArray[np.uint8]
    step: int
    origin: tuple[int, int]
    found: dict[str, _Markers]
    unknown: list[NDArray[np.float32]]

    def markers(self, board: Board) -> _Markers:
        """Return the markers of one board."""
        found = self.found.get(board.dictionary, _Markers([], np.empty((0, 1), np.int32)))
        own = [index for index, marker in enumerate(np.ravel(found.ids)) if int(marker) in board.marker_ids]
        return _Markers([found.corners[index] for index in own], found.ids[own])

    def in_image(self, places: NDArray[Any]) -> NDArray[np.float64]:
        """Return where places (…, 2) of the part are in the image."""
        return np.asarray((places + 0.5) * self.step - 0.5 + np.array(self.origin))


type _Window = tuple[slice, slice]


def _search(light: NDArray[np.float32], boards: Sequence[Board], step: int, window: _Window | None = None) -> _Part:
    rows, columns = window or (slice(0, light.shape[0]), slice(0, light.shape[1]))
    part = light[rows, columns]
    if step > 1:
        height, width = (length // step for length in part.shape)
        part = cv2.resize(part[: height * step, : width * step], (width, height), interpolation=cv2.INTER_AREA)
    stretched, found, unknown = stretch(part), {}, []
    for dictionary in {board.dictionary for board in boards}:
        ids = tuple(sorted({i for board in boards if board.dictionary == dictionary for i in board.marker_ids}))
        min_perimeter = _MIN_PERIMETER
        if window:
            bits = predefined_dictionary(dictionary).markerSize + 2
            min_perimeter = min(4 * bits * _MIN_BIT_PX, _MIN_PERIMETER * max(light.shape)) / max(part.shape)
        corners, indices, others = _marker_detector(dictionary, ids, min_perimeter).detectMarkers(stretched)
        numbers = np.empty(0, int) if indices is None else np.ravel(indices)
        found[dictionary] = _Markers(corners, np.array(ids, np.int32)[numbers].reshape(-1, 1))
        unknown += [outline.reshape(4, 2) for outline in others]
    return _Part(stretched, step, (columns.start, rows.start), found, unknown)


def _search_again(light: NDArray[np.float32], boards: Sequence[Board], first: _Part) -> list[_Part]:
    """Look again at full size: at boards of which markers are missing, and for all others where anything may be one."""
    whole = slice(0, light.shape[0]), slice(0, light.shape[1])
    parts, unseen, hulls = [], [], []
    for board in boards:
        markers = first.markers(board)
        if not markers.ids.size:
            unseen.append(board)
        elif markers.ids.size < min(_MIN_TELLING, board.marker_count):
            parts.append(_search(light, [board], 1, whole))
        else:
            outlines, hull = _places(first, markers, board)
            hulls.append(hull.astype(np.float32))
            low, high = outlines.min(axis=(1, 2)), (outlines - light.shape[::-1]).max(axis=(1, 2)) + 1
            inside = (low >= _BORDER_PX) & (high <= -_BORDER_PX)
            window = _window(hull, light.shape)
            if markers.ids.size < inside.sum() and light[window].size:
                parts.append(_search(light, [board], 1, window))
    quads = [first.in_image(quad) for quad in first.unknown]
    odd = [
        quad
        for quad in quads
        if not any(cv2.pointPolygonTest(hull, quad.mean(axis=0).tolist(), measureDist=False) >= 0 for hull in hulls)
    ]
    if unseen and odd:
        parts.append(_search(light, unseen, 1, _window(np.concatenate(odd), light.shape)))
    return parts


def _places(part: _Part, markers: _Markers, board: Board) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where all markers of a board (marker, 4, 2) and its outline (4, 2) should be in the image."""
    printed = board.opencv_board()
    squares = np.array(printed.getObjPoints())[..., :2] / printed.getSquareLength()
    flat = squares[np.ravel(markers.ids) - board.first_marker_id].reshape(-1, 2)
    homography = _homography(flat, part.in_image(np.reshape(markers.corners, (-1, 2))))
    ends = np.array([[[0, 0], [board.columns, 0], [board.columns, board.rows], [0, board.rows]]], float)
    placed = cv2.perspectiveTransform(np.concatenate([squares, ends]).astype(float), homography)
    return placed[:-1], placed[-1]


def _window(places: NDArray[np.float64], shape: tuple[int, ...]) -> _Window:
    """Return the part of an image around places (place, 2), larger by an eighth on each side."""
    low, high = places.min(axis=0), places.max(axis=0)
    margin = (high - low).max() / 8
    left, top = np.clip(low - margin, 0, None).astype(int).tolist()
    right, bottom = np.ceil(np.clip(high + margin, 0, None)).astype(int).tolist()
    return slice(top, min(bottom, shape[0])), slice(left, min(right, shape[1]))


def _detect_board(light: NDArray[np.float32], part: _Part, board: Board) -> BoardCorners | None:
    """Return the corners of one board; None if none of its markers is seen."""
    markers = part.markers(board)
    count = markers.ids.size
    if not count:
        return None
    for legacy in (False, True) if board.rows % 2 == 0 else (False,):
        detector = _detector(board, legacy)
        found, ids, _, _ = detector.detectBoard(part.stretched, markerCorners=markers.corners, markerIds=markers.ids)
        if found is not None and len(found):  # the wrong layout gives no corners
            break
    else:
        return BoardCorners(board.name, np.empty(0, int), np.empty((0, 2)), np.empty(0), count, legacy=False)
    guesses, ids = part.in_image(np.reshape(found, (-1, 2)).astype(float)), np.ravel(ids).astype(int)
    squares_px = part.step * _squares_px(board.opencv_board(legacy=legacy), markers, ids)
    pixels, sigma_px = refine_corners(light, guesses, squares_px, (1 - board.marker_mm / board.square_mm) / 2)
    kept = np.isfinite(sigma_px)
    return BoardCorners(board.name, ids[kept], pixels[kept], sigma_px[kept], count, legacy)


def _homography(flat: NDArray[np.float64], pixels: NDArray[Any]) -> NDArray[np.float64]:
    """Return the homography from points of a board (point, 2) in squares to their images (point, 2)."""
    homography, _ = cv2.findHomography(flat, pixels, cv2.RANSAC, _MAX_MARKER_ERROR_PX)
    return np.asarray(homography)


def _squares_px(printed: Any, markers: _Markers, corners: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return the images (corner, 2, 2) of one square's step along rows and along columns at each corner."""
    known = list(np.ravel(printed.getIds()))
    flat = np.concatenate([printed.getObjPoints()[known.index(marker)][:, :2] for marker in np.ravel(markers.ids)])
    seen = np.concatenate([np.reshape(outline, (4, 2)) for outline in markers.corners])
    homography = _homography(flat / printed.getSquareLength(), seen)
    row, column = np.divmod(corners, printed.getChessboardSize()[0] - 1)
    x, y, depth = homography @ np.stack([column + 1, row + 1, np.ones(len(row))])
    by_column, by_row = homography[:, 0], homography[:, 1]
    steps = [[(by[0] - x / depth * by[2]) / depth, (by[1] - y / depth * by[2]) / depth] for by in (by_column, by_row)]
    return np.moveaxis(np.array(steps), -1, 0)


@lru_cache(maxsize=32)  # windows ask for perimeters of their own
def _marker_detector(dictionary: str, marker_ids: tuple[int, ...], min_perimeter: float) -> Any:
    """Return a detector of the wanted markers only, since each candidate is compared with all markers that it knows."""
    whole = predefined_dictionary(dictionary)
    few = cv2.aruco.Dictionary(whole.bytesList[list(marker_ids)], whole.markerSize, whole.maxCorrectionBits)
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = min_perimeter
    return cv2.aruco.ArucoDetector(few, parameters)


@cache
def _detector(board: Board, legacy: bool) -> Any:
    return cv2.aruco.CharucoDetector(board.opencv_board(legacy=legacy))
