"""The arguments of a scene operator, checked and converted to the arrays that the kernels read."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.operator.block_layout import BLOCK_PX
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.kernels import SceneGeometry


def scene_geometry(
    plane_from_ray: NDArray[Any],
    rays: NDArray[Any],
    grids: Sequence[PlaneGrid],
    flat: NDArray[Any] | None,
    valid: NDArray[np.bool_] | None,
    transmission: NDArray[Any] | None,
    lattice_of_view: NDArray[np.intp] | None,
    dtype: np.dtype[Any],
) -> SceneGeometry:
    """Return the geometry of planes (plane, view, 3, 3) and rays (lattice, row, column, 2); `reach` covers whole rows.

    Raises
    ------
    GeometryMismatch
        Shapes do not fit together, a number is not finite, or a response or transmission is negative.
    """
    lattices, detector = len(rays), rays.shape[1:3]
    planes, views = len(grids), plane_from_ray.shape[1] if plane_from_ray.ndim == 4 else 0
    if plane_from_ray.shape != (planes, views, 3, 3) or rays.shape != (lattices, *detector, 2) or 0 in (planes, views):
        raise GeometryMismatch(
            f"homographies {plane_from_ray.shape} of {planes} planes and rays {rays.shape} do not fit; "
            "give (plane, view, 3, 3), (row, column, 2)"
        )
    flat = np.ones((1, *detector)) if flat is None else flat.reshape(-1, *flat.shape[-2:])
    valid = np.zeros((0, 0, 0), bool) if valid is None else np.ascontiguousarray(valid)
    transmission = np.zeros((0, 0, 0, 0), dtype) if transmission is None else np.ascontiguousarray(transmission, dtype)
    _check_pixels(flat, valid, transmission, (planes, views, lattices, *detector))
    lattice_of_view = _checked_lattices(lattice_of_view, views, lattices)
    _check_finite(plane_from_ray, rays, flat, transmission)
    return SceneGeometry(
        _homographies(plane_from_ray, grids, dtype),
        _layout(grids),
        lattice_of_view,
        (int(detector[0]), int(detector[1]), _padded(detector[1])),
        _maps(rays, flat, dtype),
        valid.reshape(-1).view(np.uint8),
        transmission.reshape(-1),
        np.broadcast_to(np.array([0, _padded(detector[1])], np.intp), (views, int(detector[0]), 2)).copy(),
    )


def _check_finite(*parts: NDArray[Any]) -> None:
    """Refuse numbers that are not finite."""
    if not all(np.isfinite(part).all() for part in parts):
        raise GeometryMismatch(
            "a pose, ray, flat field or transmission is not a finite number; check the calibration they came from"
        )


def _padded(columns: int) -> int:
    """Return the columns of whole blocks."""
    return -(-columns // BLOCK_PX) * BLOCK_PX


def _homographies(plane_from_ray: NDArray[Any], grids: Sequence[PlaneGrid], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the homographies from rays to sample indices (plane × view × 9,)."""
    homographies = np.stack([grid.index_from_plane() @ h for grid, h in zip(grids, plane_from_ray, strict=True)])
    return np.ascontiguousarray(homographies, dtype).reshape(-1)


def _layout(grids: Sequence[PlaneGrid]) -> NDArray[np.intp]:
    """Return the first sample, rows and columns of each plane (plane, 3)."""
    starts = np.cumsum([0, *(grid.shape[0] * grid.shape[1] for grid in grids[:-1])])
    return np.column_stack([starts, [grid.shape for grid in grids]]).astype(np.intp)


def _maps(rays: NDArray[Any], flat: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return rays and response, padded to whole blocks (3 × lattice × row × padded column,)."""
    lattices, rows, columns = rays.shape[:3]
    maps = np.full((3, lattices, rows, _padded(columns)), np.nan, dtype)
    maps[..., :columns] = rays[..., 0], rays[..., 1], np.broadcast_to(flat, (lattices, rows, columns))
    return maps.reshape(-1)


def _checked_lattices(lattice_of_view: NDArray[np.intp] | None, views: int, lattices: int) -> NDArray[np.intp]:
    """Return the lattice of each view (view,), and refuse lattices that do not exist."""
    lattice_of_view = np.zeros(views, np.intp) if lattice_of_view is None else np.array(lattice_of_view, np.intp)
    if lattice_of_view.shape != (views,) or not 0 <= lattice_of_view.min() <= lattice_of_view.max() < lattices:
        raise GeometryMismatch(
            f"lattice_of_view has shape {lattice_of_view.shape}; give each of the {views} views one of {lattices} "
            "lattices, counted from 0"
        )
    return lattice_of_view


def _check_pixels(
    flat: NDArray[Any], valid: NDArray[Any], transmission: NDArray[Any], sizes: tuple[int, int, int, int, int]
) -> None:
    """Refuse maps of pixels of the wrong shape or sign."""
    planes, views, lattices, *detector = sizes
    if valid.size and valid.shape != (views, *detector):
        raise GeometryMismatch(f"valid has shape {valid.shape}, the views {(views, *detector)}; give it that shape")
    if transmission.size and transmission.shape != (planes, views, *detector):
        raise GeometryMismatch(
            f"transmission has shape {transmission.shape}, the planes' views {(planes, views, *detector)}; "
            "give it that shape"
        )
    if flat.shape not in ((1, *detector), (lattices, *detector)):
        raise GeometryMismatch(
            f"flat {flat.shape} does not fit rays {(lattices, *detector, 2)}; give one per lattice, or one"
        )
    if (flat < 0).any():
        raise GeometryMismatch(f"the flat field is negative somewhere, {flat.min():.3g} at least; measure it again")
    if (transmission < 0).any():
        raise GeometryMismatch(f"a transmission is negative, {transmission.min():.3g}; it must not be below zero")
