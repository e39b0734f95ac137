"""The arguments of a scene operator, checked and converted to the arrays that the kernels read: pixels and planes."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.kernels import SceneGeometry
from faintfield.recon.operator.placement import BLOCK_PX, LARGEST_ADVANCE
from faintfield.recon.operator.relief import LARGEST_CODE, Relief

# Distance of the pixels at which the part of the detector that sees a window is looked for.
_NODE_PX = 16

type Precision = type[np.float32] | type[np.float64] | np.dtype[np.floating]


class DetectorMaps:
    """Rays and response of the detector's pixels, which the operators of all planes share without a copy.

    Parameters
    ----------
    rays, flat, dtype
        As for `recon.operator.scene_operator.SceneOperator`.

    Attributes
    ----------
    layers : array (3, lattice, row, column)
        x and y of the rays, and the response. Rows are padded by NaN to whole blocks of columns.
    shape : (int, int, int)
        Lattices, rows and columns.

    Raises
    ------
    GeometryMismatch
        Shapes do not fit together, a number is not finite, or a response is negative.
    """

    def __init__(
        self, rays: NDArray[np.floating], flat: NDArray[np.floating] | None = None, dtype: Precision = np.float32
    ) -> None:
        rays = rays[np.newaxis] if rays.ndim == 3 else rays
        if rays.ndim != 4 or rays.shape[3] != 2:
            raise GeometryMismatch(f"rays of shape {rays.shape} do not fit; give (lattice, row, column, 2)")
        lattices, rows, columns = self.shape = rays.shape[0], rays.shape[1], rays.shape[2]
        flat = np.ones((1, rows, columns), dtype) if flat is None else flat.reshape(-1, *flat.shape[-2:])
        if flat.shape not in ((1, rows, columns), self.shape):
            raise GeometryMismatch(f"flat {flat.shape} does not fit rays {rays.shape}; give one per lattice, or one")
        if not (np.isfinite(rays).all() and np.isfinite(flat).all()):
            raise GeometryMismatch("a ray or flat field is not a finite number; check the calibration they came from")
        if (flat < 0).any():
            raise GeometryMismatch(f"the flat field is negative somewhere, {flat.min():.3g} at least; measure it again")
        padded = -(-columns // BLOCK_PX) * BLOCK_PX
        self.layers = np.full((3, lattices, rows, padded), np.nan, dtype)
        self.layers[..., :columns] = rays[..., 0], rays[..., 1], np.broadcast_to(flat, self.shape)

    @classmethod
    def of(
        cls, rays: "NDArray[np.floating] | DetectorMaps", flat: NDArray[np.floating] | None, dtype: Precision
    ) -> "DetectorMaps":
        """Return maps as they are, or those of rays and a flat field."""
        if not isinstance(rays, DetectorMaps):
            return cls(rays, flat, dtype)
        if flat is not None or rays.layers.dtype != dtype:
            raise GeometryMismatch(
                f"detector maps of type {rays.layers.dtype} already have a flat field; give no other, and their dtype"
            )
        return rays

    @property
    def rays(self) -> NDArray[np.floating]:
        """Ray of each pixel (lattice, row, column, 2), a view."""
        return np.moveaxis(self.layers[:2, ..., : self.shape[2]], 0, -1)


# How homographies (view, 3, 3) to samples change with 1/depth, and where each pixel meets the surface.
type Surface = tuple[NDArray[np.float64], Relief]


def scene_geometry(
    plane_from_ray: NDArray[Any],
    maps: DetectorMaps,
    grids: Sequence[PlaneGrid],
    valid: NDArray[np.bool_] | None,
    lattice_of_view: NDArray[np.intp] | None,
    surface: Surface | None = None,
) -> SceneGeometry:
    """Return the geometry of planes (plane, view, 3, 3) and the detector's pixels; `reach` covers whole rows.

    With a `surface`, the only plane is the one at 1/depth `origin` of its relief, and pixels meet it nearer or farther.
    GeometryMismatch is raised where shapes do not fit together, or a number is not finite.
    """
    (lattices, rows, columns), padded, dtype = maps.shape, maps.layers.shape[3], maps.layers.dtype
    planes, views = len(grids), plane_from_ray.shape[1] if plane_from_ray.ndim == 4 else 0
    if plane_from_ray.shape != (planes, views, 3, 3) or 0 in (planes, views):
        raise GeometryMismatch(
            f"homographies {plane_from_ray.shape} do not fit {planes} planes; give (plane, view, 3, 3)"
        )
    if not np.isfinite(plane_from_ray).all():
        raise GeometryMismatch("a pose is not a finite number; check the calibration it came from")
    valid = np.zeros((0, 0, 0), bool) if valid is None else np.ascontiguousarray(valid)
    lattice_of_view = np.zeros(views, np.intp) if lattice_of_view is None else np.array(lattice_of_view, np.intp)
    if valid.size and valid.shape != (views, rows, columns):
        raise GeometryMismatch(
            f"valid has shape {valid.shape}, the pixels {(views, rows, columns)}; give it that shape"
        )
    check_lattices(lattice_of_view, views, lattices)
    homographies = np.stack([grid.index_from_plane() @ h for grid, h in zip(grids, plane_from_ray, strict=True)])
    middle = views // 2, lattice_of_view[views // 2]
    advances = [_advance(matrices[middle[0]], maps.layers[:2, middle[1], :, :columns]) for matrices in homographies]
    starts = np.cumsum([0, *(grid.shape[0] * grid.shape[1] for grid in grids[:-1])])
    slopes, relief = surface or (np.zeros((0, 3, 3)), Relief(np.zeros((0, 0, 0), np.int16), 0.0, 0.0))
    homographies = np.concatenate([homographies.reshape(-1, 3, 3), slopes])
    return SceneGeometry(
        np.ascontiguousarray(homographies, dtype).reshape(-1),
        np.column_stack([starts, [grid.shape for grid in grids], advances]).astype(np.intp),
        lattice_of_view,
        (rows, columns, padded),
        maps.layers.reshape(-1),
        valid.reshape(-1).view(np.uint8),
        relief.codes.reshape(-1),
        dtype.type(relief.step),
        () if surface is None else (True,),
        np.tile(np.array([0, padded], np.intp), (views, rows, 1)),
    )


def window_geometry(geometry: SceneGeometry, grid: PlaneGrid, first: tuple[int, int]) -> SceneGeometry:
    """Return the geometry of a part of the only plane, whose grid begins at sample `first` (row, column) of the whole.

    `reach` covers at least the pixels that see the part.
    """
    rows, columns, padded = geometry.detector
    moved = np.eye(3)
    moved[:2, 2] = -first[1], -first[0]
    homographies = moved @ geometry.homographies.reshape(-1, 3, 3).astype(np.float64)
    rays = geometry.maps.reshape(3, -1, rows, padded)[:2, :, :, :columns]
    views = len(geometry.lattice_of_view)
    # The nearest and the farthest depth of a surface; a pixel moves along a line between them
    ends = (-1, 1) if geometry.bent else ()
    bends = [end * LARGEST_CODE * float(geometry.relief_step) * homographies[views:] for end in ends]
    depths = [homographies[:views] + bend for bend in bends] or [homographies]
    nodes = [_Nodes.of(rays[:, lattice]) for lattice in range(rays.shape[1])]
    reach = np.zeros((views, rows, 2), np.intp)
    for view, lattice in enumerate(geometry.lattice_of_view.tolist()):
        found = np.array([_pixels_of(depth[view], grid.shape, nodes[lattice]) for depth in depths])
        (top, left), (bottom, right) = found[:, ::2].min(axis=0), found[:, 1::2].max(axis=0)
        reach[view, top:bottom] = left // BLOCK_PX * BLOCK_PX, min(-(-right // BLOCK_PX) * BLOCK_PX, padded)
    return geometry._replace(
        homographies=np.ascontiguousarray(homographies, geometry.homographies.dtype).reshape(-1),
        layout=np.array([[0, *grid.shape, geometry.layout[0, 3]]], np.intp),
        reach=reach,
    )


def _advance(homography: NDArray[np.float64], rays: NDArray[Any]) -> int:
    """Return how many samples about the middle pixel lies beyond the one before, at most `LARGEST_ADVANCE`."""
    row, column = rays.shape[1] // 2, rays.shape[2] // 2
    x, y = rays[:, row, max(column - 1, 0) : column + 1].astype(np.float64)
    moved, _, scale = homography @ np.stack([x, y, np.ones_like(x)])
    with np.errstate(divide="ignore", invalid="ignore"):
        advance = np.ptp(moved / scale)
    return int(np.clip(np.round(advance), 1, LARGEST_ADVANCE)) if np.isfinite(advance) else 1


class _Nodes(NamedTuple):
    """Nodes of a coarse lattice on a detector of `size_px` (row, column), its last row and column among them.

    `rays` (3, row, column) are homogeneous.
    """

    size_px: tuple[int, int]
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    rays: NDArray[np.float64]

    @classmethod
    def of(cls, rays: NDArray[Any]) -> "_Nodes":
        """Return the nodes among rays (2, row, column)."""
        rows, columns = rays.shape[1:]
        row_nodes, column_nodes = (np.unique([*range(0, count, _NODE_PX), count - 1]) for count in (rows, columns))
        x, y = rays[:, row_nodes[:, np.newaxis], column_nodes].astype(np.float64)
        return cls((rows, columns), row_nodes, column_nodes, np.stack([x, y, np.ones_like(x)]))


def _pixels_of(homography: NDArray[np.float64], shape: tuple[int, int], nodes: _Nodes) -> tuple[int, int, int, int]:
    """Return ranges of rows and columns that hold all pixels whose rays meet some samples.

    Each part of the detector between two nodes lies in the range if one of its neighbours does.
    """
    rows, columns = nodes.size_px
    x, y, scale = np.tensordot(homography, nodes.rays, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = x / scale, y / scale
    beyond = [np.abs(np.diff(part, axis=axis)).max(initial=0.0) for part in (column, row) for axis in (0, 1)]
    if not np.isfinite(beyond).all() or (scale <= 0).any():
        return 0, rows, 0, columns
    reach = 2 * max(beyond)
    meets = (column > -reach) & (column < shape[1] + reach) & (row > -reach) & (row < shape[0] + reach)
    if not meets.any():
        return 0, 0, 0, 0
    met_rows, met_columns = nodes.rows[meets.any(axis=1)], nodes.columns[meets.any(axis=0)]
    return int(met_rows[0]), int(met_rows[-1]) + 1, int(met_columns[0]), int(met_columns[-1]) + 1


def check_lattices(lattice_of_view: NDArray[np.intp], views: int, lattices: int) -> None:
    """Raise GeometryMismatch unless every view has a lattice that exists."""
    if lattice_of_view.shape != (views,) or not 0 <= lattice_of_view.min() <= lattice_of_view.max() < lattices:
        raise GeometryMismatch(
            f"lattice_of_view has shape {lattice_of_view.shape}; give each of the {views} views one of {lattices} "
            "lattices, counted from 0"
        )
