"""The lens: where each detector pixel looks."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.errors import LensNotInvertible

# Largest distance in pixels between a pixel and the image of its undistorted ray.
_ROUND_TRIP_PX = 1e-3

# Stopping tolerance of the undistortion in pixels, a little above rounding.
_UNDISTORTION_TOLERANCE_PX = 1e-11

# Largest detector: no sensor that is sold has more pixels, and TIFF and JPEG files hold no longer side.
MAX_SIDE_PX, MAX_PIXELS = 65_535, 250_000_000

# Largest focal length, principal point and distortion coefficient; computing with numbers up to it does not overflow.
_MAX_NUMBER = 1e9

# Rows that are computed at a time: they are float64, and OpenCV returns a Jacobian with every point that it undistorts.
_STRIP_ROWS = 32

# Distances in pixels of the nodes between which undistorted rays are interpolated: the next if one is too wide.
_NODES_PX = (32, 16, 8, 4)

# Pixels of a detector below which each is solved: it takes no longer than loading the splines, and less memory.
_MIN_PX = 1 << 19

# Largest distance in pixels between a point in the middle of four nodes and the image of its interpolated ray. Of all
# points of 83 lenses and distances of nodes, none was off by more than 1.3 times as much as the worst of these.
_INTERPOLATION_PX = 5e-5

# Returns the rays (row, column, 2) of some rows.
type RaysOfRows = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class Lens:
    """A pinhole with OpenCV's rational distortion; pixel centres are integers, starting at (0, 0).

    A point (X, Y, Z) in camera coordinates (x right, y down, z forward) has the ray (X/Z, Y/Z), whose distorted place
    (x, y) is seen at the pixel (fx x + cx, fy y + cy).

    Parameters
    ----------
    size_px : (int, int)
        Width and height of the detector.
    fx_px, fy_px : float
        Focal lengths.
    cx_px, cy_px : float
        Column and row of the principal point.
    distortion : tuple of float
        k1, k2, p1, p2, k3, k4, k5, k6 in OpenCV's order; may be shorter.

    Raises
    ------
    ValueError
        A number is not finite or too large, a focal length is not positive, or there are more than eight coefficients.

    Examples
    --------
    >>> import numpy as np
    >>> from faintfield import Lens
    >>> lens = Lens((640, 480), fx_px=800.0, fy_px=800.0, cx_px=319.5, cy_px=239.5, distortion=(-0.08, 0.02))
    >>> lens.project(np.array([[0.0, 0.0, 500.0], [100.0, 0.0, 500.0]])).round(1)  # mm to px
    array([[319.5, 239.5],
           [479. , 239.5]])
    >>> lens.rays().shape  # x, y at unit depth of each pixel
    (480, 640, 2)
    """

    size_px: tuple[int, int]
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        numbers = (self.fx_px, self.fy_px, self.cx_px, self.cy_px, *self.distortion)
        if len(self.distortion) > 8:
            raise ValueError(f"distortion takes at most 8 coefficients, got {len(self.distortion)}")
        if not np.isfinite(numbers).all() or min(self.fx_px, self.fy_px) <= 0:
            raise ValueError(f"focal lengths must be positive and all numbers finite, got {numbers}")
        if max(map(abs, numbers)) > _MAX_NUMBER:
            raise ValueError(f"numbers of a lens are at most {_MAX_NUMBER:g} in size, got {numbers}")
        if min(self.size_px) < 1:
            raise ValueError(f"size_px must be positive, got {self.size_px}")
        if max(self.size_px) > MAX_SIDE_PX or self.size_px[0] * self.size_px[1] > MAX_PIXELS:
            raise ValueError(
                f"size_px is at most {MAX_SIDE_PX} a side and {MAX_PIXELS / 1e6:g} million pixels, got {self.size_px}"
            )

    @classmethod
    def from_parameters(cls, size_px: tuple[int, int], parameters: NDArray[np.float64]) -> Self:
        """Return the lens with the given `parameters`."""
        fx_px, fy_px, cx_px, cy_px, *distortion = parameters.tolist()
        return cls(size_px, fx_px, fy_px, cx_px, cy_px, tuple(distortion))

    @property
    def parameters(self) -> NDArray[np.float64]:
        """fx, fy, cx, cy in pixels, then the distortion coefficients."""
        return np.array([self.fx_px, self.fy_px, self.cx_px, self.cy_px, *self.distortion])

    def camera_matrix(self) -> NDArray[np.float64]:
        """Return the 3 x 3 matrix from undistorted rays (x, y, 1) to pixels (column, row, 1)."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1]])

    def rays(self, first: tuple[int, int] = (0, 0), step: tuple[int, int] = (1, 1)) -> NDArray[np.float32]:
        """Return the undistorted rays (row, column, 2) of a lattice of pixels: x, y at unit depth.

        Distortion is undone at nodes some pixels apart. Between them, a cubic spline is within 1e-4 px of the ray
        before rounding; where it is not, the nodes are taken closer, at last at every pixel.

        Parameters
        ----------
        first, step : (int, int)
            Row and column of the first pixel, and the distance to the next: (2, 2) for one phase of a Bayer mosaic.

        Raises
        ------
        LensNotInvertible
            Some pixel is the image of no ray or of several rays.
        """
        width, height = self.size_px
        columns = np.arange(first[1], width, step[1], dtype=float)
        rows = np.arange(first[0], height, step[0], dtype=float)
        of_rows = self._interpolated(columns) or (lambda some_rows: self._undistorted(_grid(some_rows, columns)))
        rays = np.empty((len(rows), len(columns), 2), np.float32)
        for top in range(0, len(rows), _STRIP_ROWS):
            strip = slice(top, top + _STRIP_ROWS)
            rays[strip] = of_rows(rows[strip])
        return rays

    def rays_at(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the undistorted rays (point, 2), x, y at unit depth, of pixels (point, 2): column, row; see `rays`."""
        return np.asarray(self._undistorted(np.asarray(pixels, np.float64)[np.newaxis])[0])

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the pixels (point, 2) of points (point, 3) in camera coordinates; NaN behind the camera."""
        points = np.asarray(points, np.float64)
        in_front = points[:, 2] > 0
        pixels = np.full((len(points), 2), np.nan)
        if in_front.any():
            arguments = (np.zeros(3), np.zeros(3), self.camera_matrix(), self._coefficients())
            pixels[in_front] = cv2.projectPoints(points[in_front], *arguments)[0][:, 0]
        return pixels

    def undistortion_maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return column and row, each (row, column), at which this lens sees the pixels of its pinhole."""
        matrix = self.camera_matrix()
        maps = cv2.initUndistortRectifyMap(matrix, self._coefficients(), None, matrix, self.size_px, cv2.CV_32FC1)
        return np.asarray(maps[0], np.float32), np.asarray(maps[1], np.float32)

    def _interpolated(self, columns: NDArray[np.float64]) -> RaysOfRows | None:
        """Return what interpolates the rays (row, column, 2) of the columns in given rows, None if nothing does well.

        The nodes are those of the whole detector, so that a lattice has the rays of all pixels.
        """
        if not any(self.distortion) or self.size_px[0] * self.size_px[1] < _MIN_PX:
            return None
        from scipy.interpolate import BSpline, make_interp_spline  # slow to load

        width, height = self.size_px
        for distance_px in _NODES_PX:
            x, y = (np.linspace(0, size - 1, (size - 2) // distance_px + 2) for size in (width, height))
            if min(len(x), len(y)) < 4:
                continue
            down = make_interp_spline(y, self._undistorted(_grid(y, x)))
            right = make_interp_spline(x, down.c, axis=1)
            middle_x, middle_y = (x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2
            between = BSpline(down.t, right(middle_x), down.k)(middle_y)
            if self._miss_px(between, _grid(middle_y, middle_x)) <= _INTERPOLATION_PX:
                return BSpline(down.t, right(columns), down.k)
        return None

    def _undistorted(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rays of pixels (row, column, 2), and check that they project back onto the pixels."""
        if not any(self.distortion):
            return (pixels - [self.cx_px, self.cy_px]) / [self.fx_px, self.fy_px]
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, _UNDISTORTION_TOLERANCE_PX)
        matrix, distortion = self.camera_matrix(), self._coefficients()
        rays = cv2.undistortPoints(pixels.reshape(-1, 1, 2), matrix, distortion, criteria=criteria)
        rays = np.asarray(rays.reshape(pixels.shape), np.float64)
        miss_px = self._miss_px(rays, pixels)
        if not miss_px <= _ROUND_TRIP_PX:
            raise LensNotInvertible(
                f"distortion {self.distortion} cannot be undone over the {self.size_px[0]} x {self.size_px[1]} px "
                f"detector: off by {miss_px:.3g} px, limit {_ROUND_TRIP_PX} px; calibrate with boards that reach "
                "the corners, crop, or correct signs and order of numbers typed by hand"
            )
        return rays

    def _miss_px(self, rays: NDArray[np.float64], pixels: NDArray[np.float64]) -> float:
        """Return the largest distance in x or y between pixels (…, 2) and the images of rays (…, 2)."""
        homogeneous = cv2.convertPointsToHomogeneous(np.ascontiguousarray(rays).reshape(-1, 1, 2))
        arguments = (np.zeros(3), np.zeros(3), self.camera_matrix(), self._coefficients())
        return float(np.abs(cv2.projectPoints(homogeneous, *arguments)[0].reshape(pixels.shape) - pixels).max())

    def _coefficients(self) -> NDArray[np.float64]:
        """Return the distortion, padded with zeros to a length that OpenCV accepts: 4, 5 or 8."""
        length = next(length for length in (4, 5, 8) if length >= len(self.distortion))
        return np.array([*self.distortion, *[0.0] * (length - len(self.distortion))])


def _grid(rows: NDArray[np.float64], columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return all pixels (row, column, 2) of some rows and columns, as column, row."""
    return np.stack(np.meshgrid(columns, rows), axis=-1)
