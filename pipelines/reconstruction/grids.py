"""The samples of planes: by default they overlay the reference view pixel for pixel."""

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.plane_poses import TiltedPlane
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.channels import ChannelLayout
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.operator.grid import PlaneGrid

# Limit of the samples of a plane: one seen at a grazing angle would have most of its samples far away.
_MAX_SAMPLES_PER_PIXEL = 16


def check_in_front(depth_mm: float) -> None:
    """Refuse a plane that is not in front of the reference camera (GeometryMismatch)."""
    if not (np.isfinite(depth_mm) and depth_mm > 0):
        raise GeometryMismatch(f"a plane at {depth_mm} mm is not in front of the camera; depth_mm must be positive")


def default_pitch_px(loaded: ElementalSet, layouts: list[ChannelLayout]) -> int:
    """Return the default distance of a plane's samples in detector pixels: 1 if the views can fill that.

    A view sees only some pixels in each colour of a mosaic; with fewer views than it takes to fill the gaps, the
    samples are a period of the mosaic apart.
    """
    views = len(loaded.settings.view)
    step = layouts[0].lattices[0].step
    fewest_per_sample = min(views * len(layout.lattices) / (step[0] * step[1]) for layout in layouts)
    return 1 if fewest_per_sample >= 1 else max(step)


def plane_grid(loaded: ElementalSet, depth_mm: float, pitch_mm: float | None = None) -> PlaneGrid:
    """Return the samples of the plane at a depth, one per pixel of the reference view by default.

    Raises
    ------
    GeometryMismatch
        The plane is not in front of the camera, or the pitch leaves it without samples.
    """
    check_in_front(depth_mm)
    camera = loaded.settings.camera
    cx_px, cy_px = loaded.principal_points_px()[loaded.reference_view].tolist()
    width, height = camera.size_px
    mm_per_px_x, mm_per_px_y = depth_mm / camera.fx_px, depth_mm / camera.fy_px
    try:
        return PlaneGrid.covering(
            left_mm=(-0.5 - cx_px) * mm_per_px_x,
            top_mm=(-0.5 - cy_px) * mm_per_px_y,
            right_mm=(width - 0.5 - cx_px) * mm_per_px_x,
            bottom_mm=(height - 0.5 - cy_px) * mm_per_px_y,
            pitch_mm=mm_per_px_x if pitch_mm is None else pitch_mm,
        )
    except ValueError as failure:
        raise GeometryMismatch(f"plane at {depth_mm:g} mm: {failure}") from failure


def tilted_grid(loaded: ElementalSet, plane: TiltedPlane, pitch_mm: float) -> PlaneGrid:
    """Return the samples of a plane of any pose: of its stated size, or what the reference view sees of it.

    Raises
    ------
    GeometryMismatch
        A part of the reference view does not meet the plane in front of the camera, or only very far away.
    """
    width, height = loaded.settings.camera.size_px
    if not plane.depth_mm > 0:
        raise GeometryMismatch(
            f"plane '{plane.name}': lies behind the camera, at {plane.depth_mm:g} mm along its axis; z points forward: "
            "correct its pose"
        )
    low, high = _seen_part(loaded, plane) if plane.size_mm is None else _part_around_origin(plane.size_mm)
    samples, max_samples = float(np.prod((high - low) / pitch_mm)), _MAX_SAMPLES_PER_PIXEL * width * height
    if samples > max_samples:
        raise GeometryMismatch(
            f"plane '{plane.name}': has {samples:.3g} samples, and at most {max_samples:.3g} make sense, "
            f"{_MAX_SAMPLES_PER_PIXEL} per detector pixel; give it a size_mm, or a larger --pitch-mm"
        )
    try:
        return PlaneGrid.covering(float(low[0]), float(low[1]), float(high[0]), float(high[1]), pitch_mm)
    except ValueError as failure:
        raise GeometryMismatch(f"plane '{plane.name}': {failure}") from failure


def _part_around_origin(size_mm: tuple[float, float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and highest x, y in mm of a plane of a stated size."""
    half = np.array(size_mm) / 2
    return -half, half


def _seen_part(loaded: ElementalSet, plane: TiltedPlane) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and highest x, y in mm on a plane that the reference view sees."""
    camera = loaded.settings.camera
    width, height = camera.size_px
    columns, rows = np.meshgrid(np.linspace(-0.5, width - 0.5, 3), np.linspace(-0.5, height - 0.5, 3))
    shift_px = np.array([camera.cx_px, camera.cy_px]) - loaded.principal_points_px()[loaded.reference_view]
    rays = loaded.lens.rays_at(np.column_stack([columns.ravel(), rows.ravel()]) + shift_px)
    points = plane.on_plane(np.column_stack([rays, np.ones(len(rays))]))
    if np.isnan(points).any():
        raise GeometryMismatch(
            f"plane '{plane.name}': a part of the reference view does not meet it in front of the camera; "
            "give it a size_mm, or correct its pose"
        )
    return points.min(axis=0), points.max(axis=0)
