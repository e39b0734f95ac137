"""A film of a picture with depth, seen from a viewpoint that circles between the nodes: near things move most.

The camera looks at the middle depth, which stands still. The film ends where it begins.
"""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from faintfield.pipelines.formats.image_files import Picture, shrunk
from faintfield.recon.threads import map_in_threads

FRAMES, FRAME_MS = 24, 80

# Width of the film, and the width at which it is drawn: finer, so that outlines are smooth.
_WIDTH_PX, _DRAWN_WIDTH_PX = 480, 720

# Farthest that a sample moves from its place, as a share of the width: what comes into view behind nearer things was
# never seen by the reference camera, and stays small.
_MAX_MOVE = 0.03

# Depths beyond these quantiles, mostly outliers, are moved to them.
_QUANTILES = (0.01, 0.99)

# Width of the median that removes single outliers among the depths.
_MEDIAN_PX = 5

# Neighbours that part by less than this in px leave a crack in one surface, others an edge of two.
_CRACK_PX = 2.0

# Samples beside others from which they part by at least this in px are left out: their light is of both.
_EDGE_PX = 2.5

# A gap is filled from the farthest of its sides; a side this many px away counts as one px nearer.
_PX_AWAY = 10.0


def aperture_of(poses_rt_cam_ref: NDArray[np.floating]) -> tuple[float, float]:
    """Return the distances in mm of the outermost cameras along x and y, given their poses (view, 6)."""
    turned = Rotation.from_rotvec(poses_rt_cam_ref[:, :3]).inv()
    width_mm, height_mm, _ = np.ptp(turned.apply(poses_rt_cam_ref[:, 3:]), axis=0).tolist()
    return width_mm, height_mm


def viewpoints(
    inverse_depth: NDArray[np.floating], pitch: float, aperture_mm: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the viewpoints (frame, 2) of a film: x, y in mm on an ellipse around the middle of the nodes.

    The ellipse reaches the outermost nodes, `aperture_mm` apart, unless that would move the nearest or the farthest
    sample too far across the picture. `inverse_depth` (row, column) is in 1/mm, the `pitch` of its samples in x/z.
    """
    far, middle, near = np.quantile(inverse_depth, [_QUANTILES[0], 0.5, _QUANTILES[1]])
    px_per_mm = max(near - middle, middle - far) / pitch
    reach_mm = max(aperture_mm) / 2
    share = min(1.0, _MAX_MOVE * inverse_depth.shape[1] / max(px_per_mm * reach_mm, 1e-30))
    angles = 2 * np.pi * np.arange(FRAMES) / FRAMES
    return np.asarray(share / 2 * np.array(aperture_mm) * np.column_stack([np.sin(angles), np.cos(angles)]))


def render_parallax(
    picture: Picture, inverse_depth: NDArray[np.floating], pitch: float, offsets_mm: NDArray[np.floating]
) -> list[Picture]:
    """Return a picture as seen from other viewpoints (frame, 2), reduced to the size of a film.

    Each sample is moved by its parallax, the nearer over the farther. What then comes into view behind an edge has the
    colours of the farther side. The frames are of one size: borders that some viewpoint does not see are cut off.
    """
    width = inverse_depth.shape[1]
    picture = shrunk(picture, _DRAWN_WIDTH_PX)
    size = (picture.shape[1], picture.shape[0])
    depths = cv2.resize(inverse_depth.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
    depths = cv2.medianBlur(depths, _MEDIAN_PX)
    far, middle, near = np.quantile(depths, [_QUANTILES[0], 0.5, _QUANTILES[1]]).tolist()
    nearness = (np.clip(depths, far, near) - middle) * (size[0] / (pitch * width))  # px per mm of viewpoint
    margins = np.ceil(np.abs(offsets_mm).max(axis=0) * np.abs(nearness).max()).astype(int)
    margins = np.minimum(margins, np.array(size) // 4)  # of a strip, something is left
    columns, rows = (slice(int(cut), side - int(cut)) for cut, side in zip(margins, size, strict=True))
    frames = _frames(picture, nearness, offsets_mm)
    return [shrunk(frame[rows, columns], _WIDTH_PX) for frame in frames]


def _frames(picture: Picture, nearness: NDArray[np.float32], offsets_mm: NDArray[np.floating]) -> list[Picture]:
    """Return the picture from each viewpoint; `nearness` is the movement of each sample in px per mm of viewpoint."""
    rows, columns = np.indices(nearness.shape, np.float32)
    far_to_near = np.argsort(nearness, axis=None).astype(np.int32)
    apart_px = np.hypot(*offsets_mm.T).max() * (cv2.dilate(nearness, np.ones((5, 5))) - nearness)
    far_to_near = far_to_near[apart_px.ravel()[far_to_near] < _EDGE_PX]

    def seen_from(offset_mm: tuple[float, float]) -> Picture:
        x_mm, y_mm = offset_mm
        moved = np.stack([-x_mm * nearness, -y_mm * nearness])
        source = _sources(np.rint(columns + moved[0]), np.rint(rows + moved[1]), far_to_near)
        source, from_there = _filled(source, nearness, float(np.hypot(x_mm, y_mm)))
        # A sample in view is looked up to a fraction of a pixel, others where their colour comes from
        at_x = np.where(from_there, columns.ravel()[source], columns - moved[0].ravel()[source])
        at_y = np.where(from_there, rows.ravel()[source], rows - moved[1].ravel()[source])
        seen = cv2.remap(picture, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(seen, np.uint8)

    return map_in_threads(seen_from, offsets_mm.tolist())


def _sources(
    columns: NDArray[np.floating], rows: NDArray[np.floating], far_to_near: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Return the index of the nearest sample that comes to lie on each pixel (row, column), -1 for none."""
    height, width = columns.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    samples = far_to_near[inside.ravel()[far_to_near]]
    pixels = rows.ravel()[samples].astype(np.int32) * width + columns.ravel()[samples].astype(np.int32)
    source = np.full(height * width, -1, np.int32)
    source[pixels] = samples  # of several, the last is kept
    return source.reshape(height, width)


def _filled(
    source: NDArray[np.int32], nearness: NDArray[np.float32], moved_mm: float
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Return the sources (row, column) with gaps filled from their farther side, and where their colour is copied.

    Cracks, one pixel wide, continue the surface around them; they are no copies. Wider gaps mirror what lies beyond
    their edge, if that is of the same surface, so that they have its texture.
    """
    padded = np.pad(source, 1, constant_values=-1)
    left, right = padded[1:-1, :-2], padded[1:-1, 2:]
    above, below = padded[:-2, 1:-1], padded[2:, 1:-1]
    whole = source.copy()
    for one, other in ((left, right), (above, below)):
        near = np.stack([nearness.ravel()[one], nearness.ravel()[other]])
        crack = (whole < 0) & (one >= 0) & (other >= 0) & (moved_mm * np.abs(near[0] - near[1]) < _CRACK_PX)
        whole[crack] = np.where(near[0] <= near[1], one, other)[crack]
    gaps = whole < 0
    best, lowest = whole, np.where(gaps, np.float32(np.inf), np.float32(-np.inf))
    for axis, backwards in ((0, False), (0, True), (1, False), (1, True)):
        edge, mirrored, distance = _beyond(whole, axis, backwards)
        height = moved_mm * nearness.ravel()[edge]
        cost = np.where(edge >= 0, height + distance / _PX_AWAY, np.inf)
        same = (mirrored >= 0) & (moved_mm * nearness.ravel()[mirrored] - height < _CRACK_PX)
        best = np.where(cost < lowest, np.where(same, mirrored, edge), best)
        lowest = np.minimum(cost, lowest)
    return np.maximum(best, 0), gaps


def _beyond(
    source: NDArray[np.int32], axis: int, backwards: bool
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Return what lies before each pixel along an axis, or behind it if `backwards`: arrays (row, column).

    These are the last source before a gap, the one that mirrors the pixel there (either -1 if there is none), and how
    many pixels away the edge is.
    """
    ordered = np.flip(source, axis) if backwards else source
    place = np.indices(source.shape, np.int32)[axis]
    last = np.maximum.accumulate(np.where(ordered >= 0, place, 0), axis=axis)
    edge = np.take_along_axis(ordered, last, axis)
    mirrored = np.take_along_axis(ordered, np.maximum(2 * last - place, 0), axis)
    found = (edge, mirrored, place - last)
    return (np.flip(found[0], axis), np.flip(found[1], axis), np.flip(found[2], axis)) if backwards else found
