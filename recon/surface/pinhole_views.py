# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""The views as ideal pinhole cameras see them, their sums over what each depth brings together, and a blur."""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image, binned
from faintfield.recon.numba_tools import compiled, index, inlined, pointer
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.surface_operator import SurfaceOperator

# Light of a pixel without a valid number; a sum with any share of such light lies below the second.
UNKNOWN, _ANY_UNKNOWN = np.float32(-1e30), np.float32(-1e9)

# Steps by which the change of a lens is undone: enough while the change b of distortion moves rays r by b r² < 0.1.
_INVERSION_STEPS = 6


@dataclass(frozen=True)
class PinholeViews:
    """All views of one scene as pinhole cameras see them, all colours together.

    Attributes
    ----------
    light_e : float32 array (view, row, column)
        Electrons of light, the background subtracted and the response divided out; `UNKNOWN` where there is no number.
    variance_e2 : float
        Variance of a pixel without that of its light.
    ray_from_surface : float array (view, 3, 4)
        From (x, y, 1, 1/depth) in the frame of the reference view to the ray of a view, homogeneous.
    focal_px, centre_px : (float, float)
        Of the pinhole camera, in pixels of these images, right and down.
    grid : PlaneGrid
        The samples of the surface at unit depth.
    nodes : int array (view, 2)
        Row and column of each view in the grid of nodes.
    response, noise_share : float32 array (row, column) or float
        The response that the light was divided by, and the share of a pixel's variance that resampling has left.
    lens_change : (float, float)
        Relative change of the focal length and change of the first distortion term, which `rays` count, of the lens by
        which the pictures were made those of a pinhole.
    """

    light_e: NDArray[np.float32]
    variance_e2: float
    ray_from_surface: NDArray[np.float64]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    grid: PlaneGrid
    nodes: NDArray[np.intp]
    response: NDArray[np.float32] | float = 1.0
    noise_share: NDArray[np.float32] | float = 1.0
    lens_change: tuple[float, float] = (0.0, 0.0)

    def pixel_variance(self, light_e: Image) -> NDArray[np.float32]:
        """Return the variance of pixels of the given light ([view,] row, column)."""
        counted = (np.maximum(light_e, 0) + np.float32(self.variance_e2) / self.response) / self.response
        return np.asarray(counted * self.noise_share, np.float32)

    def rays(self) -> NDArray[np.float32]:
        """Return the direction of each pixel (row, column, 2), x, y at unit depth."""
        rows, columns = np.indices(self.light_e.shape[1:], np.float32)
        (cx, cy), (fx, fy) = self.centre_px, self.focal_px
        rays = np.stack([(columns - np.float32(cx)) / np.float32(fx), (rows - np.float32(cy)) / np.float32(fy)], -1)
        if not any(self.lens_change):
            return rays
        focal_change, distortion_change = np.array(self.lens_change, np.float32)
        changed = rays
        for _ in range(_INVERSION_STEPS):
            square = np.sum(changed**2, axis=-1, keepdims=True)
            changed = rays / ((1 + focal_change) * (1 + distortion_change * square))
        return changed

    @cached_property
    def pixel_from_surface(self) -> NDArray[np.float32]:
        """Matrices (view, 3, 4) from (x, y, 1, 1/depth) to column, row, homogeneous, without a change of distortion."""
        (cx, cy), (fx, fy) = self.centre_px, np.array(self.focal_px) * (1 + self.lens_change[0])
        pixel_from_ray = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        return np.asarray(pixel_from_ray @ self.ray_from_surface, np.float32)

    @cached_property
    def reach(self) -> NDArray[np.float32]:
        """Parallax of each view, in samples per unit of 1/depth."""
        reach = np.linalg.norm(self.ray_from_surface[:, :2, 3], axis=1) / self.grid.pitch_mm
        return np.asarray(reach, np.float32)

    def binned(self, bins: int) -> "PinholeViews":
        """Return the views with `bins` by `bins` pixels added up; a bin counts if all its pixels do."""
        if bins == 1:
            return self
        light = np.stack([binned(picture, bins) for picture in self.light_e]) * np.float32(bins**2)
        light[light < _ANY_UNKNOWN] = UNKNOWN
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        response, share = (
            binned(np.broadcast_to(n, self.light_e.shape[1:]), bins) for n in (self.response, self.noise_share)
        )
        return replace(
            self,
            light_e=light,
            response=response,
            # Neighbours that share pixels add up to more
            noise_share=np.asarray((1 - (1 - np.sqrt(share)) / bins) ** 2, np.float32),
            variance_e2=self.variance_e2 * bins**2,
            focal_px=(fx / bins, fy / bins),
            centre_px=((cx + 0.5) / bins - 0.5, (cy + 0.5) / bins - 0.5),
            grid=self.grid.binned(bins),
        )

    def surface_operator(self, inverse_depth: Image) -> SurfaceOperator:
        """Return H of a surface with the given 1/depth (row, column)."""
        valid = self.light_e > UNKNOWN
        return SurfaceOperator(self.ray_from_surface, self.rays(), self.grid, inverse_depth, valid=valid)


def gather(
    views: PinholeViews,
    pictures: NDArray[np.float32],
    inverse_depth: float,
    relief: NDArray[np.float32],
    tolerance: NDArray[np.float32],
    half: NDArray[np.intp],
) -> Image:
    """Return sums over the views of what they show of the samples, were these all at one depth.

    A view shows at each place the mean of the nine pixels around it, weighted by a quadratic B-spline. It blurs alike
    everywhere, and sums bend as a place moves: those of bilinear interpolation are straight between pixels, where views
    on opposite sides then cancel, and a range of depths looks alike. A view does not count where something nearer hides
    it.

    Parameters
    ----------
    pictures : float32 array (view, row, column, number)
        The numbers to add up; the first is `UNKNOWN` where a pixel does not count.
    inverse_depth : float
        1/depth of all samples.
    relief, tolerance : float32 array (view, row, column), float32 array (view,)
        1/depth of what each pixel sees, and its largest excess over that of the samples.
    half : int array (view,)
        The sum that each view belongs to, 0 or 1.

    Returns
    -------
    float32 array (2, 1 + number, row, column)
        Numbers of views of both halves, and sums.
    """
    sums = np.zeros((2, 1 + pictures.shape[3], *views.grid.shape), np.float32)
    x0, y0 = views.grid.origin_mm
    lattice, q = (np.float32(x0), np.float32(y0), np.float32(views.grid.pitch_mm)), np.float32(inverse_depth)
    _gather(pictures, relief, tolerance, half, views.pixel_from_surface, q, lattice, sums)
    return sums


@compiled
def _gather(pictures, relief, tolerance, half, matrices, q, lattice, sums):
    """Add what views show to `sums` (half, count and numbers, row, column)."""
    count, rows, columns, numbers = pictures.shape
    x0, y0, pitch = lattice
    one, half_px = np.float32(1), np.float32(0.5)
    last_row, last_column = np.float32(rows) - np.float32(1.5), np.float32(columns) - np.float32(1.5)
    row_step, column_step = index(columns * numbers), index(numbers)
    width, size = index(sums.shape[3]), index(sums.shape[2] * sums.shape[3])
    for view in range(count):
        m, hidden = matrices[view], q + tolerance[view]
        picture, seen, total = pointer(pictures[view]), pointer(relief[view]), pointer(sums[half[view]])
        for i in range(sums.shape[2]):
            y = y0 + pitch * np.float32(i)
            a = m[0, 1] * y + m[0, 2] + m[0, 3] * q
            b = m[1, 1] * y + m[1, 2] + m[1, 3] * q
            c = m[2, 1] * y + m[2, 2] + m[2, 3] * q
            for j in range(sums.shape[3]):
                x = x0 + pitch * np.float32(j)
                scale = one / (c + m[2, 0] * x)
                column, row = (a + m[0, 0] * x) * scale, (b + m[1, 0] * x) * scale
                if not (half_px <= row < last_row and half_px <= column < last_column):
                    continue
                r, k = np.int32(row + half_px), np.int32(column + half_px)
                if seen[index(r) * index(columns) + index(k)] > hidden:
                    continue
                above, here, below = spline_weights(row - np.float32(r))
                left, middle, right = spline_weights(column - np.float32(k))
                first = index(r - 1) * row_step + index(k - 1) * column_step
                at = index(i) * width + index(j)
                for n in range(numbers):
                    upper = first + index(n)
                    value = above * across(picture, upper, column_step, left, middle, right)
                    value += here * across(picture, upper + row_step, column_step, left, middle, right)
                    value += below * across(picture, upper + row_step + row_step, column_step, left, middle, right)
                    if n == 0:
                        if value < _ANY_UNKNOWN:
                            break
                        total[at] += one
                    total[at + index(n + 1) * size] += value


@inlined
def spline_weights(x):
    """Return the quadratic B-spline at distances -1, 0 and 1 from a point `x` between -1/2 and 1/2."""
    before, after = np.float32(0.5) - x, np.float32(0.5) + x
    return np.float32(0.5) * before * before, np.float32(0.75) - x * x, np.float32(0.5) * after * after


@inlined
def across(picture, at, step, left, middle, right):
    """Return the weighted sum of three numbers of a picture, the first of which is `at`."""
    return left * picture[at] + middle * picture[at + step] + right * picture[at + step + step]


def gaussian(image: Image, scale: float) -> NDArray[np.float32]:
    """Return an image (row, column), or a volume (row, column, up to 512 depths), blurred over rows and columns.

    `scale` is the standard deviation of the blur in samples. Edges are mirrored.
    """
    return np.asarray(cv2.GaussianBlur(np.ascontiguousarray(image, np.float32), (0, 0), scale), np.float32)
