"""The samples of planes, and the operator H of a plane or of several, from the poses, lens and response of a set."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.homography import fronto_parallel_rt_ref_plane, plane_from_ray, ray_from_surface, transfer
from faintfield.pipelines.formats.frames import ChannelLayout, Lattice
from faintfield.pipelines.formats.plane_poses import Place, TiltedPlane, depth_of
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages, Image, binned
from faintfield.recon.operator.geometry import DetectorMaps
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.occlusion import Occluders
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.operator.single_plane import OperatorOptions, PlaneOperator
from faintfield.recon.operator.surface_operator import SurfaceOperator

# Limit of the samples of a plane: one seen at a grazing angle would have most of its samples far away.
_MAX_SAMPLES_PER_PIXEL = 16


def check_in_front(depth_mm: float) -> None:
    """Refuse a plane that is not in front of the reference camera (GeometryMismatch)."""
    if not (np.isfinite(depth_mm) and depth_mm > 0):
        raise GeometryMismatch(f"a plane at {depth_mm} mm is not in front of the camera; give a positive depth")


def default_pitch_px(elemental_set: ElementalSet) -> int:
    """Return the default distance of a plane's samples in detector pixels: 1 if the views can fill that.

    A view sees only some pixels in each colour of a mosaic; with fewer views than it takes to fill the gaps, the
    samples are a period of the mosaic apart.
    """
    views, layouts = len(elemental_set.settings.view), elemental_set.layouts
    step = layouts[0].lattices[0].step
    fewest_per_sample = min(views * len(layout.lattices) / (step[0] * step[1]) for layout in layouts)
    return 1 if fewest_per_sample >= 1 else max(step)


def plane_grid(elemental_set: ElementalSet, place: Place, pitch_mm: float | None = None) -> PlaneGrid:
    """Return the samples of a plane, one per pixel of the reference view by default.

    At a depth it has what the reference view sees; a tilted one its stated size, or what that view sees of it. Raises
    GeometryMismatch if the plane is not in front of the camera, the pitch leaves it without samples, or a part of the
    view does not meet it, or only very far away.
    """
    if isinstance(place, TiltedPlane):
        return _tilted_grid(elemental_set, place, pitch_mm)
    depth_mm = place
    check_in_front(depth_mm)
    camera = elemental_set.settings.camera
    cx_px, cy_px = elemental_set.principal_points_px[elemental_set.reference_view].tolist()
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
        raise GeometryMismatch(f"plane at {elemental_set.depth_text(depth_mm)}: {failure}") from failure


def requested_grid(elemental_set: ElementalSet, place: Place, pitch_mm: float | None) -> PlaneGrid:
    """Return the samples of a plane; planes of one stated pitch have theirs one behind the other, for a stack."""
    if pitch_mm is None:
        mm_per_depth = default_pitch_px(elemental_set) / elemental_set.settings.camera.fx_px
        return plane_grid(elemental_set, place, depth_of(place) * mm_per_depth)
    grid = plane_grid(elemental_set, place, pitch_mm)
    return grid if isinstance(place, TiltedPlane) else grid.on_multiples()


def _tilted_grid(elemental_set: ElementalSet, plane: TiltedPlane, pitch_mm: float | None) -> PlaneGrid:
    camera = elemental_set.settings.camera
    width, height = camera.size_px
    if not plane.depth_mm > 0:
        raise GeometryMismatch(
            f"plane '{plane.name}': lies behind the camera, at {plane.depth_mm:g} mm along its axis; z points forward: "
            "correct its pose"
        )
    pitch_mm = plane.depth_mm / camera.fx_px if pitch_mm is None else pitch_mm
    low, high = _covered_part(elemental_set, plane)
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


def _covered_part(elemental_set: ElementalSet, plane: TiltedPlane) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if plane.size_mm is not None:
        half = np.array(plane.size_mm) / 2
        return -half, half
    camera = elemental_set.settings.camera
    width, height = camera.size_px
    columns, rows = np.meshgrid(np.linspace(-0.5, width - 0.5, 3), np.linspace(-0.5, height - 0.5, 3))
    shift_px = np.array([camera.cx_px, camera.cy_px]) - elemental_set.principal_points_px[elemental_set.reference_view]
    rays = elemental_set.lens.rays_at(np.column_stack([columns.ravel(), rows.ravel()]) + shift_px)
    points = plane.on_plane(np.column_stack([rays, np.ones(len(rays))]))
    if np.isnan(points).any():
        raise GeometryMismatch(
            f"plane '{plane.name}': a part of the reference view does not meet it in front of the camera; "
            "give it a size_mm, or correct its pose"
        )
    return points.min(axis=0), points.max(axis=0)


class OperatorFactory:
    """Makes the operators of one channel; rays, response and mask, which they share, are computed once.

    `bins` is the width of the bins of images from `ElementalImages.binned`. Without `images`, whose mask all operators
    share, operators are those of some views with their own.
    """

    def __init__(
        self, elemental_set: ElementalSet, layout: ChannelLayout, images: ElementalImages | None, *, bins: int = 1
    ) -> None:
        lattices, self._phases = layout.lattices, len(layout.lattices)
        rays = np.empty((len(lattices), *lattices[0].shape, 2), np.float32)
        for part, at in zip(rays, lattices, strict=True):  # one at a time: they are as large as two images each
            part[:] = elemental_set.lens.rays(at.first, at.step)[: at.shape[0], : at.shape[1]]
        rays = np.moveaxis(binned(np.moveaxis(rays, -1, 0), bins), 0, -1)
        response = np.stack([response_of(elemental_set, lattice) for lattice in lattices])
        whole = binned(response > 0, bins) == 1  # a bin with an unusable pixel holds the electrons of that, too
        self._maps = DetectorMaps(rays, np.where(whole, binned(response, bins), 0))
        self._poses, self._principal_shift = elemental_set.poses_rt_cam_ref, principal_shift(elemental_set)
        self._shared = self._of_views(len(self._poses), None if images is None else images.valid)

    def _of_views(self, count: int, valid: NDArray[np.bool_] | None) -> OperatorOptions:
        return {"valid": valid, "lattice_of_view": np.tile(np.arange(self._phases), count)}

    def at(
        self,
        place: Place,
        grid: PlaneGrid,
        views: Sequence[int] | None = None,
        valid: NDArray[np.bool_] | None = None,
        dtype: type[np.float32] | type[np.float64] = np.float32,
    ) -> PlaneOperator:
        """Return H of a plane at a depth, or of a pose; of some views alone with their mask (view, row, column)."""
        shared = self._shared if views is None else self._of_views(len(views), valid)
        return PlaneOperator(self._homographies(place, views), self._maps, grid, **shared | {"dtype": dtype})

    def of_surface(
        self, inverse_depth: NDArray[np.floating], grid: PlaneGrid, *, masked: bool = True
    ) -> SurfaceOperator:
        """Return H of the surface with these 1/depths in 1/mm, on the samples of a grid at unit depth.

        Unless it is `masked`, saturated pixels count, too.
        """
        shared = self._shared if masked else self._of_views(len(self._poses), None)
        matrices = np.repeat(ray_from_surface(self._poses, self._principal_shift), self._phases, axis=0)
        return SurfaceOperator(matrices, self._maps, grid, inverse_depth, **shared)

    def of_scene(self, grids: Mapping[Place, PlaneGrid], opacities: Sequence[Image] | None = None) -> SceneOperator:
        """Return H of all planes together, in the order of `grids`.

        `opacities` (row, column) are what each plane hides of those behind it, 0 to 1; nothing by default.
        """
        homographies = np.stack([self._homographies(place) for place in grids])
        occluders = None if opacities is None else Occluders(opacities, [depth_of(place) for place in grids])
        return SceneOperator(homographies, self._maps, list(grids.values()), occluders=occluders, **self._shared)

    def _homographies(self, place: Place, views: Sequence[int] | None = None) -> NDArray[np.float64]:
        """Return the homographies from the rays of some views, and each phase of its mosaic, to a plane."""
        if isinstance(place, TiltedPlane):
            rt_ref_plane = np.array(place.rt_ref_plane)
        else:
            rt_ref_plane = fronto_parallel_rt_ref_plane(place)
        chosen = slice(None) if views is None else list(views)
        shift = None if self._principal_shift is None else self._principal_shift[chosen]
        return np.repeat(plane_from_ray(self._poses[chosen], rt_ref_plane, shift), self._phases, axis=0)


def response_of(elemental_set: ElementalSet, lattice: Lattice) -> NDArray[np.float32]:
    """Return the flat field of a lattice (row, column), zero at unusable pixels."""
    flat = np.ones(lattice.shape, np.float32) if elemental_set.flat is None else lattice.of(elemental_set.flat).copy()
    flat[lattice.of(elemental_set.unusable)] = 0
    return flat


def principal_shift(elemental_set: ElementalSet) -> NDArray[np.float64] | None:
    """Return the shift (view, 2) of the rays of views with a principal point of their own, None without such views."""
    camera = elemental_set.settings.camera
    shift_px = np.array([camera.cx_px, camera.cy_px]) - elemental_set.principal_points_px
    if not shift_px.any():
        return None
    if any(camera.distortion):
        view = int(np.flatnonzero(shift_px.any(axis=1))[0])
        raise GeometryMismatch(
            f"view[{view}] has a principal point of its own while the camera has distortion {list(camera.distortion)}; "
            "a sheared or rectified light field has none: remove one of the two"
        )
    return np.asarray(shift_px / [camera.fx_px, camera.fy_px])


def seen_from(
    elemental_set: ElementalSet, depth_mm: float, pixels: NDArray[np.float64], views: Sequence[int]
) -> NDArray[np.float64]:
    """Return where views see what pixels (pixel, 2) of the reference view show of a plane: x, y (view, pixel, 2)."""
    camera, poses = elemental_set.settings.camera, elemental_set.poses_rt_cam_ref
    # The lens has the camera's principal point; a view with its own has its picture shifted
    shifts = elemental_set.principal_points_px - np.array([camera.cx_px, camera.cy_px])
    straight, plane = pixels - shifts[elemental_set.reference_view], fronto_parallel_rt_ref_plane(depth_mm)
    return np.array([transfer(elemental_set.lens, poses[view], plane, straight) + shifts[view] for view in views])


def blind_views(elemental_set: ElementalSet, operator: SceneOperator | SurfaceOperator, what: str) -> str | None:
    """Return a message on views that see nothing of a plane or surface, as a pose may be wrong; None without such."""
    phases = len(operator.all_views) // len(elemental_set.settings.view)
    blind = {int(view) // phases for view in np.setdiff1d(operator.all_views, operator.seeing_views)}
    if not blind:
        return None
    first = elemental_set.settings.view[min(blind)].image
    return f"{len(blind)} views see nothing of {what}, {first} for one; are their poses right?"
