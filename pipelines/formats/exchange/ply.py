"""Point clouds in PLY, binary and little-endian, which MeshLab, CloudCompare and Blender open.

Points are in mm, or in the unit of the poses, in the frame of the reference camera: x right, y down, z forward. Each
has a unit normal towards the camera and a colour.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.files import writing
from faintfield.pipelines.formats.image_files import Picture

# One point in the file, in the order of the header.
_POINT = np.dtype([("xyz_mm", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])

_HEADER = """ply
format binary_little_endian 1.0
comment faintfield: {unit} in the frame of the reference camera: x right, y down, z forward
comment normals are unit vectors towards the camera
element vertex {count}
property float x
property float y
property float z
property float nx
property float ny
property float nz
property uchar red
property uchar green
property uchar blue
end_header
"""

_UNKNOWN = "lengths are relative, in a unit that nobody measured,"

# Rows that are computed at a time.
_ROWS = 256

# Neighbours whose depths differ by more than this times their lateral distance do not lie on one surface: that would
# be seen at more than 84 degrees from its normal.
_STEEPEST = 10.0


def write_points(
    path: Path,
    depth_mm: NDArray[np.floating],
    x: NDArray[np.floating],
    y: NDArray[np.floating],
    picture: Picture,
    *,
    in_mm: bool = True,
) -> int:
    """Write the samples of a depth map whose depth is known, and return their number.

    Parameters
    ----------
    path : Path
        The file; it appears whole or not at all.
    depth_mm : float array (row, column)
        Depth along the axis of the camera, in mm or, unless `in_mm`, in a unit of unknown length; NaN if not known.
    x, y : float array (column,), (row,)
        Directions of the samples: x/z and y/z, in ascending order.
    picture : uint8 array (row, column[, RGB])
        Their colours.

    Raises
    ------
    ValueError
        The shapes do not agree.
    DiskFull, CannotWrite
        The file cannot be written.
    """
    if not depth_mm.shape == (len(y), len(x)) == picture.shape[:2]:
        raise ValueError(
            f"depths {depth_mm.shape}, directions ({len(y)}, {len(x)}) and picture {picture.shape} disagree in shape"
        )
    count = int(np.isfinite(depth_mm).sum())
    with writing(path) as file:
        file.write(_HEADER.format(count=count, unit="mm" if in_mm else _UNKNOWN).encode())
        for points in _bands(depth_mm, x, y, picture):
            file.write(points.tobytes())
    return count


def _bands(
    depth_mm: NDArray[np.floating], x: NDArray[np.floating], y: NDArray[np.floating], picture: Picture
) -> Iterator[NDArray[np.void]]:
    """Yield the points of some rows at a time; normals take one more row on either side."""
    for first in range(0, len(y), _ROWS):
        last = min(first + _ROWS, len(y))
        rows = slice(max(first - 1, 0), min(last + 1, len(y)))
        z = np.asarray(depth_mm[rows], np.float64)
        places = np.stack([z * x, z * y[rows, np.newaxis], z], axis=-1)
        inner = slice(first - rows.start, last - rows.start)
        known = np.isfinite(z[inner])
        points = np.empty(int(known.sum()), _POINT)
        points["xyz_mm"] = places[inner][known]
        points["normal"] = _normals(places, x, y[rows])[inner][known]
        colours = picture[first:last][known]
        points["rgb"] = colours if colours.ndim == 2 else colours[:, np.newaxis]
        yield points


def _normals(places: NDArray[np.float64], x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the unit normal towards the camera at each place (row, column, 3), seen in the directions x and y.

    A point without neighbours on its surface along both axes faces the camera.
    """
    down = _difference(places, np.diff(y)[:, np.newaxis], axis=0)
    right = _difference(places, np.diff(x), axis=1)
    normal = np.cross(down, right)
    missing = ~(np.abs(normal).max(axis=-1) > 0)
    normal[missing] = -places[missing]
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _difference(places: NDArray[np.float64], apart: NDArray[np.floating], axis: int) -> NDArray[np.float64]:
    """Return the sum of the differences to the neighbours on the same surface along an axis, zero if there are none.

    `apart` is the difference of the neighbours' directions.
    """
    before, after = (slice(None),) * axis + (slice(-1),), (slice(None),) * axis + (slice(1, None),)
    step = places[after] - places[before]
    nearer_mm = np.minimum(places[..., 2][before], places[..., 2][after])
    step[~(np.abs(step[..., 2]) <= _STEEPEST * apart * nearer_mm)] = 0  # also where a depth is unknown
    total = np.zeros_like(places)
    total[before] += step
    total[after] += step
    return total
